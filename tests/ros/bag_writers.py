"""Bags of every kind, written by the libraries of others, and messages of sensors for them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROS2 = get_typestore(Stores.ROS2_JAZZY)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))

KINDS = (
    "ros1", "ros1-bz2", "ros1-lz4", "db3", "db3-message", "db3-file", "mcap", "mcap-storage", "mcap-message",
    "mcap-file", "bare-mcap", "bare-mcap-zstd", "bare-mcap-lz4", "bare-mcap-flat",
)  # fmt: skip
NS = 1_000_000_000
Message = tuple[str, int, Any]  # topic, time of recording in nanoseconds, message


class Maker:
    """Makes messages of ROS 1 or 2."""

    def __init__(self, is_ros1: bool = False) -> None:
        self.is_ros1 = is_ros1
        self.types = (ROS1 if is_ros1 else ROS2).types

    def header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, NS))
        more = {"seq": 7} if self.is_ros1 else {}
        return self.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **more)

    def depth(self, stamp_ns: int, frame: str, values: np.ndarray, encoding: str | None = None) -> Any:
        height, width = values.shape
        return self.types["sensor_msgs/msg/Image"](
            self.header(stamp_ns, frame), height, width, encoding or {"u": "16UC1", "f": "32FC1"}[values.dtype.kind],
            int(values.dtype.byteorder == ">"), width * values.itemsize, np.frombuffer(values.tobytes(), np.uint8),
        )  # fmt: skip

    def info(self, stamp_ns: int, frame: str, camera: Any) -> Any:
        fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
        k, p = [fx, 0, cx, 0, fy, cy, 0, 0, 1], [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]
        roi = self.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        d, k, r, p = (np.array(values, np.float64) for values in (np.zeros(5), k, np.eye(3).ravel(), p))
        return self.types["sensor_msgs/msg/CameraInfo"](
            self.header(stamp_ns, frame), camera.height, camera.width, "plumb_bob", d, k, r, p, 0, 0, roi
        )

    def cloud(self, stamp_ns: int, frame: str, points: np.ndarray, **layout: Any) -> Any:
        """A cloud of points (N, 3) or (H, W, 3); ``layout``: dtype of a coordinate, big, gap, padding."""
        grid = points.reshape(-1, *points.shape[-2:]) if points.ndim == 3 else points[None]
        height, width = grid.shape[:2]
        dtype = np.dtype(layout.get("dtype", "f4")).newbyteorder(">" if layout.get("big") else "<")
        gap, padding = layout.get("gap", 4), layout.get("padding", 0) if height > 1 else 0
        step = gap + 3 * dtype.itemsize
        rows = np.zeros((height, width * step + padding), np.uint8)
        for v in range(height):
            coordinates = np.ascontiguousarray(grid[v].astype(dtype)).view(np.uint8).reshape(width, -1)
            rows[v, : width * step].reshape(width, step)[:, gap:] = coordinates
        code = {("f", 4): 7, ("f", 8): 8, ("i", 4): 5, ("i", 2): 3}[dtype.kind, dtype.itemsize]
        field = self.types["sensor_msgs/msg/PointField"]
        fields = [field(name, gap + dtype.itemsize * k, code, 1) for k, name in enumerate("xyz")]
        return self.types["sensor_msgs/msg/PointCloud2"](
            self.header(stamp_ns, frame), height, width, fields, bool(layout.get("big")), step,
            width * step + padding, rows.ravel(), True,
        )  # fmt: skip

    def transform(self, stamp_ns: int, parent: str, child: str, T: np.ndarray) -> Any:
        from scipy.spatial.transform import Rotation

        kinds = self.types
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        turn = kinds["geometry_msgs/msg/Quaternion"](float(x), float(y), float(z), float(w))
        move = kinds["geometry_msgs/msg/Vector3"](*(float(v) for v in T[:3, 3]))
        stamped = kinds["geometry_msgs/msg/TransformStamped"](
            self.header(stamp_ns, parent), child, kinds["geometry_msgs/msg/Transform"](move, turn)
        )
        return kinds["tf2_msgs/msg/TFMessage"]([stamped])


def write_bag(
    folder: Path, kind: str, messages: list[Message], name: str = "rig", chunk_bytes: int = 1 << 20
) -> Path:
    """Write messages, made by a Maker that fits the kind, and return the path; only bare MCAPs heed chunk_bytes."""
    kind, _, compression = kind.partition("-")
    if kind == "ros1":
        return _write_ros1(folder / f"{name}.bag", compression, messages)
    if kind == "bare":
        compression = compression.removeprefix("mcap").removeprefix("-")
        return _write_bare(folder / f"{name}.mcap", compression, messages, chunk_bytes)
    plugin = {"db3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}[kind]
    writer = rosbag2.Writer(folder / name, version=9, storage_plugin=plugin)
    if compression:
        writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        topics = {}
        for topic, logged_ns, message in messages:
            kind = getattr(message, "__msgtype__", "sensor_msgs/msg/Image")
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=ROS2)
            writer.write(topics[topic], logged_ns, _bytes(message))
    return folder / name


def _bytes(message: Any) -> Any:
    return message if isinstance(message, bytes) else ROS2.serialize_cdr(message, message.__msgtype__)


def _write_ros1(path: Path, compression: str, messages: list[Message]) -> Path:
    writer = rosbag1.Writer(path)
    if compression:
        writer.set_compression(writer.CompressionFormat[compression.upper()])
    with writer:
        topics = {}
        for topic, logged_ns, message in messages:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, message.__msgtype__, typestore=ROS1)
            writer.write(topics[topic], logged_ns, ROS1.serialize_ros1(message, message.__msgtype__))
    return path


def _write_bare(path: Path, compression: str, messages: list[Message], chunk_bytes: int) -> Path:
    kinds = {"": "NONE", "flat": "NONE", "zstd": "ZSTD", "lz4": "LZ4"}
    with path.open("wb") as file:
        writer = Writer(
            file,
            chunk_bytes,
            compression=CompressionType[kinds[compression]],
            use_chunking=compression != "flat",
        )
        writer.start("ros2", "a test")
        topics = {}
        for topic, logged_ns, message in messages:
            if topic not in topics:
                kind = getattr(message, "__msgtype__", "sensor_msgs/msg/Image")
                schema = writer.register_schema(
                    kind, "ros2msg", ROS2.generate_msgdef(kind, ros_version=2)[0].encode()
                )
                topics[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(topics[topic], logged_ns, _bytes(message), logged_ns)
        writer.finish()
    return path
