"""Stage 1: the gate. A few box sums, for every voxel of the volume, throw out almost all of them.

It knows nothing of orientation. A voxel passes when each condition's statistic (a sum over boxes, or the kth smallest
of the sums of a group) lies within its limits. The boxes' corners are read a column of voxels at a time, so the
compiler turns every step into vector instructions; a column is left as soon as no voxel of it is alive.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from headvox.integral import Integral
from headvox.kernels import kernel, rule
from headvox.masks import CompiledGate


@rule
def _column_sums(S, x, y, box, pad, edge, out):  # type: ignore[no-untyped-def]
    """Write to ``out`` the sums over ``box`` about every voxel of the column x, y."""
    nx, ny, nz = S.shape[0] - 1, S.shape[1] - 1, S.shape[2] - 1
    x0, x1 = min(max(x + box[0], 0), nx), min(max(x + box[1], 0), nx)
    y0, y1 = min(max(y + box[2], 0), ny), min(max(y + box[3], 0), ny)
    a, b, c, d = S[x1, y1], S[x0, y1], S[x1, y0], S[x0, y0]
    middle = edge[pad : pad + nz + 1]
    for z in range(nz + 1):
        middle[z] = (a[z] - b[z]) - (c[z] - d[z])
    top = middle[nz]
    above = edge[pad + nz + 1 :]
    for z in range(pad):
        above[z] = top
    low = edge[pad + box[4] : pad + box[4] + nz]
    high = edge[pad + box[5] : pad + box[5] + nz]
    for z in range(nz):
        out[z] = high[z] - low[z]


@kernel
def gate_columns(S, first, last, boxes, start, rank, low, high, least, survivors):  # type: ignore[no-untyped-def]
    """Write the voxels of the slices ``first`` to ``last`` that pass to ``survivors`` (n, 3); return how many there are.

    ``least`` is x0 x1 y0 y1 and a count: a window that holds fewer in the whole column cannot pass, whatever z.
    Counting goes on past the end of ``survivors``, so that the caller can tell how many did not fit.
    """
    nx, ny, nz = S.shape[0] - 1, S.shape[1] - 1, S.shape[2] - 1
    pad = 0
    for i in range(boxes.shape[0]):
        pad = max(pad, max(-boxes[i, 4], boxes[i, 5]))
    edge = np.zeros(nz + 1 + 2 * pad, S.dtype)
    most = 1
    for i in range(rank.shape[0]):
        most = max(most, start[i + 1] - start[i])
    sums = np.empty((most, nz), S.dtype)
    alive = np.empty(nz, np.uint8)
    found = 0
    # A whole column may wrap around where no box does; a voxel has 8 parts at most.
    fits = S.itemsize > 2 or (least[1] - least[0]) * (least[3] - least[2]) * nz * 8 <= 0xFFFF
    for x in range(first, last):
        wx0, wx1 = min(max(x + least[0], 0), nx), min(max(x + least[1], 0), nx)
        for y in range(ny):
            wy0, wy1 = min(max(y + least[2], 0), ny), min(max(y + least[3], 0), ny)
            window = (S[wx1, wy1, nz] - S[wx0, wy1, nz]) - (S[wx1, wy0, nz] - S[wx0, wy0, nz])
            if fits and (window & 0xFFFFFFFF) < least[4]:
                continue
            alive[:] = 1
            any_alive = True
            for i in range(rank.shape[0]):
                count = start[i + 1] - start[i]
                for k in range(count):
                    _column_sums(S, x, y, boxes[start[i] + k], pad, edge, sums[k])
                if count > 1:
                    if rank[i] == 0:
                        for k in range(1, count):
                            _add(sums[0], sums[k])
                    else:
                        _sort(sums, count, rank[i])
                chosen = sums[0] if rank[i] == 0 else sums[rank[i] - 1]
                any_alive = _within(chosen, low[i], high[i], alive)
                if not any_alive:
                    break
            if any_alive:
                for z in range(nz):
                    if alive[z]:
                        if found < survivors.shape[0]:
                            survivors[found, 0] = x
                            survivors[found, 1] = y
                            survivors[found, 2] = z
                        found += 1
    return found


@rule
def _add(a, b):  # type: ignore[no-untyped-def]
    for z in range(a.shape[0]):
        a[z] += b[z]


@rule
def _sort(rows, count, rank):  # type: ignore[no-untyped-def]
    """Bring the ``rank``-th smallest of ``count`` rows to row rank - 1, element by element."""
    if 2 * rank <= count:
        for i in range(rank):
            for j in range(i + 1, count):
                _order(rows[i], rows[j])
    else:
        for i in range(count - 1, rank - 2, -1):
            for j in range(i):
                _order(rows[j], rows[i])


@rule
def _order(a, b):  # type: ignore[no-untyped-def]
    for z in range(a.shape[0]):
        low = min(a[z], b[z])
        high = max(a[z], b[z])
        a[z] = low
        b[z] = high


@rule
def _within(sums, low, high, alive):  # type: ignore[no-untyped-def]
    left = np.uint8(0)
    lowest = np.uint32(min(max(low, 0), 0xFFFFFFFF))
    highest = np.uint32(min(max(high, 0), 0xFFFFFFFF))
    for z in range(sums.shape[0]):
        value = np.uint32(sums[z])
        alive[z] &= np.uint8((value >= lowest) & (value <= highest))
        left |= alive[z]
    return left != 0


def column_bound(gate: CompiledGate) -> npt.NDArray[np.int64]:
    """Return x0 x1 y0 y1 and the count that every passing voxel's column window must hold.

    It follows from the condition with the highest lower limit on a single box: what is in the box is in its column.
    """
    best = np.zeros(5, dtype=np.int64)
    for i, low in enumerate(gate.low):
        if gate.start[i + 1] - gate.start[i] == 1 and low > best[4]:
            best[:4] = gate.boxes[gate.start[i], :4]
            best[4] = low
    return best


def pass_gate(S: Integral, gate: CompiledGate) -> npt.NDArray[np.int32]:
    """Return the voxels (n, 3) of the integral volume ``S`` that pass, in the order of x, y, z."""
    least = column_bound(gate)
    arguments = (gate.boxes, gate.start, gate.rank, gate.low, gate.high, least)
    count = gate_columns(S, 0, S.shape[0] - 1, *arguments, np.empty((0, 3), np.int32))
    survivors = np.empty((count, 3), np.int32)
    gate_columns(S, 0, S.shape[0] - 1, *arguments, survivors)
    return survivors
