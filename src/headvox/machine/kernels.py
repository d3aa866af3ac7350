"""The one way a loop is compiled.

Every kernel is a module-level function with ``@kernel``: compiled once, cached on disk beside its source file.
Loops release the GIL, so a frame is split over plain threads (:mod:`headvox.machine.threads`): the same compiled loop
runs on a part of the rows, whatever the number of threads, and integer results make the split invisible in the output.

Kernels and rules have no type hints: one serves arrays of several integer types, and Numba infers them. The public
function beside each has them. The type checker is told which modules hold kernels in pyproject.toml, and a test sees
to it that nothing else goes without.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import numpy.typing as npt


def _source_stamp() -> tuple[str, int]:
    """Return a stamp that changes when any file of the package does."""
    check = 0
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        check = zlib.crc32(path.read_bytes(), check)
    return ("headvox", check)


STAMP = _source_stamp()


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile ``function``: cached, without the GIL, IEEE arithmetic (no contraction, no reordering)."""
    return _compiled(function)


def bare_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """As :func:`kernel`, for a ``function`` that allocates nothing: its arrays are not reference-counted.

    A count is a call, which the compiler can neither move nor keep a vector in a register across.
    """
    return _compiled(function, _nrt=False)


def _compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    njit: Any = numba.njit
    compiled: Any = njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    # Numba's cache looks at the date of the kernel's own file only: it would run on with an old rule when a rule of
    # another file is edited, or when a new version is installed with equal dates.
    cache_file = getattr(compiled._cache, "_cache_file", None)
    if cache_file is not None:
        cache_file._source_stamp = STAMP
    loop: Callable[..., Any] = compiled
    return loop


def rule(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a scalar rule that kernels of the same file inline."""
    compiled: Callable[..., Any] = numba.njit(inline="always", error_model="numpy")(function)
    return compiled


def read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a view of ``array`` (a C-contiguous copy, if it is not) that cannot be written to.

    Numba compiles a loop anew for arrays that must not be written, such as lie in a file or in a camera's buffer.
    Whatever comes from outside goes through this, so each loop is compiled once.
    """
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view


@rule
def product(a, b):
    """Return a * b, rounded, of two floating-point numbers whose product is added to something.

    It has a name because a compiler for GPUs would make a * b + c one operation that rounds once: there, and only
    there, another function stands for it (see :mod:`headvox.cuda.lanes`), and the bits are the same everywhere.
    """
    return a * b
