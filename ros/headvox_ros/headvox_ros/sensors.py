"""Subscriptions to depth images, clouds and transforms; sets of readings out, in the target frame."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rclpy.lifecycle import LifecycleNode
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from tf2_msgs.msg import TFMessage

from headvox.data import Cloud, DepthImage, Frame
from headvox.errors import HeadvoxError
from headvox.machine.latest import Latest
from headvox.ros.losses import Losses
from headvox.ros.messages import cloud_points, depth_image, distortion_remark, intrinsics, stamp_ns
from headvox.ros.synchronise import NS, Reading, Synchroniser
from headvox.ros.transforms import NoTransform, TransformBuffer, set_from
from headvox_ros.statistics import Statistics

RELIABILITIES = {"best_effort": ReliabilityPolicy.BEST_EFFORT, "reliable": ReliabilityPolicy.RELIABLE}
DEPTH = 2  # messages that wait for us: a longer queue would only hold older ones
LOST = "Does every process use a profile for large messages (docs/ros.md), and is there time to receive them?"


class Sensors:
    """What a node hears of its sensors; :meth:`take` gives the newest set of readings that belong together.

    Callbacks do nothing but sort messages in: they are read by whoever takes the set, so that readings that a newer
    set replaces cost nothing.
    """

    def __init__(
        self,
        node: LifecycleNode,
        clouds: Sequence[str],
        depths: Sequence[str],
        camera_infos: Sequence[str],
        reliability: str,
        synchroniser: Synchroniser,
        statistics: Statistics,
    ) -> None:
        self.transforms = TransformBuffer()
        self.names = [*depths, *clouds]
        self._node = node
        self._statistics = statistics
        self._synchroniser = synchroniser
        self._losses = Losses()
        self._lock = threading.Lock()
        self._sets: Latest[list[Reading]] = Latest()
        self._infos: dict[str, CameraInfo] = {}
        self._stopped = False
        qos = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=DEPTH, reliability=RELIABILITIES[reliability])
        tf_qos = QoSProfile(depth=100)
        static_qos = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._subscriptions = [
            node.create_subscription(TFMessage, "/tf", lambda m: self._on_transforms(m, False), tf_qos),
            node.create_subscription(
                TFMessage, "/tf_static", lambda m: self._on_transforms(m, True), static_qos
            ),
        ]
        for topic in clouds:
            self._subscribe(PointCloud2, topic, self._on_reading, qos)
        for topic, info in zip(depths, camera_infos, strict=True):
            self._subscribe(Image, topic, self._on_reading, qos)
            self._subscribe(CameraInfo, info, self._on_info, qos, topic)

    def _subscribe(
        self, kind: Any, topic: str, callback: Callable[[str, Any], None], qos: QoSProfile, name: str = ""
    ) -> None:
        def heard(message: Any, info: Mapping[str, Any]) -> None:
            if lost := self._losses.before(info):
                self._statistics.problem("lost", f"{topic}: messages do not get here. {LOST}", lost)
            callback(name or topic, message)

        self._subscriptions.append(self._node.create_subscription(kind, topic, heard, qos))

    # ------------------------------------------------------------------------------------------------ the node's thread

    def _on_transforms(self, message: TFMessage, is_static: bool) -> None:
        set_from(self.transforms, message, is_static)

    def _on_info(self, name: str, message: CameraInfo) -> None:
        if name not in self._infos and (remark := distortion_remark(message, name)):
            self._node.get_logger().warning(remark)
        self._infos[name] = message

    def _on_reading(self, name: str, message: Any) -> None:
        now = time.monotonic()
        with self._lock:
            jumps = self._synchroniser.jumps
            sets = self._synchroniser.add(Reading(name, stamp_ns(message.header.stamp), now, message))
            if self._synchroniser.jumps > jumps:
                self.transforms.forget_moving()
            self._offer(sets)

    def _offer(self, sets: list[list[Reading]]) -> None:
        """Lay sets out; with the lock, or the other thread's newer ones would be laid out before."""
        for one in sets:
            self._sets.put(one)

    # ---------------------------------------------------------------------------------------------- the worker's thread

    def take(self, timeout_s: float) -> list[Reading] | None:
        """Return the newest set of readings, waiting at most ``timeout_s`` for one."""
        now = time.monotonic()
        with self._lock:
            self._offer(self._synchroniser.ready(now))
            timeout_s = min(timeout_s, max(0.001, self._synchroniser.next_s() - now))
        return self._sets.take(timeout_s)

    def read(self, readings: Sequence[Reading], target: str, tf_wait_s: float) -> Frame:
        """Return the readings as a frame; one that is damaged, or whose place is not known, is left out and counted.

        Raises:
            HeadvoxError: no reading is left.
        """
        read = [self._read_or_count(reading, target, tf_wait_s) for reading in readings]
        clouds = tuple(one for one in read if isinstance(one, Cloud))
        depths = tuple(one for one in read if isinstance(one, DepthImage))
        errors = [one for one in read if isinstance(one, HeadvoxError)]
        if errors and not clouds and not depths:
            raise errors[0]
        return Frame(max(reading.stamp_ns for reading in readings), clouds, depths)

    def _read_or_count(
        self, reading: Reading, target: str, tf_wait_s: float
    ) -> Cloud | DepthImage | HeadvoxError:
        try:
            return self._read(reading, target, tf_wait_s)
        except HeadvoxError as error:
            kind = "without_transform" if isinstance(error, NoTransform) else "bad_messages"
            reason = HeadvoxError(f"{reading.sensor}: {error.what}", error.do)
            self._statistics.problem(kind, str(reason))
            return reason

    def _read(self, reading: Reading, target: str, tf_wait_s: float) -> Cloud | DepthImage:
        message, name = reading.message, reading.sensor
        is_cloud = isinstance(message, PointCloud2)
        if not is_cloud and name not in self._infos:
            raise HeadvoxError("There was no camera_info yet.", "Check the parameter camera_infos.")
        source = message.header.frame_id
        T = self.transforms.wait_for(target, source, reading.stamp_ns, tf_wait_s, lambda: self._stopped)
        if is_cloud:
            return Cloud(name, cloud_points(message), T)
        depth, camera = depth_image(message), intrinsics(self._infos[name])
        if depth.shape != (camera.height, camera.width):
            raise HeadvoxError(
                f"The image is {depth.shape[1]} x {depth.shape[0]}, its camera_info {camera.width} x {camera.height}.",
                "Does the camera_info belong to this image?",
            )
        return DepthImage(name, depth, camera, T)

    # ------------------------------------------------------------------------------------------------------- any thread

    def alive(self) -> set[str]:
        """Return the sensors that something came from lately."""
        with self._lock:
            return self._synchroniser.alive(time.monotonic())

    def counts(self) -> dict[str, int]:
        """Return what was lost on the way, and why."""
        with self._lock:
            synchroniser = self._synchroniser
            return {
                "replaced_by_fresher": self._sets.replaced,
                "late": synchroniser.late,
                "clock_jumps": synchroniser.jumps,
                "refused_transforms": self.transforms.refused,
            }

    @property
    def jumps(self) -> int:
        """How often the sensors' clock went back."""
        return self._synchroniser.jumps

    def close(self) -> None:
        """Hear nothing more, and let whoever waits go."""
        self._stopped = True
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._sets.close()


def seconds_to_ns(seconds: float) -> int:
    """Return a duration in nanoseconds."""
    return round(seconds * NS)
