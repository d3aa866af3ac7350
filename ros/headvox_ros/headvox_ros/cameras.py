"""Depth cameras as their drivers publish them, for the nodes that stand in for real ones.

Each camera NAME publishes as a RealSense driver does: ``/NAME/depth/image_rect_raw``, ``/NAME/depth/camera_info``,
with ``clouds`` also ``/NAME/depth/points``, its place on /tf_static, and /clock if asked. The true heads, where they
are known, go out on ``/true_heads``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Container, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseArray, Quaternion, TransformStamped, Vector3
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from headvox.data import F32, DepthImage, Frame
from headvox.errors import HeadvoxError
from headvox.ros.synchronise import NS
from headvox_ros.cloud_concatenate import as_message_data, cloud_message
from headvox_ros.sensors import RELIABILITIES

WORLD = "world"
FINISH_S = 5.0  # a listener that takes longer has gone, or hangs


@dataclass(frozen=True, slots=True)
class Camera:
    """Where one camera publishes."""

    depth: Any
    info: Any
    points: Any


class Cameras:
    """Publishes for cameras that are placed as in ``images``, one of each, through a node.

    Raises:
        HeadvoxError: a ``reliability`` that is none.
    """

    def __init__(
        self,
        node: Node,
        images: Iterable[DepthImage],
        depths: bool,
        clouds: bool,
        clock: bool,
        reliability: str,
    ) -> None:
        if reliability not in RELIABILITIES:
            raise HeadvoxError(
                f"reliability: expected {' or '.join(RELIABILITIES)}, got {reliability!r}.", ""
            )
        images = list(images)
        qos = QoSProfile(depth=2, reliability=RELIABILITIES[reliability])
        self._cameras = {image.name: _camera(node, image.name, depths, clouds, qos) for image in images}
        self._clock = node.create_publisher(Clock, "/clock", 10) if clock else None
        self._truth = node.create_publisher(PoseArray, "/true_heads", 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._tf = node.create_publisher(TFMessage, "/tf_static", latched)
        self._tf.publish(TFMessage(transforms=[place(image) for image in images]))

    @property
    def names(self) -> list[str]:
        """The cameras' names, in order."""
        return sorted(self._cameras)

    def publish(
        self, frame: Frame, stamp_ns: int, missing: Container[str] = (), heads: list[Pose] | None = None
    ) -> None:
        """Publish what the cameras see in a frame, but those that are ``missing``, with a stamp; and the true heads."""
        stamp = Time(sec=stamp_ns // NS, nanosec=stamp_ns % NS)
        if self._clock is not None:
            self._clock.publish(Clock(clock=stamp))
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
        if heads is not None:
            self._truth.publish(PoseArray(header=Header(stamp=stamp, frame_id=WORLD), poses=heads))

    def finish(self) -> None:
        """Wait until whoever listens reliably has what was sent: what has not left when the process ends is lost."""
        until = time.monotonic() + FINISH_S
        for camera in self._cameras.values():
            for publisher in (camera.info, camera.depth, camera.points):
                if publisher is not None:
                    publisher.wait_for_all_acked(Duration(seconds=max(0.0, until - time.monotonic())))


def fixed(node: Node, name: str, default: Any, description: str) -> Any:
    """Declare a parameter that is set at the start only, and return its value."""
    return node.declare_parameter(
        name, default, ParameterDescriptor(description=description, read_only=True)
    ).value


def _camera(node: Node, name: str, depths: bool, clouds: bool, qos: QoSProfile) -> Camera:
    base = f"/{name}/depth"
    return Camera(
        node.create_publisher(Image, f"{base}/image_rect_raw", qos) if depths else None,
        node.create_publisher(CameraInfo, f"{base}/camera_info", qos),
        node.create_publisher(PointCloud2, f"{base}/points", qos) if clouds else None,
    )


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


def place(image: DepthImage) -> TransformStamped:
    """Return where the camera of an image is, in the world."""
    x, y, z, w = Rotation.from_matrix(image.T_world_camera[:3, :3]).as_quat().tolist()
    transform = TransformStamped(header=Header(frame_id=WORLD), child_frame_id=optical_frame(image.name))
    tx, ty, tz = image.T_world_camera[:3, 3].tolist()
    transform.transform.translation = Vector3(x=tx, y=ty, z=tz)
    transform.transform.rotation = Quaternion(x=x, y=y, z=z, w=w)
    return transform
