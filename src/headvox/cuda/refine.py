"""Spheres through the parts about the peaks, by :mod:`headvox.refine`'s rules, and of heads that overlap the best.

A block fits a sphere: its threads share out the cells about the peak.
"""

from __future__ import annotations

import numpy as np
from numba import cuda

from headvox.assemble import RADIUS_M as UNFITTED_M
from headvox.cuda.blocks import sum_rows
from headvox.cuda.gate import cell_of
from headvox.cuda.lanes import MATH, device, kernel, on_device, product_64
from headvox.cuda.readings import EXPECTED, EXPECTED_AT, HAIRED, LEAST, ORIGIN, THRESHOLD
from headvox.cuda.suppress import HEADS, JUDGED, KEPT
from headvox.machine.cholesky import factor, substitute, substitute_back
from headvox.refine import (
    HAIR_M,
    RADIUS,
    RADIUS_M,
    STEPS,
    SUMS,
    add_part,
    add_priors,
    add_weighed,
    part_at,
    take_step,
    weigh_part,
)

MOST_THREADS = 128  # of a block; a power of two

_part_at = on_device(part_at, np=MATH)
_add_part = on_device(
    add_part, weigh_part=on_device(weigh_part, np=MATH), add_weighed=on_device(add_weighed, np=MATH)
)
_add_priors = on_device(add_priors, np=MATH)
_take_step = on_device(
    take_step,
    np=MATH,
    factor=on_device(factor, np=MATH),
    substitute=on_device(substitute),
    substitute_back=on_device(substitute_back),
)


@device
def joined(low, high):
    """Return the int64 that two int32 are the halves of."""
    return (np.int64(high) << np.int64(32)) | (np.int64(low) & np.int64(0xFFFFFFFF))


@device
def centre_of(place, S, origin, voxel_m, axis):
    """Return a coordinate of the centre of the voxel at ``place``, world, metres: as the CPU has it."""
    return product_64(cell_of(place, S)[axis] + 0.5, voxel_m) + origin[axis]


@kernel
def keep(S, whole, wide, octets, counts, places, scores, voxel_m, kept):
    """List in ``kept`` (frames, most) which of the judged peaks are heads: see :func:`headvox.keep.keep`.

    ``wide`` (frames, N) is the uploaded row as float64, and ``octets`` (frames, N, 8) the same in eights. One thread a
    frame: the peaks are few.
    """
    frame = cuda.blockIdx.y
    if cuda.grid(1) > 0:
        return
    volume, origin = S[frame], wide[frame, ORIGIN : ORIGIN + 3]
    threshold = joined(whole[frame, THRESHOLD], whole[frame, THRESHOLD + 1])
    least = joined(whole[frame, LEAST], whole[frame, LEAST + 1])
    first, expected = whole[frame, EXPECTED_AT], whole[frame, EXPECTED]
    found = 0
    for i in range(counts[frame, JUDGED]):
        score, place = scores[frame, i], places[frame, i]
        is_head = score >= least
        if score >= threshold and not is_head:
            for e in range(expected):
                squared = 0.0
                for axis in range(3):
                    away = centre_of(place, volume, origin, voxel_m, axis) - octets[frame, first + e, axis]
                    squared += product_64(away, away)
                is_head = is_head or MATH.sqrt(squared) <= octets[frame, first + e, 7] + voxel_m
        if is_head:
            kept[frame, found] = i
            found += 1
    counts[frame, KEPT] = found


@kernel
def fit_spheres(
    S, whole, wide, cells, counts, places, kept, reach, voxel_m, subdivision, counting, fits, spheres
):
    """Write to ``spheres`` (frames, most, 4) the centre, world, and the radius of each kept peak's sphere.

    ``cells`` (frames, N) is the grid as it is on the host, cell by cell, of which those within ``reach`` voxels count.
    Unless it ``fits``, the voxel's own centre is written.
    """
    partial = cuda.shared.array((MOST_THREADS, SUMS), np.float64)
    sphere = cuda.shared.array(4, np.float64)
    A = cuda.shared.array((4, 4), np.float64)
    b = cuda.shared.array(4, np.float64)
    frame, thread, threads = cuda.blockIdx.y, cuda.threadIdx.x, cuda.blockDim.x
    volume, side = S[frame], 2 * reach + 1
    nx, ny, nz = volume.shape[0] - 1, volume.shape[1] - 1, volume.shape[2] - 1
    part_m = voxel_m / subdivision
    origin = wide[frame, ORIGIN : ORIGIN + 3]
    for i in range(cuda.blockIdx.x, counts[frame, KEPT], cuda.gridDim.x):
        place = places[frame, kept[frame, i]]
        x, y, z = cell_of(place, volume)
        for k in range(thread, 4, threads):
            sphere[k] = 0.0 if k < RADIUS else RADIUS_M
        cuda.syncthreads()
        for _ in range(STEPS if fits else 0):
            mine = partial[thread]
            for k in range(SUMS):
                mine[k] = 0.0
            if thread == 0:
                _add_priors(sphere, mine)
            for k in range(thread, side * side * side, threads):
                a, c, d = k // (side * side) - reach, k // side % side - reach, k % side - reach
                if not (0 <= x + a < nx and 0 <= y + c < ny and 0 <= z + d < nz):
                    continue
                value = np.int64(cells[frame, ((x + a) * ny + y + c) * nz + z + d])
                if counting and value > 0:
                    value = np.int64(1)
                for part in range(8):
                    if value >> part & 1:
                        px, py, pz, near = _part_at(a, c, d, part, voxel_m, part_m)
                        if near:
                            _add_part(px, py, pz, sphere, mine)
            sum_rows(partial, thread, threads)
            if thread == 0:
                _take_step(partial[0], A, b, sphere)
            cuda.syncthreads()
        for axis in range(thread, 3, threads):
            centre = centre_of(place, volume, origin, voxel_m, axis)
            if fits:
                centre += sphere[axis]
            if fits and axis == 2 and whole[frame, HAIRED]:
                centre -= HAIR_M
            spheres[frame, i, axis] = centre
        if thread == 0:
            spheres[frame, i, RADIUS] = sphere[RADIUS] if fits else UNFITTED_M
        cuda.syncthreads()


@kernel
def suppress_overlaps(counts, scores, kept, spheres, distance_m, order, heads):
    """List in ``heads`` (frames, most) which of the kept are no closer than ``distance_m`` to a better one, best first.

    ``order`` is working memory. One block a frame: see :func:`headvox.suppress.suppress_overlaps`.
    """
    frame, thread, threads = cuda.blockIdx.y, cuda.threadIdx.x, cuda.blockDim.x
    count = counts[frame, KEPT]
    for i in range(thread, count, threads):
        score, rank = scores[frame, kept[frame, i]], 0
        for j in range(count):
            other = scores[frame, kept[frame, j]]
            rank += other > score or (other == score and j < i)
        order[frame, rank] = i
    cuda.syncthreads()
    if thread > 0:
        return
    found = 0
    for rank in range(count):
        i, alone = order[frame, rank], True
        for k in range(found):
            j, squared = heads[frame, k], 0.0
            for axis in range(3):
                away = spheres[frame, i, axis] - spheres[frame, j, axis]
                squared += product_64(away, away)
            alone = alone and squared >= distance_m * distance_m
        if alone:
            heads[frame, found] = i
            found += 1
    counts[frame, HEADS] = found
