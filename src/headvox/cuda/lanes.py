"""How a loop is compiled for the device, and what a rule of the CPU means there: a lane is a thread.

The CPU's rules are written in operations on lanes (:mod:`headvox.machine.simd`). On the device each of these is an
operation on one number, so that the same source says what is computed, here and there. Numba's simulator runs plain
Python functions, one thread after the other.
"""

from __future__ import annotations

import math
import threading
import warnings
from collections.abc import Callable
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
from numba import cuda
from numba.core import config

from headvox.integral import box_sum, sum_about

SIMULATED = bool(getattr(config, "ENABLE_CUDASIM", 0))

Loop = Callable[..., Any]

# Numba warns of every launch of few blocks, but some stages look at a few peaks only.
warnings.filterwarnings("ignore", r"Grid size \d+ will likely result in GPU under-utilization")


def kernel(function: Loop) -> Any:
    """Compile ``function`` as a kernel; it is started as ``function[blocks, threads, stream](...)``."""
    return cuda.jit(function)


def device(function: Loop) -> Loop:
    """Compile ``function`` to be called by kernels."""
    compiled: Loop = function if SIMULATED else cuda.jit(device=True)(function)
    return compiled


def on_device(rule: Any, **names: object) -> Loop:
    """Return a rule of the CPU for the device, with ``names`` in place of what it calls so."""
    source = rule.py_func
    scope = {**source.__globals__, **names}
    return device(FunctionType(source.__code__, scope, source.__name__, source.__defaults__))


def _math() -> ModuleType:
    """Return what stands for NumPy in a rule of one number: NumPy's functions are not there on the device."""
    if SIMULATED:
        return np
    stand_in = ModuleType("math_on_device")
    for name in ("sqrt", "exp", "log", "sin", "cos", "floor", "ceil", "isfinite", "inf", "nan"):
        setattr(stand_in, name, getattr(math, name))
    vars(stand_in).update(arctan2=math.atan2, float64=np.float64, int64=np.int64, uint64=np.uint64)
    return stand_in


MATH = _math()


@device
def fill(value):
    """Return ``value``."""
    return value


@device
def load(flat, at):
    """Return the item of ``flat`` at ``at``."""
    return flat[at]


@device
def store(flat, at, value):
    """Set the item of ``flat`` at ``at``."""
    flat[at] = value


@device
def total(a):
    """Return ``a``, the sum of all lanes."""
    return a


@device
def add(a, b):
    """Return a + b."""
    return a + b


@device
def sub(a, b):
    """Return a - b."""
    return a - b


@device
def times(a, factor):
    """Return a * factor, of whole numbers."""
    return a * factor


@device
def bit_and(a, b):
    """Return a & b."""
    return a & b


@device
def shift_right(a, count):
    """Return a >> count."""
    return a >> count


@device
def below(a, b):
    """Return 1 if a < b, else 0."""
    return 1 if a < b else 0


@device
def less(a, b):
    """Return 1 if a < b, else 0."""
    return 1 if a < b else 0


@device
def within(a, low, high):
    """Return 1 if low <= a <= high, else 0."""
    return 1 if np.int64(low) <= a <= np.int64(high) else 0


@device
def floored(value):
    """Return the whole number at or below ``value``: NumPy's floor is not there on the device."""
    return np.int64(math.floor(value))


@device
def smaller(a, b):
    """Return the smaller of two."""
    return min(a, b)


@device
def larger(a, b):
    """Return the larger of two."""
    return max(a, b)


if SIMULATED:

    def wait_for_block() -> None:
        """Wait for all threads of the block: the simulator knows cuda.syncthreads in a kernel's own file only."""
        thread: Any = threading.current_thread()
        thread.syncthreads()

    @device
    def mul(a, b):
        """Return a * b."""
        return a * b

    product_32 = product_64 = mul
else:
    from numba.cuda import libdevice

    wait_for_block = cuda.syncthreads

    # A product that is rounded, whatever it is added to: the compiler may not contract it to a fused operation.
    @device
    def product_32(a, b):
        """Return a * b of two float32, rounded."""
        return libdevice.fmul_rn(a, b)

    @device
    def product_64(a, b):
        """Return a * b of two float64, rounded."""
        return libdevice.dmul_rn(a, b)

    mul = product_32


LANE_WISE = {
    "LANES": 1,
    "fill": fill,
    "load": load,
    "store": store,
    "add": add,
    "sub": sub,
    "mul": mul,
    "times": times,
    "bit_and": bit_and,
    "shift_right": shift_right,
    "below": below,
    "less": less,
    "within": within,
    "smaller": smaller,
    "larger": larger,
}
"""Names of :mod:`headvox.machine.simd`, and what they are on the device."""

sum_about_voxel = on_device(sum_about, box_sum=on_device(box_sum))
"""The sum over a box about a voxel, cut off at the edges of the integral volume: it needs no margins."""
