"""The node ``play_recording``: a depth recording as if its cameras were here.

Each camera NAME publishes as a RealSense driver does: ``/NAME/depth/image_rect_raw``, ``/NAME/depth/camera_info``,
with ``clouds`` also ``/NAME/depth/points``, its place on /tf_static, and /clock if asked. What the recording knows of
the true heads goes out on ``/true_heads``.
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Container, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseArray, Quaternion, TransformStamped, Vector3
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from headvox.data import F32, DepthImage, Frame
from headvox.errors import HeadvoxError
from headvox.evaluate.truth import FILE as TRUTH
from headvox.evaluate.truth import read_truth
from headvox.ros.synchronise import NS
from headvox.sources import open_source
from headvox_ros.cloud_concatenate import as_message_data, cloud_message
from headvox_ros.sensors import RELIABILITIES

WORLD = "world"


@dataclass(frozen=True, slots=True)
class Camera:
    """Where one camera publishes."""

    depth: Any
    info: Any
    points: Any


class Player(Node):
    """Plays the frames of a recording in memory, at their own pace or another, once or for ever."""

    def __init__(self) -> None:
        super().__init__("play_recording")
        self.path = self._parameter("recording", "", "Folder of a depth recording.")
        self.rate_hz = self._parameter("rate_hz", 0.0, "Frames a second; 0 as recorded.")
        self.loops = self._parameter("loops", 0, "How often to play; 0 for ever.")
        self.depths = self._parameter("depths", True, "Publish depth images.")
        self.clouds = self._parameter("clouds", False, "Publish point clouds.")
        self.clock = self._parameter("clock", False, "Publish /clock, and stamp in the recording's own time.")
        self.rewind = self._parameter("rewind", False, "With clock: let time jump back at each new loop.")
        self.delay_s = self._parameter("delay_s", 1.0, "How long to wait for others before the first frame.")
        reliability = self._parameter(
            "reliability", "reliable", "best_effort or reliable; drivers offer this."
        )
        self.silent = self._parameter(
            "silent", [""], "Cameras that stop: NAME:FROM:TO in seconds from the first frame."
        )
        self._qos = QoSProfile(depth=2, reliability=RELIABILITIES[reliability])
        if not self.path:
            raise HeadvoxError("There is no recording to play.", "Set it: -p recording:=FOLDER")
        frames = [frame for frame in open_source(self.path) if isinstance(frame, Frame)]
        if not frames or not any(frame.depths for frame in frames):
            raise HeadvoxError(f"{self.path} has no depth images.", "Is it a depth recording?")
        self.frames = frames
        self._truth = _true_heads(Path(self.path))
        self._cameras = {image.name: self._camera(image.name) for frame in frames for image in frame.depths}
        self._clock_out = self.create_publisher(Clock, "/clock", 10) if self.clock else None
        self._truth_out = self.create_publisher(PoseArray, "/true_heads", 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._tf = self.create_publisher(TFMessage, "/tf_static", latched)
        self._tf.publish(TFMessage(transforms=[_place(image) for image in self._first_images()]))

    def _parameter(self, name: str, default: Any, description: str) -> Any:
        return self.declare_parameter(
            name, default, ParameterDescriptor(description=description, read_only=True)
        ).value

    def _camera(self, name: str) -> Camera:
        base = f"/{name}/depth"
        return Camera(
            self.create_publisher(Image, f"{base}/image_rect_raw", self._qos) if self.depths else None,
            self.create_publisher(CameraInfo, f"{base}/camera_info", self._qos),
            self.create_publisher(PointCloud2, f"{base}/points", self._qos) if self.clouds else None,
        )

    def _first_images(self) -> list[DepthImage]:
        images = {image.name: image for frame in reversed(self.frames) for image in frame.depths}
        return [images[name] for name in sorted(images)]

    def play(self) -> None:
        """Publish every frame at its time."""
        gone = [self._silence(text) for text in self.silent if text]
        time.sleep(self.delay_s)
        skipped = 0
        start_s = time.monotonic() + 0.1
        start_ns = self.frames[0].stamp_ns if self.clock else time.time_ns() + NS // 10
        print(f"playing {len(self.frames)} frames from {start_ns} ns on", flush=True)
        for frame, since_ns in self._schedule():
            wait = start_s + 1e-9 * since_ns - time.monotonic()
            if wait < -1e-9 * self._step_ns():  # a camera does not fall behind: what it cannot send is lost
                skipped += 1
                continue
            time.sleep(max(wait, 0.0))
            again_ns = since_ns if not self.rewind else frame.stamp_ns - self.frames[0].stamp_ns
            now_s = 1e-9 * since_ns
            missing = {name for name, begin, end in gone if begin <= now_s < end}
            self.publish(frame, start_ns + again_ns, missing)
        print(f"done, {skipped} frames skipped", flush=True)

    def _schedule(self) -> Iterator[tuple[Frame, int]]:
        """Yield each frame, and when it is due in nanoseconds from the start."""
        step = self._step_ns()
        stamps = [frame.stamp_ns - self.frames[0].stamp_ns for frame in self.frames]
        if self.rate_hz > 0.0:
            stamps = [k * step for k in range(len(stamps))]
        number = 0
        while self.loops <= 0 or number < self.loops * len(stamps):
            loop, k = divmod(number, len(stamps))
            yield self.frames[k], loop * (stamps[-1] + step) + stamps[k]
            number += 1

    def _step_ns(self) -> int:
        """Return the time from frame to frame."""
        count, first, last = len(self.frames), self.frames[0].stamp_ns, self.frames[-1].stamp_ns
        as_recorded = (last - first) // (count - 1) if count > 1 else NS // 10
        return int(NS / self.rate_hz) if self.rate_hz > 0.0 else as_recorded

    def publish(self, frame: Frame, stamp_ns: int, missing: Container[str] = ()) -> None:
        """Publish what the cameras see in a frame, but those that are ``missing``, with a stamp."""
        stamp = Time(sec=stamp_ns // NS, nanosec=stamp_ns % NS)
        if self._clock_out is not None:
            self._clock_out.publish(Clock(clock=stamp))
        for image in frame.depths:
            if image.name in missing:
                continue
            camera, header = (
                self._cameras[image.name],
                Header(stamp=stamp, frame_id=optical_frame(image.name)),
            )
            camera.info.publish(camera_info(header, image))
            if camera.depth is not None:
                camera.depth.publish(depth_message(header, image))
            if camera.points is not None:
                camera.points.publish(cloud_message(header, organised_points(image)))
        heads = self._truth.get(frame.stamp_ns)
        if heads is not None:
            self._truth_out.publish(PoseArray(header=Header(stamp=stamp, frame_id=WORLD), poses=heads))

    def _silence(self, text: str) -> tuple[str, float, float]:
        name, begin, end = text.split(":")
        if name not in self._cameras:
            raise HeadvoxError(
                f"silent: there is no camera {name!r}.", f"There is {', '.join(self._cameras)}."
            )
        return name, float(begin), float(end)


def optical_frame(camera: str) -> str:
    """Return the frame of a camera's depth images, as the RealSense driver names it."""
    return f"{camera}_depth_optical_frame"


def depth_message(header: Header, image: DepthImage) -> Image:
    """Return a depth image as a driver sends it: 16UC1, millimetres."""
    height, width = image.depth.shape
    scale = image.intrinsics.depth_scale
    depth = image.depth if scale == 0.001 else np.rint(image.depth * (1e3 * scale)).astype(np.uint16)
    return Image(
        header=header,
        height=height,
        width=width,
        encoding="16UC1",
        is_bigendian=int(sys.byteorder == "big"),
        step=2 * width,
        data=as_message_data(depth),
    )


def camera_info(header: Header, image: DepthImage) -> CameraInfo:
    """Return the CameraInfo of a depth image without distortion."""
    lens = image.intrinsics
    fx, fy, cx, cy = lens.fx, lens.fy, lens.cx, lens.cy
    return CameraInfo(
        header=header,
        width=lens.width,
        height=lens.height,
        distortion_model="plumb_bob",
        d=[0.0] * 5,
        k=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def organised_points(image: DepthImage) -> F32:
    """Return the points of an image in its camera's frame, (height, width, 3) float32, NaN where there is no return."""
    lens = image.intrinsics
    z = image.depth * np.float32(lens.depth_scale)
    z[image.depth == 0] = np.nan
    points = np.empty((*z.shape, 3), np.float32)
    points[..., 0] = z * (
        (np.arange(lens.width, dtype=np.float32) - np.float32(lens.cx)) / np.float32(lens.fx)
    )
    rows = (np.arange(lens.height, dtype=np.float32) - np.float32(lens.cy)) / np.float32(lens.fy)
    points[..., 1] = z * rows[:, None]
    points[..., 2] = z
    return points


def _place(image: DepthImage) -> TransformStamped:
    x, y, z, w = Rotation.from_matrix(image.T_world_camera[:3, :3]).as_quat().tolist()
    transform = TransformStamped(header=Header(frame_id=WORLD), child_frame_id=optical_frame(image.name))
    tx, ty, tz = image.T_world_camera[:3, 3].tolist()
    transform.transform.translation = Vector3(x=tx, y=ty, z=tz)
    transform.transform.rotation = Quaternion(x=x, y=y, z=z, w=w)
    return transform


def _true_heads(folder: Path) -> dict[int, list[Pose]]:
    """Return the true heads of each labelled frame by its stamp; those to be ignored are left out."""
    path = folder / TRUTH
    if not path.exists():
        return {}
    return {
        stamp: [
            Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
            for (x, y, z), (qx, qy, qz, qw) in zip(
                heads.centres[~heads.ignored].tolist(),
                heads.quaternions[~heads.ignored].tolist(),
                strict=True,
            )
        ]
        for stamp, heads in read_truth(path).items()
    }


def main(arguments: list[str] | None = None) -> int:
    """Run the node; return its exit code."""
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        Player().play()
    except HeadvoxError as error:
        print(f"play_recording: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 0
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv))
