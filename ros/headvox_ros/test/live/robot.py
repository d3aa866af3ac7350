"""A node in a process of its own, and a robot in this one that knows nothing but standard messages."""

from __future__ import annotations

import array
import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Sequence

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, TransformStamped
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue, SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.qos import DurabilityPolicy, QoSProfile
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from headvox import Frame

NS = 1_000_000_000
START_S = 240.0  # the first run of a new version compiles
WAIT_S = 60.0  # far more than it takes: machines that test are busy
CAMERAS = ("left", "right")
STEP = NS // 10  # from one frame to the next
KINDS = {
    bool: (ParameterType.PARAMETER_BOOL, "bool_value"),
    int: (ParameterType.PARAMETER_INTEGER, "integer_value"),
    float: (ParameterType.PARAMETER_DOUBLE, "double_value"),
    str: (ParameterType.PARAMETER_STRING, "string_value"),
    list: (ParameterType.PARAMETER_DOUBLE_ARRAY, "double_array_value"),
}


class Process:
    """A node of the package, in a process of its own."""

    def __init__(self, module: str, *parameters: str, words: Sequence[str] = (), **environment: str) -> None:
        command = [sys.executable, "-m", f"headvox_ros.{module}", *words]
        if parameters:
            command += ["--ros-args", *(part for parameter in parameters for part in ("-p", parameter))]
        self.process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, **environment},
        )

    @property
    def pid(self) -> int:
        return self.process.pid

    def interrupt(self) -> None:
        self.process.send_signal(signal.SIGINT)

    def end(self) -> tuple[int, str]:
        """Interrupt it, and return its exit code and everything that it said."""
        if self.process.poll() is None:
            self.interrupt()
        return self.wait()

    def wait(self, timeout_s: float = WAIT_S) -> tuple[int, str]:
        try:
            said, _ = self.process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            said, _ = self.process.communicate()
            pytest.fail(f"it does not end; it said:\n{said}")
        return self.process.returncode, said


class Robot:
    """Publishes what drivers publish, and keeps what comes back."""

    def __init__(self) -> None:
        self.node = rclpy.create_node("robot")
        self.got: dict[str, list] = defaultdict(list)
        self._out: dict[str, object] = {}
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._tf = self.node.create_publisher(TFMessage, "/tf", 100)
        self._tf_static = self.node.create_publisher(TFMessage, "/tf_static", latched)
        self.listen(DiagnosticArray, "/diagnostics")
        self.listen(PoseArray, "/head_detector/poses")
        self.listen(MarkerArray, "/head_detector/markers")

    def listen(self, kind, topic: str, qos=10) -> None:
        self.node.create_subscription(kind, topic, self.got[topic].append, qos)

    def spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            rclpy.spin_once(self.node, timeout_sec=left)

    def wait(self, happened, seconds: float = WAIT_S, meanwhile=None, every_s: float = 0.1):
        """Spin until ``happened()`` is true, and return it; call ``meanwhile`` every so often."""
        end = time.monotonic() + seconds
        while not (result := happened()):
            assert time.monotonic() < end, "it did not happen in time"
            if meanwhile is not None:
                meanwhile()
            self.spin(every_s)
        return result

    def publish(self, topic: str, message) -> None:
        kind = type(message)
        if topic not in self._out:
            self._out[topic] = self.node.create_publisher(kind, topic, QoSProfile(depth=2))
            self.wait(lambda: self._out[topic].get_subscription_count() > 0, START_S)
            self.spin(0.3)
        self._out[topic].publish(message)

    def place(self, child: str, T, stamp_ns: int = 0, parent: str = "world", static: bool = True) -> None:
        moved = TransformStamped(header=header(parent, stamp_ns), child_frame_id=child)
        t, q = moved.transform.translation, moved.transform.rotation
        t.x, t.y, t.z = map(float, T[:3, 3])
        q.x, q.y, q.z, q.w = map(float, Rotation.from_matrix(T[:3, :3]).as_quat())
        (self._tf_static if static else self._tf).publish(TFMessage(transforms=[moved]))

    def see(self, camera: str, image, stamp_ns: int, **changes) -> None:
        """Publish a depth image with its camera_info, with some of its fields changed."""
        lens = image.intrinsics
        stamped = header(f"{camera}_optical", stamp_ns)
        k = [lens.fx, 0.0, lens.cx, 0.0, lens.fy, lens.cy, 0.0, 0.0, 1.0]
        info = CameraInfo(header=stamped, width=lens.width, height=lens.height, k=k)
        self.publish(f"/{camera}/camera_info", info)
        height, width = image.depth.shape
        message = Image(
            header=stamped,
            height=height,
            width=width,
            encoding="16UC1",
            step=2 * width,
            data=data_of(image.depth),
        )
        for name, value in changes.items():
            setattr(message, name, value)
        self.publish(f"/{camera}/image", message)

    def see_frame(self, frame: Frame, stamp_ns: int, only: tuple[str, ...] = CAMERAS) -> None:
        """Publish the frame's depth images, of these cameras only."""
        for image in frame.depths:
            if image.name in only:
                self.see(image.name, image, stamp_ns)

    def poses(self) -> list[PoseArray]:
        return self.got["/head_detector/poses"]

    def answers(self, stamp_ns: int) -> list[PoseArray]:
        """What the node answered to what has this stamp."""
        return [message for message in self.poses() if stamp_of(message) == stamp_ns]

    def status(self) -> dict[str, str]:
        """The newest diagnostics: its rows, and its level and message."""
        messages = self.got["/diagnostics"]
        if not messages:
            return {}
        status = messages[-1].status[0]
        return {
            **{row.key: row.value for row in status.values},
            "level": status.level[0],
            "message": status.message,
        }

    def expect_count(self, kind: str, action, at_least: int = 1) -> dict[str, str]:
        """Call ``action`` and wait for the diagnostics to count it."""
        before = int(self.wait(self.status)[kind])
        action()
        return self.wait(lambda: int(self.status()[kind]) >= before + at_least and self.status())

    def set_parameter(self, name: str, value) -> SetParametersResult:
        """Set a parameter of the detector, and return what it says to that."""
        kind, attribute = KINDS[type(value)]
        client = self.node.create_client(SetParameters, "/head_detector/set_parameters")
        assert client.wait_for_service(WAIT_S)
        request = SetParameters.Request(
            parameters=[Parameter(name=name, value=ParameterValue(type=kind, **{attribute: value}))]
        )
        future = client.call_async(request)
        rclpy.spin_until_future_complete(self.node, future, timeout_sec=WAIT_S)
        self.node.destroy_client(client)
        return future.result().results[0]

    def close(self) -> None:
        self.node.destroy_node()


def header(frame: str, stamp_ns: int) -> Header:
    made = Header(frame_id=frame)
    made.stamp.sec, made.stamp.nanosec = divmod(int(stamp_ns), NS)
    return made


def data_of(values) -> array.array:
    data = array.array("B")
    data.frombytes(np.ascontiguousarray(values).data.cast("B"))
    return data


def cloud_of(points, frame: str, stamp_ns: int, **changes) -> PointCloud2:
    points = np.ascontiguousarray(points, dtype=np.float32)
    fields = [
        PointField(name=n, offset=4 * k, datatype=PointField.FLOAT32, count=1) for k, n in enumerate("xyz")
    ]
    message = PointCloud2(
        header=header(frame, stamp_ns),
        height=1,
        width=len(points),
        fields=fields,
        point_step=12,
        row_step=12 * len(points),
        data=data_of(points) if len(points) else array.array("B"),
    )
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def xyz(pose) -> np.ndarray:
    return np.array([pose.position.x, pose.position.y, pose.position.z])


def centres_of(message: PoseArray) -> np.ndarray:
    return np.array([xyz(pose) for pose in message.poses]).reshape(-1, 3)


def stamp_of(message) -> int:
    return message.header.stamp.sec * NS + message.header.stamp.nanosec
