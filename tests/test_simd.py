"""Vectors in kernels do what numpy does, whatever the processor makes of them."""

import os
import subprocess
import sys

import numpy as np
import pytest

from headvox.machine.kernels import bare_kernel
from headvox.machine.simd import (
    LANES,
    add,
    beginning,
    below,
    bit_and,
    bit_counts,
    bit_or,
    choose,
    compress,
    equal,
    fill,
    firsts,
    larger,
    last,
    less,
    load,
    load_pairs,
    load_triples,
    lowest,
    mul,
    ratio,
    resized,
    running_sums,
    seconds,
    set_bits,
    shift_left,
    shift_right,
    shifted,
    smaller,
    store,
    sub,
    times,
    to_float,
    to_int,
    total,
    where,
    within,
)


@bare_kernel
def arithmetic(a, b, at, factor, out):
    """Write what each operation gives to a row of ``out``."""
    x, y = load(a, at), load(b, at)
    flat = out.reshape(-1)
    store(flat, 0, add(x, y))
    store(flat, LANES, sub(x, y))
    store(flat, 2 * LANES, times(x, factor))
    store(flat, 3 * LANES, less(x, y))
    store(flat, 4 * LANES, fill(a[at]))
    store(flat, 5 * LANES, smaller(x, y))
    store(flat, 6 * LANES, larger(x, y))
    store(flat, 7 * LANES, choose(x, b[at], x, y))


@bare_kernel
def in_rows(a, at, count, out, wide):
    """Write what is done within the lanes of one vector to a row of ``out`` each, and the lanes resized to ``wide``."""
    x, flat = load(a, at), out.reshape(-1)
    store(flat, 0, running_sums(x))
    store(flat, LANES, last(x))
    store(flat, 2 * LANES, beginning(x, count))
    store(flat, 3 * LANES, bit_counts(x))
    store(wide, 0, resized(x, load(wide, 0)))


@bare_kernel
def integers(a, b, at, out):
    """As :func:`arithmetic`, for what only integers have."""
    x, y, flat = load(a, at), load(b, at), out.reshape(-1)
    store(flat, 0, mul(x, y))
    store(flat, LANES, bit_and(x, y))
    store(flat, 2 * LANES, shift_right(x, 3))
    store(flat, 3 * LANES, shifted(x, y))
    store(flat, 4 * LANES, where(below(x, y), x, y))
    store(flat, 5 * LANES, where(equal(x, y), x, fill(b[at])))
    store(flat, 6 * LANES, shift_left(x, 3))
    store(flat, 7 * LANES, bit_or(x, y))


@bare_kernel
def paired(a, at, out):
    pairs, flat = load_pairs(a, at), out.reshape(-1)
    store(flat, 0, resized(firsts(pairs), load(a, 0)))
    store(flat, LANES, resized(seconds(pairs), load(a, 0)))


@bare_kernel
def reals(xyz, out, cut):
    x, y, z = load_triples(xyz, 1)
    flat = out.reshape(-1)
    store(flat, 0, add(x, mul(y, z)))
    store(flat, LANES, sub(x, y))
    store(cut, 0, to_int(z))
    return below(x, y)


@bare_kernel
def converted(a, out):
    store(out, 0, to_float(load(a, 0)))


@bare_kernel
def summed(a, at):
    return total(load(a, at))


@bare_kernel
def between(a, at, low, high):
    return within(load(a, at), low, high)


@bare_kernel
def packed(a, at, bits, out):
    return compress(out, at, bits, load(a, 0))


@bare_kernel
def first_of(bits):
    return lowest(bits)


@bare_kernel
def bits_of(bits):
    return set_bits(bits)


@bare_kernel
def divided(a, b, out):
    store(out, 0, ratio(load(a, 0), load(b, 0)))


@pytest.mark.parametrize("dtype", [np.int16, np.uint16, np.int32, np.uint32])
@pytest.mark.parametrize("at", [0, 1, 7])
def test_equals_numpy(dtype, at):
    rng = np.random.default_rng(at)
    info = np.iinfo(dtype)
    a, b = rng.integers(info.min, info.max, (2, 64), dtype, endpoint=True)
    b[::3] = a[::3]
    a[at], b[at + 1] = info.max, info.min
    out = np.zeros((8, LANES), dtype)
    arithmetic(a, b, at, 3, out)
    x, y = a[at : at + LANES], b[at : at + LANES]
    signed = np.dtype(f"i{x.itemsize}")
    p, q = x.view(signed), y.view(signed)
    rows = [x + y, x - y, x * dtype(3), p < q, np.full(LANES, x[0])]
    rows += [row.view(dtype) for row in (np.minimum(p, q), np.maximum(p, q), np.where(p <= q[0], p, q))]
    np.testing.assert_array_equal(out, rows)
    low, high = sorted(p[[3, 9]].tolist())
    bits = between(a, at, low, high)
    wanted = (p >= low) & (p <= high)
    assert [bool(bits >> lane & 1) for lane in range(LANES)] == wanted.tolist()
    assert 0 < wanted.sum() < LANES


@pytest.mark.parametrize("dtype", [np.int16, np.int32])
def test_integers_equal_numpy(dtype):
    rng = np.random.default_rng(1)
    info = np.iinfo(dtype)
    a, b = rng.integers(info.min, info.max, (2, 40), dtype, endpoint=True)
    b[::3] = a[::3]
    out = np.zeros((8, LANES), dtype)
    integers(a, b, 2, out)
    x, y = a[2 : 2 + LANES], b[2 : 2 + LANES]
    rows = [
        x * y,
        x & y,
        x >> 3,
        np.concatenate([x[-1:], y[:-1]]),
        np.minimum(x, y),
        np.where(x == y, x, y[0]),
        x << 3,
        x | y,
    ]
    np.testing.assert_array_equal(out, rows)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint32])
def test_pairs_come_apart(dtype):
    a = np.random.default_rng(4).integers(0, np.iinfo(dtype).max, 2 * LANES + 3, dtype, endpoint=True)
    out = np.zeros((2, LANES), dtype)
    paired(a, 3, out)
    np.testing.assert_array_equal(out, [a[3::2], a[4::2]])


def test_reals_equal_numpy_and_a_nan_is_below_nothing():
    xyz = np.random.default_rng(2).normal(scale=100.0, size=3 * LANES + 1).astype(np.float32)
    xyz[[1, 8]] = np.nan
    xyz[4] = xyz[5]
    x, y, z = xyz[1:].reshape(LANES, 3).T
    out, cut = np.zeros((2, LANES), np.float32), np.zeros(LANES, np.int32)
    bits = reals(xyz, out, cut)
    np.testing.assert_array_equal(out, [x + y * z, x - y])
    np.testing.assert_array_equal(cut, np.trunc(z))
    assert [bool(bits >> lane & 1) for lane in range(LANES)] == (x < y).tolist()


def test_unsigned_numbers_become_floats():
    a = np.linspace(0, 65535, LANES).astype(np.uint16)
    out = np.zeros(LANES, np.float32)
    converted(a, out)
    np.testing.assert_array_equal(out, a)


def test_the_total_is_that_of_halves_of_halves():
    a = np.random.default_rng(7).normal(size=40) * 10.0 ** np.arange(-20, 20)
    halves = a[3 : 3 + LANES]
    while len(halves) > 1:
        halves = halves[: len(halves) // 2] + halves[len(halves) // 2 :]
    assert summed(a, 3) == halves[0]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_ratios_are_those_of_numpy(dtype):
    a, b = np.random.default_rng(3).normal(size=(2, LANES)).astype(dtype)
    a[:4], b[:4] = (1.0, -1.0, 0.0, np.nan), (0.0, 0.0, 0.0, 1.0)
    out = np.empty(LANES, dtype)
    divided(a, b, out)
    with np.errstate(divide="ignore", invalid="ignore"):
        np.testing.assert_array_equal(out, a / b)


@pytest.mark.parametrize("bits", [0, 1, 0x80000000, 0xFFFFFFFF, 0xDEADBEEF])
def test_how_many_bits_are_set(bits):
    assert bits_of(np.uint32(bits)) == bits.bit_count()


def test_lowest_bit():
    for bit in range(LANES):
        assert first_of(np.uint32((1 << bit) | (1 << 31))) == bit


@pytest.mark.parametrize(
    ("dtype", "wider"),
    [(np.uint8, np.uint16), (np.uint8, np.uint32), (np.uint16, np.uint16), (np.uint32, np.uint32)],
)
@pytest.mark.parametrize("count", [-3, 0, 1, 17, 32, 40])
def test_what_is_done_within_a_vector(dtype, wider, count):
    a = np.random.default_rng(5).integers(0, np.iinfo(dtype).max, 50, dtype, endpoint=True)
    out, wide = np.zeros((4, LANES), dtype), np.zeros(LANES, wider)
    in_rows(a, 3, count, out, wide)
    x = a[3 : 3 + LANES]
    counts = [int(value).bit_count() for value in x]
    kept = np.where(np.arange(LANES) < count, x, 0)
    np.testing.assert_array_equal(out, [np.cumsum(x, dtype=dtype), np.full(LANES, x[-1]), kept, counts])
    np.testing.assert_array_equal(wide, x)


@pytest.mark.parametrize("bits", [0, 1, 1 << 31, 0xFFFFFFFF, 0x5A0FF3C1])
def test_compress_writes_the_chosen_lanes_one_after_the_other(bits):
    a = np.arange(100, 100 + LANES, dtype=np.int32)
    out = np.full(3 * LANES, -1, np.int32)
    chosen = [value for lane, value in enumerate(a) if bits >> lane & 1]
    assert packed(a, 5, np.uint32(bits), out) == 5 + len(chosen)
    assert out[: 5 + len(chosen)].tolist() == [-1] * 5 + chosen
    assert (out[5 + LANES + 1 :] == -1).all()


def test_a_processor_without_any_extension_gives_the_same():
    """The tests of this file again, compiled for the least processor of this kind."""
    environment = {**os.environ, "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    names = "equals_numpy or within_a_vector or compress"
    command = [sys.executable, "-m", "pytest", __file__, "-k", f"({names}) and not processor"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert "passed" in done.stdout
