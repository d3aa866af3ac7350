"""PCD files of the Point Cloud Library: ascii, binary and binary_compressed."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

import numpy as np

from headvox.data import F64
from headvox.errors import HeadvoxError
from headvox.frames import as_rigid, placed
from headvox.sources import lzf
from headvox.sources.check import Column, as_points
from headvox.sources.content import CloudFile
from headvox.sources.text import parse_numbers, too_many_numbers

_MAX_HEADER_BYTES = 1 << 16
_MAX_POINT_BYTES = 1 << 20
_TYPES = {("F", 4), ("F", 8), *((kind, size) for kind in "IU" for size in (1, 2, 4, 8))}
_DAMAGED = "The file is damaged or not complete."


@dataclass(frozen=True, slots=True)
class Field:
    """``count`` numbers of one type in each point."""

    name: str
    dtype: np.dtype[np.generic]
    count: int

    @property
    def size(self) -> int:
        """Bytes in a point."""
        return self.dtype.itemsize * self.count


@dataclass(frozen=True, slots=True)
class Header:
    """What stands before the body, which starts at the byte ``body_start``."""

    fields: tuple[Field, ...]
    points: int
    encoding: str
    T_world_sensor: F64 | None
    body_start: int


def read_pcd(data: bytes, name: str) -> CloudFile:
    """Read the bytes of a PCD file.

    x, y, z may stand anywhere among the fields and be floats or integers; other fields are skipped, and an
    organised cloud becomes a plain one. A VIEWPOINT other than the identity becomes ``T_world_sensor``.

    Args:
        data: the whole file.
        name: what the file is called in an error.

    Returns:
        The cloud in metres.

    Raises:
        HeadvoxError: no valid header, no x y z, or data that end early or do not decompress.
    """
    header = _header(data, name)
    body = memoryview(data)[header.body_start :]
    read = {"ascii": _ascii, "binary": _binary, "binary_compressed": _compressed}[header.encoding]
    columns = read(body, header, name) if header.points else dict.fromkeys("xyz", np.empty(0))
    points = as_points(*(columns[axis] for axis in "xyz"))
    return CloudFile(
        format=f"pcd, {header.encoding.replace('_', ' ')}",
        points=points,
        T_world_sensor=header.T_world_sensor,
        vertices=len(points),
        extra=tuple(f.name for f in header.fields if f.name not in ("x", "y", "z", "_")),
    )


def _header(data: bytes, name: str) -> Header:
    entries: dict[str, list[str]] = {}
    end = 0
    for line in re.finditer(rb"[^\n]*\n", data[:_MAX_HEADER_BYTES]):
        words = line.group().decode("utf-8", "replace").split()
        if words and not words[0].startswith("#"):
            entries[words[0]] = words[1:]
            if words[0] == "DATA":
                end = line.end()
                break
    encoding = " ".join(entries.get("DATA", ["missing"]))
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise HeadvoxError(
            f"{name}: the PCD header has DATA {encoding[:40]!r}, expected ascii, binary, binary_compressed.",
            _DAMAGED,
        )
    return Header(_fields(entries, name), _points(entries, name), encoding, _viewpoint(entries, name), end)


def _fields(entries: dict[str, list[str]], name: str) -> tuple[Field, ...]:
    names = entries.get("FIELDS", entries.get("COLUMNS", []))
    sizes = _integers(entries, "SIZE", name)
    types = entries.get("TYPE", [])
    counts = _integers(entries, "COUNT", name) if "COUNT" in entries else [1] * len(names)
    if not len(names) == len(sizes) == len(types) == len(counts):
        raise HeadvoxError(
            f"{name}: the PCD header has {len(names)} FIELDS, {len(sizes)} SIZE, {len(types)} TYPE and "
            f"{len(counts)} COUNT entries, expected as many of each.",
            _DAMAGED,
        )
    for kind, size in zip(types, sizes, strict=True):
        if (kind, size) not in _TYPES:
            raise HeadvoxError(
                f"{name}: the PCD header has a field of TYPE {kind[:9]} and SIZE {size}.", _DAMAGED
            )
    fields = tuple(
        Field(label, np.dtype(f"<{kind.lower()}{size}"), count)
        for label, kind, size, count in zip(names, types, sizes, counts, strict=True)
        if count > 0  # such a field takes no room
    )
    for axis in "xyz":
        if [f.count for f in fields if f.name == axis] != [1]:
            raise HeadvoxError(
                f"{name}: expected one field {axis!r} of COUNT 1, the FIELDS are {' '.join(names)[:80]!r}.",
                "Export the cloud with x, y, z.",
            )
    if sum(f.size for f in fields) > _MAX_POINT_BYTES:
        raise HeadvoxError(
            f"{name}: a point has more than {_MAX_POINT_BYTES} bytes by the PCD header.", _DAMAGED
        )
    return fields


def _integers(entries: dict[str, list[str]], key: str, name: str) -> list[int]:
    words = entries.get(key, [])
    for word in words:
        if not re.fullmatch(r"[0-9]{1,15}", word):
            raise HeadvoxError(
                f"{name}: the PCD header has {key} {word[:40]!r}, expected a whole number.", _DAMAGED
            )
    return [int(word) for word in words]


def _points(entries: dict[str, list[str]], name: str) -> int:
    numbers = {key: _integers(entries, key, name) for key in ("WIDTH", "HEIGHT", "POINTS") if key in entries}
    match numbers:
        case {"WIDTH": [width], "HEIGHT": [height], "POINTS": [points]} if width * height == points:
            return points
        case {"WIDTH": [width], "HEIGHT": [height], **rest} if not rest:
            return width * height
        case {"POINTS": [points], **rest} if not rest:
            return points
    raise HeadvoxError(
        f"{name}: the PCD header says {numbers}, expected WIDTH times HEIGHT to be POINTS.", _DAMAGED
    )


def _viewpoint(entries: dict[str, list[str]], name: str) -> F64 | None:
    words = entries.get("VIEWPOINT", ["0", "0", "0", "1", "0", "0", "0"])
    try:
        x, y, z, qw, qx, qy, qz = (float(word) for word in words)
    except ValueError:
        raise HeadvoxError(
            f"{name}: the PCD header has VIEWPOINT {' '.join(words)[:80]!r}, expected seven numbers.",
            _DAMAGED,
        ) from None
    norm2 = qw * qw + qx * qx + qy * qy + qz * qz
    if not abs(norm2 - 1.0) < 0.01:
        raise HeadvoxError(
            f"{name}: the quaternion of VIEWPOINT has the norm {norm2**0.5:.3g}, expected 1.",
            "Write VIEWPOINT 0 0 0 1 0 0 0 for a cloud that is in the world frame.",
        )
    T_world_sensor = as_rigid(placed((x, y, z), (qx, qy, qz, qw)), f"{name}: VIEWPOINT")
    return None if np.array_equal(T_world_sensor, np.eye(4)) else T_world_sensor


def _ascii(body: memoryview, header: Header, name: str) -> dict[str, Column]:
    numbers = parse_numbers(bytes(body), name)
    width = sum(f.count for f in header.fields)
    if len(numbers) < header.points * width:
        raise _truncated(header, len(numbers) // width, name)
    if len(numbers) > header.points * width:
        raise too_many_numbers(name, len(numbers), header.points * width)
    table = numbers.reshape(header.points, width)
    columns: dict[str, Column] = {}
    at = 0
    for f in header.fields:
        columns[f.name] = table[:, at]
        at += f.count
    return columns


def _binary(body: memoryview, header: Header, name: str) -> dict[str, Column]:
    """Points one after the other."""
    stride = sum(f.size for f in header.fields)
    if len(body) < header.points * stride:
        raise _truncated(header, len(body) // stride, name)
    columns: dict[str, Column] = {}
    at = 0
    for f in header.fields:
        if f.name in ("x", "y", "z"):
            columns[f.name] = np.ndarray((header.points,), f.dtype, body, at, (stride,))
        at += f.size
    return columns


def _compressed(body: memoryview, header: Header, name: str) -> dict[str, Column]:
    """Fields one after the other, all of them packed."""
    fields = [f for f in header.fields if f.name != "_"]  # the library leaves the padding out
    size = header.points * sum(f.size for f in fields)
    if len(body) < 8:
        raise _truncated(header, 0, name)
    packed_size, claimed_size = struct.unpack_from("<II", body)
    if packed_size > len(body) - 8 or claimed_size != size:
        raise HeadvoxError(
            f"{name}: {packed_size} bytes should unpack to {claimed_size}, expected {len(body) - 8} to "
            f"unpack to {size}.",
            _DAMAGED,
        )
    try:
        unpacked = lzf.decompress(bytes(body[8 : 8 + packed_size]), size)
    except ValueError as error:
        raise HeadvoxError(f"{name}: the compressed points are damaged: {error}.", _DAMAGED) from None
    columns: dict[str, Column] = {}
    at = 0
    for f in fields:
        if f.name in ("x", "y", "z"):
            columns[f.name] = np.frombuffer(unpacked, f.dtype, header.points, at)
        at += header.points * f.size
    return columns


def _truncated(header: Header, points: int, name: str) -> HeadvoxError:
    return HeadvoxError(
        f"{name}: the header promises {header.points} points, the file holds {points}.", _DAMAGED
    )
