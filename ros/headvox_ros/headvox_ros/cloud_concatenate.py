"""The node ``cloud_concatenate``: several clouds and depth images in, one cloud in one frame out."""

from __future__ import annotations

import array
import sys
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from headvox.data import F32, Cloud, Frame
from headvox.errors import HeadvoxError
from headvox.frames import unproject
from headvox.fuse import Region, fuse
from headvox.ros.synchronise import NS
from headvox_ros.node import SensorNode, run
from headvox_ros.parameters import Parameter
from headvox_ros.sensors import RELIABILITIES

PARAMETERS = [
    Parameter("rate_hz", 0.0, "Publish at most so often; 0 for every set of readings.", (0.0, 1000.0)),
    Parameter(
        "max_range_m", 1000.0, "Points farther than this from the target frame are dropped.", (0.0, 1e6)
    ),
    Parameter("publish_reliability", "best_effort", "Of the fused cloud: best_effort or reliable.", None),
]


class CloudConcatenate(SensorNode):
    """Fuses what several sensors see at one moment, for those who want the cloud on a topic."""

    def __init__(self) -> None:
        super().__init__("cloud_concatenate", PARAMETERS)
        self._cloud: Any = None
        self._next_s = 0.0

    def check(self, values: Mapping[str, Any]) -> None:
        """Refuse an unknown reliability, and nothing to listen to."""
        if values["publish_reliability"] not in RELIABILITIES:
            raise HeadvoxError(f"publish_reliability: expected {' or '.join(RELIABILITIES)}.", "")
        if not any(topic for name in ("clouds", "depths") for topic in values[name]):
            raise HeadvoxError("There is no topic to listen to.", "Set clouds or depths.")

    def prepare(self) -> None:
        """Advertise the cloud."""
        reliability = RELIABILITIES[self.get_parameter("publish_reliability").value]
        qos = QoSProfile(depth=2, reliability=reliability)
        self._cloud = self.create_lifecycle_publisher(PointCloud2, "~/cloud", qos)

    def process(self, frame: Frame) -> None:
        """Publish all points of a frame, if it is time."""
        now, rate = time.monotonic(), self.get_parameter("rate_hz").value
        if rate > 0.0:
            if now < self._next_s:
                return
            self._next_s = max(self._next_s + 1.0 / rate, now + 0.5 / rate)
        far = self.get_parameter("max_range_m").value
        region = Region((0.0, 0.0, 0.0), far, -far, far)
        seen = [
            Cloud(
                image.name, unproject(image.depth, image.intrinsics, image.T_world_camera).astype(np.float32)
            )
            for image in frame.depths
        ]
        points = fuse([*frame.clouds, *seen], region)
        header = Header(frame_id=self.get_parameter("target_frame").value)
        header.stamp.sec, header.stamp.nanosec = divmod(frame.stamp_ns, NS)
        self._cloud.publish(cloud_message(header, points))

    def release(self) -> None:
        """Withdraw the cloud."""
        if self._cloud is not None:
            self.destroy_lifecycle_publisher(self._cloud)
            self._cloud = None


def cloud_message(header: Header, points: F32) -> PointCloud2:
    """Return points (N, 3) float32 or an organised (height, width, 3) as a cloud of x, y, z."""
    height, width = points.shape[:-1] if points.ndim == 3 else (1, len(points))
    fields = [
        PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1)
        for k, name in enumerate("xyz")
    ]
    return PointCloud2(
        header=header,
        height=height,
        width=width,
        fields=fields,
        is_bigendian=sys.byteorder == "big",
        point_step=12,
        row_step=12 * width,
        data=as_message_data(points),
        is_dense=points.ndim == 2,
    )


def as_message_data(values: npt.NDArray[Any]) -> array.array[int]:
    """Return the bytes of an array as the one type that rclpy copies as a whole."""
    data = array.array("B")
    data.frombytes(np.ascontiguousarray(values).data.cast("B"))
    return data


def main(arguments: list[str] | None = None) -> int:
    """Run the node; return its exit code."""
    return run(CloudConcatenate, arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv))
