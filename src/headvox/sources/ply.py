"""PLY files: vertices as points, faces as a surface that is sampled."""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from headvox.data import F32, I64
from headvox.errors import HeadvoxError
from headvox.mesh import sample_surface, triangulate
from headvox.sources.check import Column, as_points, check_cloud
from headvox.sources.content import CloudFile
from headvox.sources.text import parse_numbers, too_many_numbers

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_FACE_LISTS = ("vertex_indices", "vertex_index")
_LETTERS = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q", "f8": "d"}
_MAX_HEADER_BYTES = 1 << 20
_DAMAGED = "The file is damaged or not complete."

Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Property:
    """A number of each row, or a list of numbers when ``count_dtype`` is the type of its length."""

    name: str
    dtype: np.dtype[np.generic]
    count_dtype: np.dtype[np.generic] | None = None


@dataclass(frozen=True, slots=True)
class Element:
    """A table of the file."""

    name: str
    count: int
    properties: tuple[Property, ...]


@dataclass(frozen=True, slots=True)
class Table:
    """Where everything of an element lies in the body, in bytes.

    A row is its fixed part before the first list, that list, the fixed part before the next list, and so on.
    ``starts`` (rows, lists + 1) are the offsets of the fixed parts, ``lengths`` (rows, lists) those of the
    lists. Where all rows are alike both have one row, that of the first, and ``stride`` is the size of a row;
    else it is 0.
    """

    element: Element
    count: int
    starts: I64
    lengths: I64
    stride: int


def read_ply(data: bytes, name: str) -> CloudFile:
    """Read the bytes of a PLY file: its vertices and, where it has faces, samples of them.

    ASCII and binary of both byte orders; polygons of any size; other properties and elements are skipped.

    Args:
        data: the whole file.
        name: what the file is called in an error.

    Returns:
        The cloud in the frame of the vertices, metres.

    Raises:
        HeadvoxError: no valid header, no x y z, data that end early, faces that name no vertex, or a surface
            far too large.
    """
    encoding, body, tables = _open(data, name)
    vertex, face = tables["vertex"], tables.get("face")
    vertices, triangles = _surface(body, tables, name)
    return CloudFile(
        format=f"ply, {encoding.replace('_', ' ')}",
        points=sample_surface(vertices, triangles, name=name) if len(triangles) else vertices,
        vertices=len(vertices),
        faces=face.count if face else 0,
        extra=tuple(p.name for p in vertex.element.properties if p.name not in ("x", "y", "z")),
    )


def read_ply_mesh(data: bytes, name: str) -> tuple[F32, I64]:
    """Return the vertices (V, 3), metres, and the triangles (F, 3) of a PLY file, polygons cut up.

    Raises:
        HeadvoxError: as :func:`read_ply`.
    """
    _, body, tables = _open(data, name)
    return _surface(body, tables, name)


def _open(data: bytes, name: str) -> tuple[str, Bytes, dict[str, Table]]:
    """Return the encoding, the body, and where everything lies in it."""
    encoding, elements, body_start = _header(data, name)
    if encoding != "ascii":
        body = np.frombuffer(data, dtype=np.uint8, offset=body_start)
        return encoding, body, _tables(body, elements, name)[0]
    # An ASCII body becomes a binary one in which everything is a double.
    numbers = parse_numbers(data[body_start:], name)
    body = numbers.view(np.uint8)
    tables, end = _tables(body, elements, name)
    if len(tables) == len(elements) and end < len(body):
        raise too_many_numbers(name, len(numbers), end // 8)
    return encoding, body, tables


def _surface(body: Bytes, tables: dict[str, Table], name: str) -> tuple[F32, I64]:
    vertices = as_points(*(_scalars(body, tables["vertex"], axis, name) for axis in "xyz"))
    check_cloud(vertices, name)  # before a surface in millimetres fills the memory
    face = tables.get("face")
    return vertices, triangulate(_polygons(body, face) if face else ())


def _header(data: bytes, name: str) -> tuple[str, list[Element], int]:
    """Return the encoding, the elements, and where the body begins."""
    end = re.search(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r|$)", data[:_MAX_HEADER_BYTES])
    if end is None:
        raise HeadvoxError(f"{name}: the PLY header has no end_header line.", _DAMAGED)
    lines = data[: end.start()].decode("utf-8", "replace").splitlines()
    encoding = next((line.split()[1] for line in lines if re.match(r"format\s+\S", line)), "missing")
    if encoding not in _BYTE_ORDERS:
        raise HeadvoxError(
            f"{name}: the PLY format is {encoding[:40]!r}, expected ascii or binary_little_endian or "
            "binary_big_endian.",
            _DAMAGED,
        )
    elements: list[tuple[str, int, list[Property]]] = []
    for line in lines:
        match line.split():
            case [] | ["ply" | "format" | "comment" | "obj_info", *_]:
                pass
            case ["element", element, count] if re.fullmatch(r"[0-9]{1,15}", count):
                elements.append((element, int(count), []))
            case ["property", "list", count_type, item_type, _, *_] if elements:
                label = line.split(None, 4)[4].strip()  # some writers put blanks into names
                types = (_dtype(item_type, encoding, name), _length_dtype(count_type, encoding, name))
                elements[-1][2].append(Property(label, *types))
            case ["property", item_type, _, *_] if elements:
                label = line.split(None, 2)[2].strip()
                elements[-1][2].append(Property(label, _dtype(item_type, encoding, name)))
            case _:
                raise HeadvoxError(f"{name}: the PLY header has the line {line[:60]!r}.", _DAMAGED)
    return encoding, [Element(label, count, tuple(ps)) for label, count, ps in elements], end.end()


def _dtype(type_name: str, encoding: str, name: str) -> np.dtype[np.generic]:
    if type_name not in _TYPES:
        raise HeadvoxError(
            f"{name}: the PLY header has a property of type {type_name[:40]!r}, expected float, int, ...",
            _DAMAGED,
        )
    return np.dtype("f8") if encoding == "ascii" else np.dtype(_BYTE_ORDERS[encoding] + _TYPES[type_name])


def _length_dtype(type_name: str, encoding: str, name: str) -> np.dtype[np.generic]:
    dtype = _dtype(type_name, encoding, name)
    if dtype.kind == "f" and encoding != "ascii":
        raise HeadvoxError(f"{name}: the length of a list is a {type_name}, expected an integer.", _DAMAGED)
    return dtype


def _tables(body: Bytes, elements: Iterable[Element], name: str) -> tuple[dict[str, Table], int]:
    """Find where every row lies, up to the last element that is of use, and where that ends."""
    wanted = {"vertex", "face"} & {element.name for element in elements}
    tables: dict[str, Table] = {}
    start = 0
    for element in elements:
        if not wanted:
            break
        tables[element.name], start = _locate(body, start, element, name)
        wanted.discard(element.name)
    if "vertex" not in tables:
        raise HeadvoxError(f"{name}: the PLY file has no element 'vertex'.", _DAMAGED)
    return tables, start


def _locate(body: Bytes, start: int, element: Element, name: str) -> tuple[Table, int]:
    """Return where the rows of an element lie, and where the next element starts."""
    fixed, lists = _layout(element)
    least = sum(fixed) + sum(length.size for length, _ in lists)
    truncated = HeadvoxError(
        f"{name}: the header promises {element.count} rows of {element.name[:40]!r}, the file has less.",
        _DAMAGED,
    )
    if element.count == 0 or least == 0:
        nothing = np.empty((0, len(fixed)), np.int64), np.empty((0, len(lists)), np.int64)
        return Table(element, 0, *nothing, stride=0), start
    if element.count * least > len(body) - start:  # before anything as large is made or walked
        raise truncated
    try:
        starts, lengths, end = _walk(body.data, start, 1, fixed, lists)
        alike = Table(element, element.count, starts, lengths, stride=end - start)
        if _all_alike(body, alike):
            return alike, start + element.count * alike.stride
        starts, lengths, end = _walk(body.data, start, element.count, fixed, lists)
    except (struct.error, ValueError, OverflowError):
        raise truncated from None
    if end > len(body):
        raise truncated
    return Table(element, element.count, starts, lengths, stride=0), end


def _layout(element: Element) -> tuple[list[int], list[tuple[struct.Struct, int]]]:
    """Return the sizes of the fixed parts, and of each list the reader of its length and an item's size."""
    fixed = [0]
    lists = []
    for p in element.properties:
        if p.count_dtype is None:
            fixed[-1] += p.dtype.itemsize
        else:
            fixed.append(0)
            lists.append((_length_reader(p.count_dtype), p.dtype.itemsize))
    return fixed, lists


def _length_reader(dtype: np.dtype[np.generic]) -> struct.Struct:
    """Return the struct twin of a dtype; reading one number with it is ten times as fast."""
    return struct.Struct((">" if dtype.str[0] == ">" else "<") + _LETTERS[dtype.str[1:]])


def _walk(
    body: memoryview, start: int, count: int, fixed: list[int], lists: list[tuple[struct.Struct, int]]
) -> tuple[I64, I64, int]:
    """Go through rows whose lists differ in length; only the end of one tells where the next begins."""
    starts, lengths = array("q"), array("q")
    at = start
    for _ in range(count):
        for skip, (reader, item_size) in zip(fixed, lists, strict=False):
            starts.append(at)
            at += skip
            (length,) = reader.unpack_from(body, at)
            if not 0 <= length <= len(body):  # NaN, too
                raise ValueError
            length = int(length)
            lengths.append(length)
            at += reader.size + length * item_size
        starts.append(at)
        at += fixed[-1]
    return (
        np.array(starts, dtype=np.int64).reshape(count, len(fixed)),
        np.array(lengths, dtype=np.int64).reshape(count, len(lists)),
        at,
    )


def _all_alike(body: Bytes, table: Table) -> bool:
    """Do all rows have lists as long as those of the first?"""
    if table.starts[0, 0] + table.count * table.stride > len(body):
        return False
    return all(
        (_values(body, table, part, offset, p.count_dtype) == table.lengths[0, part]).all()
        for p, part, offset in _places(table.element)
        if p.count_dtype is not None
    )


def _places(element: Element) -> Iterator[tuple[Property, int, int]]:
    """Yield each property, the fixed part it is in or, as a list, ends, and the offset there."""
    part, offset = 0, 0
    for p in element.properties:
        yield p, part, offset
        part, offset = (part, offset + p.dtype.itemsize) if p.count_dtype is None else (part + 1, 0)


def _values(
    body: Bytes,
    table: Table,
    part: int,
    offset: int,
    dtype: np.dtype[np.generic],
    length: int = 1,
    rows: I64 | slice = slice(None),
) -> Column:
    """Return the ``length`` values that stand at an offset in a fixed part, (rows, length)."""
    if table.stride:
        first = int(table.starts[0, part]) + offset
        strides = (table.stride, dtype.itemsize)
        return np.ndarray((table.count, length), dtype, body.data, first, strides)
    windows = np.lib.stride_tricks.sliding_window_view(body, length * dtype.itemsize)
    return windows[table.starts[rows, part] + offset].view(dtype)


def _scalars(body: Bytes, table: Table, label: str, name: str) -> Column:
    """Return one number of each row, (rows,)."""
    for p, part, offset in _places(table.element):
        if p.name == label and p.count_dtype is None:
            return _values(body, table, part, offset, p.dtype)[:, 0] if table.count else np.empty(0, p.dtype)
    have = ", ".join(p.name for p in table.element.properties) or "none"
    raise HeadvoxError(f"{name}: the vertices have no {label!r}, only {have[:80]!r}.", "Export x, y, z.")


def _polygons(body: Bytes, table: Table) -> Iterator[I64]:
    """Yield the polygons as vertex indices (rows, corners), an array for each number of corners there is."""
    for indices in _lists(body, table, _FACE_LISTS):
        with np.errstate(invalid="ignore"):  # what is no index becomes a negative one, which is refused later
            yield indices.astype(np.int64)


def _lists(body: Bytes, table: Table, labels: tuple[str, ...]) -> Iterator[Column]:
    """Yield the lists of one property, (rows, length) for each length there is; nothing if it is missing."""
    for p, part, offset in _places(table.element):
        if p.name not in labels or p.count_dtype is None:
            continue
        offset += p.count_dtype.itemsize
        if table.stride:
            yield _values(body, table, part, offset, p.dtype, int(table.lengths[0, part]))
        elif table.count:
            by_length = np.argsort(table.lengths[:, part], kind="stable")
            lengths = table.lengths[by_length, part]
            for rows in np.split(by_length, np.flatnonzero(np.diff(lengths)) + 1):
                yield _values(body, table, part, offset, p.dtype, int(table.lengths[rows[0], part]), rows)
        return
