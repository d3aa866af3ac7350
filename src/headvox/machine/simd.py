"""Vectors of 32 numbers inside kernels, where a loop over arrays leaves too much to the compiler's luck.

A kernel holds a :class:`Lanes` in registers, so a test of 32 voxels ends in one 32-bit number, and a branch on it being
0 is the early exit. What is emitted is LLVM's own vector code and nothing of any processor: the compiler makes one
AVX-512 instruction of it, two for AVX2 or four for NEON, with the same results. Whole numbers wrap around.
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
    """Numba's type for :data:`LANES` numbers. Of integers only the width is told: most operations need no sign."""

    def __init__(self, scalar: Any) -> None:
        whole = isinstance(scalar, types.Integer)
        self.scalar = types.Integer.from_bitwidth(scalar.bitwidth) if whole else scalar
        super().__init__(f"Lanes({self.scalar})")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        scalar = dmm.lookup(fe_type.scalar).get_value_type()
        # The base class, of Numba, has no type hints.
        super().__init__(dmm, fe_type, ir.VectorType(scalar, LANES))  # type: ignore[no-untyped-call]


@intrinsic
def load(typingctx, flat, at):
    """Return ``flat[at : at + LANES]`` of a C-contiguous array."""

    def emit(context, builder, signature, arguments):
        return builder.load(_pointer(context, builder, signature, arguments), align=_size(flat.dtype))

    return Lanes(flat.dtype)(flat, at), emit


@intrinsic
def store(typingctx, flat, at, lanes):
    """Set ``flat[at : at + LANES]`` of a C-contiguous array."""

    def emit(context, builder, signature, arguments):
        pointer = _pointer(context, builder, signature, arguments)
        builder.store(arguments[2], pointer, align=_size(flat.dtype))
        return context.get_dummy_value()

    return types.void(flat, at, lanes), emit


@intrinsic
def fill(typingctx, value):
    """Return ``value`` in every lane, in its own type."""

    def emit(context, builder, signature, arguments):
        return _spread(builder, arguments[0])

    return Lanes(value)(value), emit


@intrinsic
def load_triples(typingctx, flat, at):
    """Return three vectors: every third item of ``flat`` from ``at``, ``at + 1`` and ``at + 2`` on."""
    lanes = Lanes(flat.dtype)

    def emit(context, builder, signature, arguments):
        scalar = context.get_value_type(flat.dtype)
        pointer = _pointer(context, builder, signature, arguments)
        pointer = builder.bitcast(pointer, ir.VectorType(scalar, 3 * LANES).as_pointer())
        items = builder.load(pointer, align=_size(flat.dtype))
        rows = [
            builder.shuffle_vector(items, items, ir.Constant(_vector(32), list(range(k, 3 * LANES, 3))))
            for k in range(3)
        ]
        return context.make_tuple(builder, signature.return_type, rows)

    return types.UniTuple(lanes, 3)(flat, at), emit


@intrinsic
def load_pairs(typingctx, flat, at):
    """Return the unsigned ``flat[at : at + 2 * LANES]`` in pairs, two numbers in a lane twice as wide."""
    bits = 2 * flat.dtype.bitwidth

    def emit(context, builder, signature, arguments):
        pointer = _pointer(context, builder, signature, arguments)
        return builder.load(builder.bitcast(pointer, _vector(bits).as_pointer()), align=_size(flat.dtype))

    return Lanes(types.Integer.from_bitwidth(bits))(flat, at), emit


@intrinsic
def firsts(typingctx, pairs):
    """Return the first number of each pair, in a lane as wide as a pair's: see :func:`load_pairs`."""

    def emit(context, builder, signature, arguments):
        half = ir.IntType(pairs.scalar.bitwidth // 2)
        return builder.zext(builder.trunc(arguments[0], ir.VectorType(half, LANES)), arguments[0].type)

    return pairs(pairs), emit


@intrinsic
def seconds(typingctx, pairs):
    """Return the second number of each pair, in a lane as wide as a pair's: see :func:`load_pairs`."""

    def emit(context, builder, signature, arguments):
        half = ir.Constant(arguments[0].type.element, pairs.scalar.bitwidth // 2)
        return builder.lshr(arguments[0], _spread(builder, half))

    return pairs(pairs), emit


@intrinsic
def add(typingctx, a, b):
    """Return a + b, lane by lane."""
    return _two(a, b, lambda builder, x, y: builder.add(x, y), lambda builder, x, y: builder.fadd(x, y))


@intrinsic
def sub(typingctx, a, b):
    """Return a - b, lane by lane."""
    return _two(a, b, lambda builder, x, y: builder.sub(x, y), lambda builder, x, y: builder.fsub(x, y))


@intrinsic
def mul(typingctx, a, b):
    """Return a * b, lane by lane."""
    return _two(a, b, lambda builder, x, y: builder.mul(x, y), lambda builder, x, y: builder.fmul(x, y))


@intrinsic
def ratio(typingctx, a, b):
    """Return a / b, lane by lane, of floating-point numbers."""
    return _two(a, b, None, lambda builder, x, y: builder.fdiv(x, y))


@intrinsic
def bit_and(typingctx, a, b):
    """Return a & b, lane by lane."""
    return _two(a, b, lambda builder, x, y: builder.and_(x, y))


@intrinsic
def bit_or(typingctx, a, b):
    """Return a | b, lane by lane."""
    return _two(a, b, lambda builder, x, y: builder.or_(x, y))


@intrinsic
def times(typingctx, a, factor):
    """Return a * factor, a number of the lanes' type, lane by lane."""

    def emit(context, builder, signature, arguments):
        return builder.mul(arguments[0], _spread(builder, arguments[1]))

    return a(a, a.scalar), emit


@intrinsic
def shift_right(typingctx, a, count):
    """Return a >> count, as signed numbers, lane by lane."""

    def emit(context, builder, signature, arguments):
        return builder.ashr(arguments[0], _spread(builder, arguments[1]))

    return a(a, a.scalar), emit


@intrinsic
def shift_left(typingctx, a, count):
    """Return a << count, lane by lane."""

    def emit(context, builder, signature, arguments):
        return builder.shl(arguments[0], _spread(builder, arguments[1]))

    return a(a, a.scalar), emit


@intrinsic
def to_float(typingctx, a):
    """Return unsigned integers as float32."""
    lanes = Lanes(types.float32)

    def emit(context, builder, signature, arguments):
        return builder.uitofp(arguments[0], ir.VectorType(ir.FloatType(), LANES))

    return lanes(a), emit


@intrinsic
def to_int(typingctx, a):
    """Return float32 cut off to int32; anything at all where that does not fit."""
    lanes = Lanes(types.int32)

    def emit(context, builder, signature, arguments):
        return builder.fptosi(arguments[0], _vector(32))

    return lanes(a), emit


@intrinsic
def below(typingctx, a, b):
    """Return a uint32 with bit k set where a < b in lane k, as signed numbers or float32; a NaN is below nothing."""

    def emit(context, builder, signature, arguments):
        x, y = arguments
        is_whole = isinstance(a.scalar, types.Integer)
        bits = builder.icmp_signed("<", x, y) if is_whole else builder.fcmp_ordered("<", x, y)
        return builder.bitcast(bits, ir.IntType(LANES))

    return (types.uint32(a, b), emit) if a == b else None


@intrinsic
def equal(typingctx, a, b):
    """Return a uint32 with bit k set where the integers a and b are equal in lane k."""

    def emit(context, builder, signature, arguments):
        return builder.bitcast(builder.icmp_signed("==", *arguments), ir.IntType(LANES))

    return (types.uint32(a, b), emit) if a == b else None


@intrinsic
def where(typingctx, bits, a, b):
    """Return a where bit k of a uint32 is set, and b elsewhere, lane by lane."""

    def emit(context, builder, signature, arguments):
        number, x, y = arguments
        return builder.select(builder.bitcast(number, ir.VectorType(ir.IntType(1), LANES)), x, y)

    return (a(types.uint32, a, b), emit) if a == b else None


@intrinsic
def shifted(typingctx, before, a):
    """Return ``a`` one lane on; the first lane is the last of ``before``."""
    places = list(range(LANES - 1, 2 * LANES - 1))
    return _two(
        before, a, lambda builder, x, y: builder.shuffle_vector(x, y, ir.Constant(_vector(32), places))
    )


@intrinsic
def smaller(typingctx, a, b):
    """Return the smaller of a and b as signed numbers, lane by lane."""
    return _two(a, b, lambda builder, x, y: builder.select(builder.icmp_signed("<", x, y), x, y))


@intrinsic
def larger(typingctx, a, b):
    """Return the larger of a and b as signed numbers, lane by lane."""
    return _two(a, b, lambda builder, x, y: builder.select(builder.icmp_signed(">", x, y), x, y))


@intrinsic
def choose(typingctx, x, cut, at_most, above):
    """Return ``at_most`` where x <= cut, a number of the lanes' type, and ``above`` elsewhere."""

    def emit(context, builder, signature, arguments):
        lanes, number, yes, no = arguments
        return builder.select(builder.icmp_signed("<=", lanes, _spread(builder, number)), yes, no)

    return (x(x, x.scalar, x, x), emit) if x == at_most == above else None


@intrinsic
def beginning(typingctx, a, count):
    """Return ``a`` with 0 in all but the first ``count`` lanes; fewer than 0 or more than all are none or all."""

    def emit(context, builder, signature, arguments):
        x, number = arguments
        least, most = (ir.Constant(number.type, n) for n in (0, LANES))
        number = builder.select(builder.icmp_signed("<", number, least), least, number)
        number = builder.select(builder.icmp_signed(">", number, most), most, number)
        lane = ir.Constant(_vector(8), list(range(LANES)))
        keep = builder.icmp_signed("<", lane, _spread(builder, builder.trunc(number, ir.IntType(8))))
        return builder.select(keep, x, ir.Constant(x.type, None))

    return a(a, types.int64), emit


@intrinsic
def bit_counts(typingctx, a):
    """Return how many bits are set, lane by lane."""

    def emit(context, builder, signature, arguments):
        (x,) = arguments
        name = f"llvm.ctpop.v{LANES}i{x.type.element.width}"
        function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(x.type, [x.type]), name)
        return builder.call(function, [x])

    return a(a), emit


@intrinsic
def resized(typingctx, a, like):
    """Return unsigned ``a`` as lanes of the type of ``like``, which is wide enough for it."""

    def emit(context, builder, signature, arguments):
        x, y = arguments
        old, new = x.type.element.width, y.type.element.width
        return x if old == new else (builder.zext if old < new else builder.trunc)(x, y.type)

    return like(a, like), emit


@intrinsic
def running_sums(typingctx, a):
    """Return in each lane the sum of ``a`` up to it."""

    def emit(context, builder, signature, arguments):
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
def total(typingctx, a):
    """Return the sum of all lanes of a float64 vector: of its halves, of the halves of that, and so on."""

    def emit(context, builder, signature, arguments):
        (sums,) = arguments
        half = LANES // 2
        while half:
            low, high = (
                ir.Constant(ir.VectorType(ir.IntType(32), half), list(range(k, k + half))) for k in (0, half)
            )
            sums = builder.fadd(*(builder.shuffle_vector(sums, sums, places) for places in (low, high)))
            half //= 2
        return builder.extract_element(sums, ir.Constant(ir.IntType(32), 0))

    return a.scalar(a), emit


@intrinsic
def last(typingctx, a):
    """Return the last lane of ``a`` in every lane."""

    def emit(context, builder, signature, arguments):
        (x,) = arguments
        return builder.shuffle_vector(x, x, ir.Constant(_vector(32), [LANES - 1] * LANES))

    return a(a), emit


@intrinsic
def less(typingctx, a, b):
    """Return 1 where a < b as signed numbers and 0 elsewhere."""
    return _two(a, b, lambda builder, x, y: builder.zext(builder.icmp_signed("<", x, y), x.type))


@intrinsic
def within(typingctx, a, low, high):
    """Return a uint32 with bit k set where low <= a <= high in lane k, as signed numbers of the lanes' type."""

    def emit(context, builder, signature, arguments):
        x, least, greatest = arguments
        above = builder.icmp_signed(">=", x, _spread(builder, least))
        below = builder.icmp_signed("<=", x, _spread(builder, greatest))
        return builder.bitcast(builder.and_(above, below), ir.IntType(LANES))

    return types.uint32(a, a.scalar, a.scalar), emit


@intrinsic
def compress(typingctx, flat, at, bits, a):
    """Write those lanes of ``a`` whose bit is set one after the other to ``flat`` from ``at`` on; return their end.

    What lies behind them is overwritten, as far as all lanes would go.
    """

    def emit(context, builder, signature, arguments):
        array, place, mask, lanes = arguments
        data = context.make_array(signature.args[0])(context, builder, array).data
        place = context.cast(builder, place, signature.args[1], types.int64)
        if (
            "+avx512f" in context.codegen()._tm_features
        ):  # has an instruction for it; LLVM would make branches else
            kinds = [lanes.type, data.type, ir.VectorType(ir.IntType(1), LANES)]
            name = f"llvm.masked.compressstore.v{LANES}i{lanes.type.element.width}"
            kind = ir.FunctionType(ir.VoidType(), kinds)
            function = cgutils.get_or_insert_function(builder.module, kind, name)
            builder.call(function, [lanes, builder.gep(data, [place]), builder.bitcast(mask, kinds[2])])
            return builder.add(place, builder.zext(builder.ctpop(mask), place.type))
        for lane in range(LANES):
            number = ir.Constant(mask.type, lane)
            builder.store(builder.extract_element(lanes, number), builder.gep(data, [place]))
            bit = builder.and_(builder.lshr(mask, number), ir.Constant(mask.type, 1))
            place = builder.add(place, builder.zext(bit, place.type))
        return place

    return types.int64(flat, at, types.uint32, a), emit


@intrinsic
def set_bits(typingctx, bits):
    """Return how many of the ``bits`` of a uint32 are set."""

    def emit(context, builder, signature, arguments):
        return builder.zext(builder.ctpop(arguments[0]), ir.IntType(64))

    return types.int64(types.uint32), emit


@intrinsic
def lowest(typingctx, bits):
    """Return the number of the lowest bit that is set in ``bits``, which is not 0."""

    def emit(context, builder, signature, arguments):
        return builder.zext(builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1)), ir.IntType(64))

    return types.int64(types.uint32), emit


def _two(a: Any, b: Any, on_integers: Any, on_reals: Any = None) -> Any:
    """Return what an intrinsic of two lanes of one type has to."""
    instruction = on_integers if isinstance(a.scalar, types.Integer) else on_reals

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return instruction(builder, *arguments)

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
