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
from headvox.kernels import bare_kernel, rule
from headvox.masks import CompiledGate
from headvox.simd import LANES, add, fill, less, load, lowest, sub, times, within

EVEN, ALL = np.uint32(0x55555555), np.uint32(0xFFFFFFFF)


@rule
def _sums(flat, at, corners, b):  # type: ignore[no-untyped-def]
    """Return the sums over box ``b`` about :data:`LANES` voxels, one above the other."""
    high = sub(load(flat, at + corners[b, 0]), load(flat, at + corners[b, 1]))
    high = sub(high, sub(load(flat, at + corners[b, 2]), load(flat, at + corners[b, 3])))
    low = sub(load(flat, at + corners[b, 4]), load(flat, at + corners[b, 5]))
    return sub(high, sub(low, sub(load(flat, at + corners[b, 6]), load(flat, at + corners[b, 7]))))


@bare_kernel
def _holds(flat, at, corners, weights, start, rank, limits, i):  # type: ignore[no-untyped-def]
    """Return a bit for each of :data:`LANES` voxels: whether condition ``i``'s statistic lies within its limits."""
    # Unsigned, because a signed index costs a check for counting from the end.
    begin, end = np.uint64(start[i]), np.uint64(start[i + np.uint64(1)])
    if rank[i] == 0:
        total = times(_sums(flat, at, corners, begin), weights[begin])
        for b in range(begin + np.uint64(1), end):
            total = add(total, times(_sums(flat, at, corners, b), weights[b]))
        return within(total, limits[i, 0], limits[i, 1])
    # The kth smallest is no less than the lower limit where fewer than k are less than it; likewise from above.
    low, high = fill(limits[i, 0]), fill(limits[i, 1])
    below = above = sub(low, low)
    for b in range(begin, end):
        total = _sums(flat, at, corners, b)
        below = add(below, less(total, low))
        above = add(above, less(high, total))
    return within(below, 0, rank[i] - 1) & within(above, 0, end - begin - np.uint64(rank[i]))


@bare_kernel
def gate_columns(  # type: ignore[no-untyped-def]
    S, region, first, last, weights, start, rank, limits, spacing, odd, corners, survivors
):
    """Write the voxels of the slices ``first`` to ``last`` that pass to ``survivors`` (n, 3); return how many.

    ``region`` is y0 y1 z0 z1: the voxels of a slice that count. S has margins about them, see
    :func:`headvox.integral.shape_with_margins`. With ``odd`` (3,) added to x, y and z, all voxels count (``spacing``
    1), those whose x + y + z is even (2), or those whose x, y and z are all even or all odd (4). ``corners`` are those
    of the gate's boxes. Counting goes on past the end of ``survivors``, so that the caller can tell how many did not
    fit.
    """
    flat = S.reshape(-1)
    bottom, height = region[2], region[3] - region[2]
    found = 0
    for x in range(first, last):
        for y in range(region[0], region[1]):
            across = x + y + odd[0] + odd[1]
            if spacing == 4 and across & 1:
                continue
            up = (across if spacing == 2 else x + odd[0]) + bottom + odd[2]
            column = (x * S.shape[1] + y) * S.shape[2] + bottom
            for z in range(0, height, LANES):
                alive = ALL if spacing == 1 else EVEN << np.uint32(up & 1)
                for i in range(np.uint64(rank.shape[0])):
                    alive &= _holds(flat, column + z, corners, weights, start, rank, limits, i)
                    if alive == 0:
                        break
                while alive:
                    voxel = z + lowest(alive)
                    alive &= alive - np.uint32(1)
                    if voxel < height:
                        if found < survivors.shape[0]:
                            survivors[found, 0] = x
                            survivors[found, 1] = y
                            survivors[found, 2] = bottom + voxel
                        found += 1
    return found


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
    """Return the gate as :func:`gate_columns` reads it, for an integral volume of ``sum_type``."""
    signed = np.dtype(f"i{sum_type.itemsize}")
    least, greatest = np.iinfo(signed).min, np.iinfo(signed).max
    limits = np.clip(np.stack([gate.low, gate.high], axis=1), least, greatest).astype(signed)
    return gate.weights, gate.start, gate.rank, limits


def pass_gate(S: Integral, gate: CompiledGate, odd: npt.ArrayLike = (0, 0, 0)) -> npt.NDArray[np.int32]:
    """Return the voxels (n, 3) of the integral volume ``S`` that pass, in the order of x, y, z.

    ``odd`` (3,) is that of the lattice, for a gate that does not look at every voxel.
    """
    reach = box_reach(gate.boxes)
    longer = with_margins(S, reach)
    low = -reach[0::2]
    high = low + S.shape - 1
    corners = np.empty((len(gate.boxes), 8), np.uint64)
    set_corners(longer, gate.boxes, corners)
    region = np.array([low[1], high[1], low[2], high[2]])
    arguments = (longer, region, low[0], high[0], *gate_tables(gate, S.dtype))
    arguments += (gate.spacing, np.asarray(odd) + low, corners)
    count = gate_columns(*arguments, np.empty((0, 3), np.int32))
    survivors = np.empty((count, 3), np.int32)
    gate_columns(*arguments, survivors)
    return survivors - low.astype(np.int32)
