"""Bags of ROS 1 (.bag) and ROS 2 (sqlite3, MCAP), read without ROS by the library rosbags.

A bag comes from anywhere and may lie: definitions of messages that it brings along are not used (those of the few types
that are read here never changed on the wire), and nothing is unpacked to more than a limit.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO

from headvox.errors import HeadvoxError, MissingExtra

IMAGE, CAMERA_INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
CLOUD = "sensor_msgs/msg/PointCloud2"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")  # the second is that of the first years of ROS 1
METADATA = "metadata.yaml"
MOST_UNPACKED_BYTES = 1 << 30  # of one message or chunk: a hundred times the largest cloud
MOST_METADATA_BYTES = 16 << 20
_MOST_EXPANSION = 1000  # of a bag that is compressed as a whole
_PIECE = 1 << 20
_AT_ONCE = 64 << 20
_FIRST_FEW = 10
_ROS1, _MCAP, _SQLITE = b"#ROSBAG V", b"\x89MCAP0\r\n", b"SQLite format 3\x00"
_TF_DEFINITION = "geometry_msgs/TransformStamped[] transforms"


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag: the type is the name that ROS 2 has for it."""

    name: str
    type: str
    count: int


def is_bag(place: Path) -> bool:
    """Tell whether a file begins like a bag, or a folder has the metadata of one."""
    if place.is_dir():
        return (place / METADATA).is_file()
    if not place.is_file():  # a pipe could block for ever
        return False
    with place.open("rb") as file:
        return file.read(16).startswith((_ROS1, _MCAP, _SQLITE))


class Bag:
    """An open bag: its topics, and their messages in the order they were recorded."""

    def __init__(self, place: Path) -> None:
        """Open a file or a folder.

        Raises:
            HeadvoxError: rosbags is not installed, or the bag is damaged or of an unknown kind.
        """
        rosbags = _rosbags()
        self.name = place.name or str(place)
        self.kind, reader = _reader(rosbags, place)
        self._reader = reader
        self._is_ros1 = self.kind == "ROS 1 bag"
        self._store = rosbags.ros1 if self._is_ros1 else rosbags.ros2
        try:
            reader.open()
            self._connections = list(reader.connections)
            kinds = {c.topic: c.msgtype for c in self._connections}
            counts = dict.fromkeys(kinds, 0)
            for connection in self._connections:
                counts[connection.topic] += connection.msgcount
        except Exception as error:  # a damaged bag makes rosbags raise almost anything
            raise _damaged(self.name, self.kind, error) from None
        self.topics = {name: Topic(name, kind, counts[name]) for name, kind in sorted(kinds.items())}
        self._open = True

    def messages(self, topics: set[str]) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic, time of recording in nanoseconds, and bytes of the messages of these topics.

        Raises:
            HeadvoxError: the bag is damaged from here on.
        """
        connections = [connection for connection in self._connections if connection.topic in topics]
        if not connections:
            return
        try:
            for connection, logged_ns, data in self._reader.messages(connections):
                yield connection.topic, logged_ns, data
        except Exception as error:
            raise _damaged(self.name, self.kind, error) from None

    def decode(self, topic: str, data: bytes) -> Any:
        """Return a message, with the field names of ROS 2.

        Raises:
            HeadvoxError: it is damaged.
        """
        kind = self.topics[topic].type
        try:
            if not self._is_ros1:
                return self._store.deserialize_cdr(data, kind)
            message = self._store.deserialize_ros1(data, kind)
        except Exception as error:  # lengths that lie make it raise almost anything
            raise HeadvoxError(f"{topic}: the message is damaged: {_one_line(error)}.") from None
        if kind == CAMERA_INFO:  # D, K, R and P were capitals
            return SimpleNamespace(**{name.lower(): value for name, value in vars(message).items()})
        return message

    def first(self, topic: str) -> Any:
        """Return the first message of a topic that is not damaged, of the first few; else None."""
        for _, _, data in islice(self.messages({topic}), _FIRST_FEW):
            with suppress(HeadvoxError):
                return self.decode(topic, data)
        return None

    def close(self) -> None:
        """Close the file; any iteration ends with an error."""
        if self._open:
            self._open = False
            self._reader.close()


def _reader(rosbags: SimpleNamespace, place: Path) -> tuple[str, Any]:
    """Choose the reader by how the file begins."""
    if place.is_dir():
        if (place / METADATA).stat().st_size > MOST_METADATA_BYTES:
            raise HeadvoxError(f"{place / METADATA}: expected at most {MOST_METADATA_BYTES} bytes.", "")
        return "ROS 2 bag", rosbags.folder(place)
    with place.open("rb") as file:
        head = file.read(16)
    for magic, kind, reader in (
        (_ROS1, "ROS 1 bag", rosbags.bag1),
        (_MCAP, "MCAP", rosbags.mcap),
        (_SQLITE, "ROS 2 bag, sqlite3", rosbags.sqlite),
    ):
        if head.startswith(magic):
            return kind, reader(place)
    raise HeadvoxError(f"{place.name}: expected a bag, it begins with {head[:12]!r}.", "Is it one?")


def _damaged(name: str, kind: str, error: Exception) -> HeadvoxError:
    """Say what is wrong with a bag as a whole."""
    if isinstance(error, HeadvoxError):
        return error
    # Its readers take a byte where there is none, at the end of a file, for one: ord() of nothing is a TypeError.
    reason = "it ends too early" if isinstance(error, TypeError) else _one_line(error)
    if "end magic" in reason or "footer" in reason:
        return HeadvoxError(
            f"{name}: the MCAP file has no end: it was not closed when it was recorded, or not copied whole.",
            "Repair it with: mcap recover",
        )
    if "not indexed" in reason:
        return HeadvoxError(f"{name}: the bag has no index: it was not closed.", "Repair it: rosbag reindex")
    do = "More of it may be got back with: mcap recover" if kind == "MCAP" else "Is it complete?"
    return HeadvoxError(f"{name}: the bag is damaged: {reason}.", do)


def _one_line(error: Exception) -> str:
    return ((str(error).splitlines() or [""])[0][:160] or type(error).__name__).rstrip(".")


# ------------------------------------------------------------------------------------------------------ rosbags

_loaded: list[SimpleNamespace] = []


def _rosbags() -> SimpleNamespace:
    """Return what is used of the library, imported the first time it is needed."""
    if _loaded:
        return _loaded[0]
    try:
        from rosbags import rosbag1, rosbag2, typesys
        from rosbags.rosbag1 import reader as reader1
        from rosbags.rosbag2 import reader as reader2
        from rosbags.rosbag2 import storage_mcap, storage_sqlite3
    except ImportError as error:
        raise MissingExtra(f"Bags need the package {error.name or 'rosbags'!r}.", "bag") from None
    _bound(reader1.decompressors, storage_mcap.DECOMPRESSORS, reader2)
    ros1 = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    for name in TRANSFORMS:
        ros1.register(typesys.get_types_from_msg(_TF_DEFINITION, name))
    _loaded.append(
        SimpleNamespace(
            bag1=rosbag1.Reader,
            folder=rosbag2.Reader,
            mcap=storage_mcap.McapReader,
            sqlite=storage_sqlite3.Sqlite3Reader,
            ros1=ros1,
            ros2=typesys.get_typestore(typesys.Stores.ROS2_HUMBLE),
        )
    )
    return _loaded[0]


def _bound(of_ros1: dict[str, Any], of_mcap: dict[str, Any], folder_reader: Any) -> None:
    """Give rosbags decompressors that stop at a limit: its own unpack whatever a few bytes swell to."""
    import bz2

    import lz4.frame

    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd

    def unpack(make: Callable[[], Any]) -> Callable[..., bytes]:
        return lambda data, size=None: bounded(make(), data, size)

    of_ros1.update(bz2=unpack(bz2.BZ2Decompressor), lz4=unpack(lz4.frame.LZ4FrameDecompressor))
    of_mcap.update(lz4=unpack(lz4.frame.LZ4FrameDecompressor), zstd=unpack(zstd.ZstdDecompressor))
    folder_reader.zstd = SimpleNamespace(
        decompress=unpack(zstd.ZstdDecompressor),
        open=lambda file, mode: _BoundedFile(file, zstd.open(file, mode)),
    )


def bounded(decompressor: Any, data: bytes, size: int | None = None) -> bytes:
    """Return what ``data`` unpacks to, or raise ValueError when that is more than ``size`` or the limit."""
    most = MOST_UNPACKED_BYTES if size is None else min(size, MOST_UNPACKED_BYTES)
    # Some decompressors set aside as much as they are allowed to return: not the whole limit at once.
    pieces = [decompressor.decompress(data, max_length=min(most + 1, _AT_ONCE))]
    total = len(pieces[0])
    while pieces[-1] and total <= most and not decompressor.eof:
        pieces.append(decompressor.decompress(b"", max_length=min(most + 1 - total, _AT_ONCE)))
        total += len(pieces[-1])
    if total > most:
        raise ValueError(f"it unpacks to more than {most} bytes")
    if not decompressor.eof:
        raise ValueError("the compressed data is cut off")
    return pieces[0] if len(pieces) == 1 else b"".join(pieces)


class _BoundedFile:
    """A compressed file that refuses to become much larger than it is."""

    def __init__(self, packed: BinaryIO, unpacked: Any) -> None:
        size = packed.seek(0, 2)
        packed.seek(0)
        self._left = MOST_UNPACKED_BYTES + _MOST_EXPANSION * size
        self._unpacked = unpacked

    def read(self, size: int = _PIECE) -> bytes:
        piece: bytes = self._unpacked.read(min(size, _PIECE))
        self._left -= len(piece)
        if self._left < 0:
            raise ValueError("it unpacks to far more than a bag of its size")
        return piece

    def __enter__(self) -> _BoundedFile:
        return self

    def __exit__(self, *error: object) -> None:
        self._unpacked.close()
