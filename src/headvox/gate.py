"""Stage 1: the gate. A few signed box sums, for every voxel of the volume, throw out almost all of them.

It knows nothing of orientation. A voxel passes when each condition's statistic (a weighted sum over boxes, or the kth
smallest of the sums of a group) lies within its limits. Voxels are looked at 32 at a time, one above the other: the
corners of a box about them lie next to each other. A condition ends in 32 bits; once they are 0, the rest is left out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.integral import Integral, box_reach, set_corners, with_margins
from headvox.machine.kernels import bare_kernel, rule
from headvox.machine.simd import LANES, add, equal, fill, less, load, lowest, sub, times, within
from headvox.machine.threads import new_blocks, take
from headvox.masks.compile import CompiledGate

SLICES = 4
ALL = np.uint32(0xFFFFFFFF)
FIRSTS = np.uint32(0x55555555)  # of each pair of bits


@rule
def box_sums_at(flat, at, corners, b):
    """Return the sums over box ``b`` about :data:`LANES` voxels, each two above the one before.

    ``at`` tells the first, see :func:`headvox.integral.set_corners`.
    """
    low = at[0] + corners[b, 4] + (corners[b, 5] & at[1])
    high = at[0] + corners[b, 6] + (corners[b, 7] & at[1])
    c0, c1, c2, c3 = corners[b, 0], corners[b, 1], corners[b, 2], corners[b, 3]
    one = sub(
        sub(load(flat, high + c0), load(flat, low + c0)), sub(load(flat, high + c1), load(flat, low + c1))
    )
    other = sub(
        sub(load(flat, high + c2), load(flat, low + c2)), sub(load(flat, high + c3), load(flat, low + c3))
    )
    return sub(one, other)


@rule
def holds(flat, at, corners, weights, spans, rank, limits, i):
    """Return a bit for each of :data:`LANES` voxels: whether condition ``i``'s statistic lies within its limits."""
    # Unsigned, because a signed index costs a check for counting from the end.
    begin, end = np.uint64(spans[i, 0]), np.uint64(spans[i, 1])
    if rank[i] == 0:
        total = times(box_sums_at(flat, at, corners, begin), weights[begin])
        for b in range(begin + np.uint64(1), end):
            total = add(total, times(box_sums_at(flat, at, corners, b), weights[b]))
        return within(total, limits[i, 0], limits[i, 1])
    # The kth smallest is no less than the lower limit where fewer than k are less than it; likewise from above.
    low, high = fill(limits[i, 0]), fill(limits[i, 1])
    below = above = sub(low, low)
    for b in range(begin, end):
        total = box_sums_at(flat, at, corners, b)
        below = add(below, less(total, low))
        above = add(above, less(high, total))
    return within(below, 0, rank[i] - 1) & within(above, 0, end - begin - np.uint64(rank[i]))


@bare_kernel
def gate_columns(S, region, shift, weights, spans, rank, limits, spacing, odd, corners, blocks, passed):
    """Write to ``passed`` (slices, ny, words a column) a bit for each voxel of ``region``: whether it passes.

    The bits of a word are for every other voxel, from 64 k on in word 2 k of a column, from 64 k + 1 on in the next.
    ``region`` is x0 x1 y0 y1 z0 z1; S, in halves, has margins about it, see
    :func:`headvox.integral.shape_with_margins`. As many slices of it as there are in ``passed`` are looked at, from the
    one on that is ``shift`` behind the first; S begins as much later. With ``odd`` (3,) added to x, y and z of the
    region, all voxels count (``spacing`` 1), those whose x + y + z is even (2), or those whose x, y and z are all even
    or all odd (4). ``corners`` are those of the gate's boxes. Slices are taken :data:`SLICES` at a time by whichever
    thread is free: ``blocks`` (1,) counts what was taken.
    """
    flat, odd_x = S.reshape(-1), odd[0] + shift
    x0, y0, bottom, height = region[0], region[2], region[4], region[5] - region[4]
    odd_column, odd_z = odd_x + odd[1], (odd_x if spacing == 4 else odd_x + odd[1]) + odd[2] + bottom
    end = x0 + passed.shape[0]
    # A few slices go side by side, because they share most of what their boxes look up.
    block = x0 + SLICES * take(blocks, 0)
    while block < end:
        for y in range(y0, region[3]):
            for x in range(block, min(block + SLICES, end)):
                column = (x * S.shape[1] + y) * S.shape[2]
                words = passed[np.uint64(x - x0), np.uint64(y - y0)]
                first, after = 0, 2  # the words of a pair that have candidates
                if spacing > 1:
                    first = ((x if spacing == 4 else x + y) + odd_z) & 1
                    after = first if spacing == 4 and (x + y + odd_column) & 1 else first + 1
                for pair in range(0, words.shape[0], 2):
                    words[np.uint64(pair)] = words[np.uint64(pair + 1)] = 0
                    for k in range(first, after):
                        z = LANES * pair + k
                        alive = lowest_bits((height - z + 1) // 2)
                        for i in range(np.uint64(rank.shape[0])):
                            if alive == 0:
                                break
                            at = column + ((bottom + z) >> 1), -((bottom + z) & 1)
                            alive &= holds(flat, at, corners, weights, spans, rank, limits, i)
                        words[np.uint64(pair + k)] = alive
        block = x0 + SLICES * take(blocks, 0)


@rule
def lowest_bits(count):
    """Return the ``count`` lowest bits set, or as many as there are, or none."""
    return ALL >> np.uint32(LANES - count) if 0 < count < LANES else (ALL if count > 0 else np.uint32(0))


@bare_kernel
def list_passed(passed, region, survivors):
    """Write the voxels of ``region`` whose bit is set to ``survivors`` (n, 3), in order; return how many there are.

    Counting goes on past the end of ``survivors``, so that the caller can tell how many did not fit.
    """
    words, found = passed.reshape(-1), 0
    for first in range(0, words.shape[0], LANES):
        pairs = _pairs_with_any(words, first)
        while pairs:  # almost nowhere
            at = first + lowest(pairs)
            pairs &= pairs - np.uint32(1)
            column, k = divmod(at, passed.shape[2])
            x, y = divmod(column, passed.shape[1])
            evens, odds = words[np.uint64(at)], words[np.uint64(at + 1)]
            bits = evens | odds
            while bits:
                lane = lowest(bits)
                bits &= bits - np.uint32(1)
                for j in range(2):
                    if (odds if j else evens) >> np.uint32(lane) & np.uint32(1):
                        if found < survivors.shape[0]:
                            survivors[found, 0] = region[0] + x
                            survivors[found, 1] = region[2] + y
                            survivors[found, 2] = region[4] + LANES * k + 2 * lane + j
                        found += 1
    return found


@rule
def _pairs_with_any(words, first):
    """Return a bit for the first of each pair of :data:`LANES` words from ``first`` on: whether any bit is set."""
    if first + LANES > words.shape[0]:  # the last few: they are looked at in any case
        return lowest_bits(words.shape[0] - first) & FIRSTS
    some = load(words, first)
    bits = ~equal(some, sub(some, some))
    return (bits | bits >> np.uint32(1)) & FIRSTS


def candidate_reach(gate: CompiledGate) -> npt.NDArray[np.int64]:
    """Return how far from an occupied voxel a candidate can lie: what to add to the lowest and highest occupied cell.

    It follows from a condition with a lower limit above 0 on one box: that box holds an occupied voxel. The result
    never narrows the occupied box.
    """
    reaches = [
        np.concatenate([1 - gate.boxes[first, 1::2], -gate.boxes[first, 0::2]])
        for first, after, low in zip(gate.start[:-1], gate.start[1:], gate.low, strict=True)
        if after - first == 1 and gate.weights[first] > 0 and low > 0
    ]
    widest = np.array([-1, -1, -1, 1, 1, 1]) * np.abs(gate.boxes).max(initial=1)
    reach = min(reaches, key=lambda reach: int((reach[3:] - reach[:3]).sum()), default=widest).astype(
        np.int64
    )
    return np.concatenate([np.minimum(reach[:3], 0), np.maximum(reach[3:], 0)])


def gate_tables(gate: CompiledGate, sum_type: np.dtype[Any]) -> tuple[npt.NDArray[Any], ...]:
    """Return the gate as :func:`gate_columns` reads it, for an integral volume of ``sum_type``.

    The condition that asks most of a single box comes first: it throws out most for what it costs.
    """
    signed = np.dtype(f"i{sum_type.itemsize}")
    least, greatest = np.iinfo(signed).min, np.iinfo(signed).max
    limits = np.clip(np.stack([gate.low, gate.high], axis=1), least, greatest).astype(signed)
    spans = np.stack([gate.start[:-1], gate.start[1:]], axis=1)
    single = (np.diff(gate.start) == 1) & (gate.weights[gate.start[:-1]] == 1)
    order = np.argsort(-np.where(single, gate.low, 0), kind="stable")
    order = np.concatenate([order[:1], np.sort(order[1:])])
    return gate.weights, spans[order], gate.rank[order], limits[order]


def shape_of_passed(region: npt.NDArray[np.int64]) -> tuple[int, int, int]:
    """Return the shape of the bits of ``region``, see :func:`gate_columns`."""
    nx, ny, nz = (region[1::2] - region[0::2]).tolist()
    return nx, ny, 2 * -(-nz // (2 * LANES))


def pass_gate(S: Integral, gate: CompiledGate, odd: npt.ArrayLike = (0, 0, 0)) -> npt.NDArray[np.int32]:
    """Return the voxels (n, 3) of the integral volume ``S`` that pass, in the order of x, y, z.

    ``odd`` (3,) is that of the lattice, for a gate that does not look at every voxel.
    """
    reach = box_reach(gate.boxes)
    low = -reach[0::2]
    region = np.stack([low, low + S.shape - 1], axis=1).reshape(-1)
    longer = with_margins(S, reach)
    corners, passed = np.empty((len(gate.boxes), 8), np.int64), np.empty(shape_of_passed(region), np.uint32)
    set_corners(longer, gate.boxes, corners)
    tables = gate_tables(gate, S.dtype)
    at = gate.spacing, np.asarray(odd) + low
    gate_columns(longer, region, 0, *tables, *at, corners, new_blocks(1)[0], passed)
    survivors = np.empty((sum(int(bits).bit_count() for bits in passed[passed > 0]), 3), np.int32)
    list_passed(passed, region, survivors)
    return survivors - low.astype(np.int32)
