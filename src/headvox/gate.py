"""Stage 1: the gate. A few signed box sums, for every voxel of the volume, throw out almost all of them.

It knows nothing of orientation. A voxel passes when each condition's statistic (a weighted sum over boxes, or the kth
smallest of the sums of a group) lies within its limits. The boxes' corners are read a column of voxels at a time, so
the compiler turns every step into vector instructions; a column is left as soon as no voxel of it is alive.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.integral import VECTOR, Integral
from headvox.kernels import kernel, rule
from headvox.masks import CompiledGate


@rule
def _column_sums(S, x, y, box, weight, bottom, out, adding):  # type: ignore[no-untyped-def]
    """Write to ``out``, or add to it, the weighted sums over ``box`` about the voxels of a column, from ``bottom`` up.

    In x and y the box is cut off at the edges of S; in z it has to lie within S.
    """
    nx, ny, length = S.shape[0] - 1, S.shape[1] - 1, out.shape[0]
    x0, x1 = min(max(x + box[0], 0), nx), min(max(x + box[1], 0), nx)
    y0, y1 = min(max(y + box[2], 0), ny), min(max(y + box[3], 0), ny)
    a, b, c, d = S[x1, y1], S[x0, y1], S[x1, y0], S[x0, y0]
    # Unsigned, because a signed index costs a check for counting from the end, and the loop its vectors.
    low, high = np.uint64(bottom + box[4]), np.uint64(bottom + box[5])
    if adding:
        for z in range(np.uint64(length)):
            i, j = z + high, z + low
            out[z] += weight * (((a[i] - b[i]) - (c[i] - d[i])) - ((a[j] - b[j]) - (c[j] - d[j])))
    else:
        for z in range(np.uint64(length)):
            i, j = z + high, z + low
            out[z] = weight * (((a[i] - b[i]) - (c[i] - d[i])) - ((a[j] - b[j]) - (c[j] - d[j])))


@kernel
def gate_columns(  # type: ignore[no-untyped-def]
    S,
    first,
    last,
    bottom,
    top,
    boxes,
    weights,
    start,
    rank,
    limits,
    least,
    every_other,
    odd,
    sums,
    alive,
    survivors,
):
    """Write the voxels of the slices ``first`` to ``last`` that pass to ``survivors`` (n, 3); return how many.

    Only voxels from ``bottom`` to ``top`` count; about them, no box may leave S in z. ``least`` is x0 x1 y0 y1 and a
    count: a window that holds fewer in the whole column cannot pass, whatever z. With ``every_other``, only voxels
    whose x + y + z + ``odd`` is even count. ``sums`` and ``alive``, a whole number of vectors long, are working memory.
    Counting goes on past the end of ``survivors``, so that the caller can tell how many did not fit.
    """
    nx, ny, n = S.shape[0] - 1, S.shape[1] - 1, S.shape[2]
    found = 0
    # A whole column may wrap around where no box does; a voxel has 8 parts at most.
    fits = S.itemsize > 2 or (least[1] - least[0]) * (least[3] - least[2]) * n * 8 <= 0xFFFF
    for x in range(first, last):
        wx0, wx1 = min(max(x + least[0], 0), nx), min(max(x + least[1], 0), nx)
        for y in range(ny):
            wy0, wy1 = min(max(y + least[2], 0), ny), min(max(y + least[3], 0), ny)
            window = (S[wx1, wy1, n - 1] - S[wx0, wy1, n - 1]) - (S[wx1, wy0, n - 1] - S[wx0, wy0, n - 1])
            if fits and (window & 0xFFFFFFFF) < least[4]:
                continue
            if every_other:
                parity = x + y + bottom + odd + 1
                for z in range(alive.shape[0]):
                    alive[z] = (parity + z) & 1
            else:
                alive[:] = 1
            any_alive = True
            for i in range(rank.shape[0]):
                begin, count = start[i], start[i + 1] - start[i]
                if rank[i] == 0:
                    for k in range(count):
                        _column_sums(S, x, y, boxes[begin + k], weights[begin + k], bottom, sums[0], k > 0)
                    any_alive = _within(sums[0], limits[i, 0], limits[i, 1], alive)
                else:
                    for k in range(count):
                        _column_sums(S, x, y, boxes[begin + k], 1, bottom, sums[k], False)
                    _sort(sums, count, rank[i])
                    any_alive = _within(sums[rank[i] - 1], limits[i, 0], limits[i, 1], alive)
                if not any_alive:
                    break
            if any_alive:
                for z in range(top - bottom):
                    if alive[z]:
                        if found < survivors.shape[0]:
                            survivors[found, 0] = x
                            survivors[found, 1] = y
                            survivors[found, 2] = bottom + z
                        found += 1
    return found


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
    for z in range(sums.shape[0]):
        alive[z] &= np.uint8((sums[z] >= low) & (sums[z] <= high))
        left |= alive[z]
    return left != 0


def column_bound(gate: CompiledGate) -> npt.NDArray[np.int64]:
    """Return x0 x1 y0 y1 and the count that every passing voxel's column window must hold.

    It follows from the condition with the highest lower limit on a single box: what is in the box is in its column.
    """
    best = np.zeros(5, dtype=np.int64)
    for i, low in enumerate(gate.low):
        first = gate.start[i]
        if gate.start[i + 1] - first == 1 and gate.weights[first] == 1 and low > best[4]:
            best[:4] = gate.boxes[first, :4]
            best[4] = low
    return best


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


def margins(gate: CompiledGate) -> tuple[int, int]:
    """Return how many voxels below and above a candidate the boxes of ``gate`` reach."""
    return int(max(-gate.boxes[:, 4].min(initial=0), 0)), int(max(gate.boxes[:, 5].max(initial=0), 0))


def padded(height: int) -> int:
    """Return the least whole number of vectors that holds ``height`` voxels."""
    return -(-height // VECTOR) * VECTOR


@dataclass(frozen=True, slots=True)
class GateTables:
    """A gate for one type of integral volume, and the working memory of one thread."""

    tables: tuple[npt.NDArray[Any], ...]
    """Boxes, weights, starts, ranks, limits in the type of the sums, and the column bound."""
    every_other: bool
    sums: npt.NDArray[Any]
    """Flat: :meth:`memory` cuts it to the height of the columns."""
    alive: npt.NDArray[np.uint8]

    @classmethod
    def of(cls, gate: CompiledGate, sum_type: np.dtype[Any], height: int) -> GateTables:
        """Return the tables for an integral volume of ``sum_type`` and candidates in columns up to ``height``."""
        signed = np.dtype(f"i{sum_type.itemsize}")
        most = int(np.diff(gate.start).max(initial=1))
        least, greatest = np.iinfo(signed).min, np.iinfo(signed).max
        limits = np.clip(np.stack([gate.low, gate.high], axis=1), least, greatest).astype(signed)
        return cls(
            (gate.boxes, gate.weights, gate.start, gate.rank, limits, column_bound(gate)),
            gate.every_other,
            np.empty(most * padded(height), signed),
            np.empty(padded(height), np.uint8),
        )

    def memory(self, height: int) -> tuple[npt.NDArray[Any], ...]:
        """Return sums and alive for columns of ``height``, at most the height they were made for."""
        most, length = len(self.sums) // len(self.alive), padded(height)
        return self.sums[: most * length].reshape(most, length), self.alive[:length]


def pass_gate(S: Integral, gate: CompiledGate, odd: int = 0) -> npt.NDArray[np.int32]:
    """Return the voxels (n, 3) of the integral volume ``S`` that pass, in the order of x, y, z.

    ``odd`` is that of the lattice, for a gate that looks at every other voxel only.
    """
    below, above = margins(gate)
    height = S.shape[2] - 1
    longer = np.pad(S, ((0, 0), (0, 0), (below, padded(height) - height + above)), mode="edge")
    longer[:, :, :below] = 0
    tables = GateTables.of(gate, S.dtype, height)
    arguments = (longer, 0, S.shape[0] - 1, below, below + height, *tables.tables)
    arguments += (gate.every_other, odd + below, *tables.memory(height))
    count = gate_columns(*arguments, np.empty((0, 3), np.int32))
    survivors = np.empty((count, 3), np.int32)
    gate_columns(*arguments, survivors)
    survivors[:, 2] -= below
    return survivors
