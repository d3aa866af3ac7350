"""Vectors of 32 integers inside kernels, where a loop over arrays leaves too much to the compiler's luck.

A kernel holds a :class:`Lanes` in registers, so a test of 32 voxels ends in one 32-bit number, and a branch on it being
0 is the early exit. What is emitted is LLVM's own vector code and nothing of any processor: the compiler makes one
AVX-512 instruction of it, two for AVX2 or four for NEON, with the same results. All arithmetic wraps around.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import extending, types
from numba.core import cgutils
from numba.extending import models, register_model

LANES = 32

# Numba's hints tell what an intrinsic looks like to the compiler, and not how a kernel calls it.
intrinsic: Callable[[Callable[..., Any]], Callable[..., Any]] = extending.intrinsic


class Lanes(types.Type):
    """Numba's type for :data:`LANES` integers of so many bits, of which most operations need not know the sign."""

    def __init__(self, bits: int) -> None:
        self.scalar = types.Integer.from_bitwidth(bits)
        super().__init__(f"Lanes({self.scalar})")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        scalar = dmm.lookup(fe_type.scalar).get_value_type()
        super().__init__(dmm, fe_type, ir.VectorType(scalar, LANES))  # type: ignore[no-untyped-call]


@intrinsic
def load(typingctx, flat, at):  # type: ignore[no-untyped-def]
    """Return ``flat[at : at + LANES]`` of a C-contiguous array."""

    def emit(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.load(_pointer(context, builder, signature, arguments), align=_size(flat.dtype))

    return Lanes(flat.dtype.bitwidth)(flat, at), emit


@intrinsic
def store(typingctx, flat, at, lanes):  # type: ignore[no-untyped-def]
    """Set ``flat[at : at + LANES]`` of a C-contiguous array."""

    def emit(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        pointer = _pointer(context, builder, signature, arguments)
        builder.store(arguments[2], pointer, align=_size(flat.dtype))
        return context.get_dummy_value()

    return types.void(flat, at, lanes), emit


@intrinsic
def fill(typingctx, value):  # type: ignore[no-untyped-def]
    """Return ``value`` in every lane, in its own type."""

    def emit(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return _spread(builder, arguments[0])

    return Lanes(value.bitwidth)(value), emit


@intrinsic
def add(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return a + b, lane by lane."""
    return _two(a, b, lambda builder, x, y: builder.add(x, y))


@intrinsic
def sub(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return a - b, lane by lane."""
    return _two(a, b, lambda builder, x, y: builder.sub(x, y))


@intrinsic
def times(typingctx, a, factor):  # type: ignore[no-untyped-def]
    """Return a * factor, a number of the lanes' type, lane by lane."""

    def emit(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.mul(arguments[0], _spread(builder, arguments[1]))

    return a(a, a.scalar), emit


@intrinsic
def smaller(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return the smaller of a and b as signed numbers, lane by lane."""
    return _two(a, b, lambda builder, x, y: builder.select(builder.icmp_signed("<", x, y), x, y))


@intrinsic
def larger(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return the larger of a and b as signed numbers, lane by lane."""
    return _two(a, b, lambda builder, x, y: builder.select(builder.icmp_signed(">", x, y), x, y))


@intrinsic
def choose(typingctx, x, cut, at_most, above):  # type: ignore[no-untyped-def]
    """Return ``at_most`` where x <= cut, a number of the lanes' type, and ``above`` elsewhere."""

    def emit(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        lanes, number, yes, no = arguments
        return builder.select(builder.icmp_signed("<=", lanes, _spread(builder, number)), yes, no)

    return (x(x, x.scalar, x, x), emit) if x == at_most == above else None


@intrinsic
def beginning(typingctx, a, count):  # type: ignore[no-untyped-def]
    """Return ``a`` with 0 in all but the first ``count`` lanes; fewer than 0 or more than all are none or all."""

    def emit(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        x, number = arguments
        lane = ir.Constant(_vector(64), list(range(LANES)))
        keep = builder.icmp_signed("<", lane, _spread(builder, number))
        return builder.select(keep, x, ir.Constant(x.type, None))

    return a(a, types.int64), emit


@intrinsic
def bit_counts(typingctx, a):  # type: ignore[no-untyped-def]
    """Return how many bits are set, lane by lane."""

    def emit(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        (x,) = arguments
        name = f"llvm.ctpop.v{LANES}i{x.type.element.width}"
        function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(x.type, [x.type]), name)
        return builder.call(function, [x])

    return a(a), emit


@intrinsic
def widen(typingctx, a, like):  # type: ignore[no-untyped-def]
    """Return unsigned ``a`` as lanes of the type of ``like``, which is as wide or wider."""

    def emit(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        x, y = arguments
        return x if x.type == y.type else builder.zext(x, y.type)

    return like(a, like), emit


@intrinsic
def running_sums(typingctx, a):  # type: ignore[no-untyped-def]
    """Return in each lane the sum of ``a`` up to it."""

    def emit(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        (total,) = arguments
        zeros = ir.Constant(total.type, None)
        step = 1
        while step < LANES:  # every lane holds the sum of the last ``step`` ones
            shift = [LANES - step + lane for lane in range(LANES)]
            moved = builder.shuffle_vector(zeros, total, ir.Constant(_vector(32), shift))
            total = builder.add(total, moved)
            step *= 2
        return total

    return a(a), emit


@intrinsic
def last(typingctx, a):  # type: ignore[no-untyped-def]
    """Return the last lane of ``a`` in every lane."""

    def emit(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        (x,) = arguments
        return builder.shuffle_vector(x, x, ir.Constant(_vector(32), [LANES - 1] * LANES))

    return a(a), emit


@intrinsic
def less(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return 1 where a < b as signed numbers and 0 elsewhere."""
    return _two(a, b, lambda builder, x, y: builder.zext(builder.icmp_signed("<", x, y), x.type))


@intrinsic
def within(typingctx, a, low, high):  # type: ignore[no-untyped-def]
    """Return a uint32 with bit k set where low <= a <= high in lane k, as signed numbers of the lanes' type."""

    def emit(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        x, least, greatest = arguments
        above = builder.icmp_signed(">=", x, _spread(builder, least))
        below = builder.icmp_signed("<=", x, _spread(builder, greatest))
        return builder.bitcast(builder.and_(above, below), ir.IntType(LANES))

    return types.uint32(a, a.scalar, a.scalar), emit


@intrinsic
def lowest(typingctx, bits):  # type: ignore[no-untyped-def]
    """Return the number of the lowest bit that is set in ``bits``, which is not 0."""

    def emit(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.zext(builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1)), ir.IntType(64))

    return types.int64(types.uint32), emit


def _two(a: Any, b: Any, emit_on_vectors: Any) -> Any:
    """Return what an intrinsic of two lanes of one type has to."""

    def emit(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return emit_on_vectors(builder, *arguments)

    return (a(a, b), emit) if a == b else None


def _vector(bits: int) -> Any:
    return ir.VectorType(ir.IntType(bits), LANES)


def _spread(builder: Any, value: Any) -> Any:
    """Return a vector with ``value`` in every lane."""
    nothing = ir.Constant(ir.VectorType(value.type, LANES), ir.Undefined)
    first = builder.insert_element(nothing, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, nothing, ir.Constant(_vector(32), [0] * LANES))


def _pointer(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Return where the lanes of ``arguments[0][arguments[1]:]`` lie."""
    array = context.make_array(signature.args[0])(context, builder, arguments[0])
    first = builder.gep(array.data, [context.cast(builder, arguments[1], signature.args[1], types.intp)])
    vector = ir.VectorType(context.get_value_type(signature.args[0].dtype), LANES)
    return builder.bitcast(first, vector.as_pointer())


def _size(scalar: Any) -> int:
    return int(scalar.bitwidth) // 8
