"""NumPy files: npy and npz."""

from __future__ import annotations

import io
import math
import warnings
import zipfile
from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.errors import HeadvoxError
from headvox.sources.check import as_points
from headvox.sources.content import CloudFile

KEY = "points"
_MAX_COLUMNS = 64  # more, and it is an image or a transposed cloud
_MOST_EXPANSION = 100  # a compressed cloud shrinks to a third, hardly ever to a tenth
_ALWAYS_ALLOWED_BYTES = 16 << 20
_DAMAGED = "The file is damaged or not complete."
_SAVE_AS = "Save it as np.save(path, points) with points (N, 3) float32 in metres."

Values = npt.NDArray[Any]


def read_npy(data: bytes, name: str) -> CloudFile:
    """Read the bytes of an npy file.

    Args:
        data: the whole file: floats (N, 3 and more) or (H, W, 3 and more), of which the first three columns
            count, or a structured array with fields x, y, z.
        name: what the file is called in an error.

    Returns:
        The cloud in metres.

    Raises:
        HeadvoxError: damaged, Python objects, or another shape or type.
    """
    return _cloud("npy", _parse_npy(data, name), name)


def read_npz(data: bytes, name: str) -> CloudFile:
    """Read the bytes of an npz file: its only array, or the one called ``points``; else as :func:`read_npy`.

    Raises:
        HeadvoxError: also when there are several arrays and none is ``points``, or when the array is out of
            all proportion to the file.
    """
    most = _ALWAYS_ALLOWED_BYTES + _MOST_EXPANSION * len(data)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            member = archive.getinfo(_choose(archive.namelist(), name))
            with archive.open(member) as file:
                inside = file.read(most + 1)
    except HeadvoxError:
        raise
    except Exception as error:  # zipfile and its decompressors raise a dozen kinds on damaged files
        raise HeadvoxError(f"{name}: not a valid npz file: {_one_line(error)}.", _DAMAGED) from None
    if len(inside) > most:
        raise HeadvoxError(
            f"{name}: {len(data)} bytes hold an array of more than {most}, expected a cloud.",
            "Save it with np.savez(path, points=points).",
        )
    return _cloud("npz", _parse_npy(inside, name), name)


def _choose(members: list[str], name: str) -> str:
    arrays = [member for member in members if member.endswith(".npy")]
    if f"{KEY}.npy" in arrays:
        return f"{KEY}.npy"
    if len(arrays) == 1:
        return arrays[0]
    keys = ", ".join(member.removesuffix(".npy") for member in arrays)[:80] or "none"
    raise HeadvoxError(
        f"{name}: expected one array or one called {KEY!r}, the arrays are: {keys}.",
        f"Save it with np.savez(path, {KEY}=points).",
    )


def _parse_npy(data: bytes, name: str) -> Values:
    """Return the array without ever unpickling, and without memory beyond the data."""
    file = io.BytesIO(data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about headers of Python 2
            version = np.lib.format.read_magic(file)
            if version[0] == 1:
                shape, by_columns, dtype = np.lib.format.read_array_header_1_0(file)
            else:
                shape, by_columns, dtype = np.lib.format.read_array_header_2_0(file)
    except Exception as error:  # a hostile header makes Python's parser raise almost anything
        raise HeadvoxError(f"{name}: not a valid npy header: {_one_line(error)}.", _DAMAGED) from None
    if dtype.hasobject:
        raise HeadvoxError(
            f"{name}: holds Python objects, which are never loaded; expected floats.", _SAVE_AS
        )
    start, count = file.tell(), math.prod(shape)
    if any(n < 0 for n in shape) or dtype.itemsize == 0 or count * dtype.itemsize > len(data) - start:
        raise HeadvoxError(
            f"{name}: the header promises {shape} of {dtype}, the file has {len(data) - start} bytes.",
            _DAMAGED,
        )
    values = np.frombuffer(data, dtype, count, start) if count else np.empty(0, dtype)
    return values.reshape(shape, order="F" if by_columns else "C")


def _cloud(kind: str, values: Values, name: str) -> CloudFile:
    if values.dtype.names is not None:
        xyz = _fields(values, name)
        extra = tuple(label for label in values.dtype.names if label not in ("x", "y", "z"))
    else:
        xyz = _columns(values, name)
        extra = tuple(f"column {i}" for i in range(3, values.shape[-1]))
    points = as_points(*xyz)
    return CloudFile(f"{kind}, {values.dtype.name}", points, vertices=len(points), extra=extra)


def _fields(values: Values, name: str) -> Iterable[Values]:
    names = values.dtype.names or ()
    if not {"x", "y", "z"} <= set(names) or any(values.dtype[axis].shape for axis in "xyz"):
        raise HeadvoxError(f"{name}: expected the fields x, y, z, got {', '.join(names)[:80]}.", _SAVE_AS)
    if any(values.dtype[axis].kind not in "fiu" for axis in "xyz"):
        raise HeadvoxError(f"{name}: expected x, y, z as numbers, got {values.dtype['x']}.", _SAVE_AS)
    return (values[axis].reshape(-1) for axis in "xyz")


def _columns(values: Values, name: str) -> Iterable[Values]:
    if values.dtype.kind != "f":
        raise HeadvoxError(f"{name}: expected float32 or float64 points, got {values.dtype}.", _SAVE_AS)
    if values.ndim not in (2, 3) or not 3 <= values.shape[-1] <= _MAX_COLUMNS:
        raise HeadvoxError(f"{name}: expected shape (N, 3) or (H, W, 3), got {values.shape}.", _SAVE_AS)
    return values.reshape(-1, values.shape[-1])[:, :3].T


def _one_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120]
