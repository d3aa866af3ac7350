"""Writes ROS 2 messages to an MCAP file without ROS; their definitions are in it, so that any viewer reads them."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from headvox.errors import HeadvoxError, MissingExtra
from headvox.ros.outputs import Content
from headvox.ros.synchronise import NS
from headvox.writable import check_file

# A builtin_interfaces/Time has 32 bits of seconds, with sign; an MCAP has no time before 1970.
STAMPS_END_NS = (1 << 31) * NS
CHUNK_BYTES = 256 << 10  # what is lost at most when the process is killed
# vision_msgs is in no distribution's common messages: these are its definitions in ROS 2 Humble and later.
_VISION = {
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "Detection3D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox3D bbox\nstring id",
    "Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
}


class McapFile:
    """An MCAP file that grows; closed by :meth:`close`, or by Ctrl-C through it, it is whole."""

    def __init__(self, path: Path) -> None:
        """Make ready to write; an older file is replaced by the first message: without one it stays.

        Raises:
            HeadvoxError: a package is missing, or the file cannot be made.
        """
        try:
            from mcap.writer import CompressionType, Writer
            from rosbags import typesys
        except ImportError as error:
            name = (error.name or "mcap").partition(".")[0]
            raise MissingExtra(f"MCAP files need the package {name!r}.", "bag") from None
        self.path = path
        self._store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        for name, definition in _VISION.items():
            self._store.register(typesys.get_types_from_msg(definition, f"vision_msgs/msg/{name}"))
        self._topics: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._writer_to = partial(Writer, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer: Any = None
        self._file: BinaryIO | None = None
        self._open = False
        check_file(path)

    def write(self, topic: str, kind: str, stamp_ns: int, content: Content) -> None:
        """Write a message of a type such as ``geometry_msgs/msg/PoseArray``, recorded at its own stamp.

        Raises:
            HeadvoxError: ROS cannot have that stamp, or the disk is full.
        """
        if not 0 <= stamp_ns < STAMPS_END_NS:
            raise HeadvoxError(
                f"Output {self.path}: expected stamps from 0 to 2^31 s, as ROS has them, got {stamp_ns} ns.",
                "Correct the stamps, or write a file of another kind.",
            )
        message = message_of(self._store, kind, content)
        data = bytes(self._store.serialize_cdr(message, kind))
        with self._whole():
            if self._writer is None:
                self._start()
            if topic not in self._topics:
                self._topics[topic] = self._writer.register_channel(topic, "cdr", self._schema(kind))
            self._writer.add_message(self._topics[topic], stamp_ns, data, stamp_ns)

    def _start(self) -> None:
        self._file = self.path.open("wb")
        self._writer = self._writer_to(self._file)
        self._writer.start("ros2")
        self._open = True

    def _schema(self, kind: str) -> int:
        if kind not in self._schemas:
            definition, _ = self._store.generate_msgdef(kind, ros_version=2)
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", definition.encode())
        return self._schemas[kind]

    def close(self) -> None:
        """Write the index and close the file."""
        if self._file is None or not self._open:
            return
        self._open = False
        finish: Callable[[], None] = self._writer.finish
        with self._whole():
            finish()
        self._file.close()

    @contextmanager
    def _whole(self) -> Iterator[None]:
        """Let nothing come between: half a record would spoil the file."""
        try:
            with uninterrupted():
                yield
                if self._file is not None:
                    self._file.flush()
        except OSError as error:
            self._open = False
            if self._file is not None:
                with suppress(OSError):
                    self._file.close()
            raise HeadvoxError(
                f"Output {self.path}: {error.strerror or error}.",
                "What was written before is got back with: mcap recover",
            ) from None


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C and SIGTERM back until the block is done; they come to the main thread only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda number, frame: held.append(number)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
        for came in held[:1]:
            signal.raise_signal(came)


def message_of(store: Any, kind: str, content: Content) -> Any:
    """Return a message of rosbags with these fields; others are zero or empty.

    Raises:
        KeyError: the type has no field of that name.
    """
    fields = dict(store.fielddefs[kind][1])
    values = {name: _zero(store, description) for name, description in fields.items() if name not in content}
    values |= {name: _value(store, fields[name], value) for name, value in content.items()}
    return store.types[kind](**values)


def _zero(store: Any, description: tuple[Any, Any]) -> Any:
    node, detail = description
    if node.name == "BASE":
        return "" if detail[0] == "string" else np.zeros((), detail[0]).item()
    if node.name == "NAME":
        return message_of(store, detail, {})
    (element, inner), size = detail
    return [] if element.name == "NAME" or inner[0] == "string" else np.zeros(size, inner[0])


def _value(store: Any, description: tuple[Any, Any], value: Any) -> Any:
    node, detail = description
    if node.name == "BASE":
        return value
    if node.name == "NAME":
        return message_of(store, detail, value)
    (element, inner), _ = detail
    return (
        [message_of(store, inner, one) for one in value]
        if element.name == "NAME"
        else np.asarray(value, inner[0])
    )
