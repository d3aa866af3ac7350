"""A closer look at the peaks: the best voxel about each, what the cameras saw there, and the report to the host."""

from __future__ import annotations

import numpy as np
from numba import cuda

from headvox.cuda.gate import cell_of
from headvox.cuda.lanes import device, floored, kernel, on_device, product_32
from headvox.cuda.readings import (
    DATA,
    DEPTH,
    HEADER,
    HEIGHT,
    KIND,
    SEES,
    SENSOR,
    SENSORS,
    TABLE,
    THRESHOLD,
    WIDTH,
)
from headvox.cuda.suppress import CANDIDATES, JUDGED, KEPT, PEAKS
from headvox.visibility import EMPTY, HIDDEN, pixel_of, project, state_at
from headvox.vote import DROPPED

_pixel_of = on_device(pixel_of, project=on_device(project, product=product_32), floored=floored)
_state_at = on_device(state_at, product=product_32)

# The report of a frame: a few numbers, then a row for each peak that was judged.
TOTAL, FOUND, COUNT = 0, 1, 2
REPORT_HEADER = 4
PLACE, SCORE, YAW, PATCH = 0, 1, 2, 3
ROW = 4


@kernel
def keep_best(counts, steps, about_scores, peaks, peak_places, best, judged, judged_places, judged_scores):  # type: ignore[no-untyped-def]
    """Move each peak to the best voxel about it; of those that meet, and those that were dropped, keep the first.

    ``about_scores`` (frames, most * len(steps)) are of the voxels ``steps`` from each of the ``peak_places``; ``best``
    (frames, most) is working memory. One block a frame.
    """
    frame, each = cuda.blockIdx.y, steps.shape[0]
    count = counts[frame, PEAKS]
    for i in range(cuda.threadIdx.x, count, cuda.blockDim.x):
        k = 0
        for other in range(1, each):
            if about_scores[frame, i * each + other] > about_scores[frame, i * each + k]:
                k = other
        best[frame, i] = k
    cuda.syncthreads()
    if cuda.threadIdx.x > 0:
        return
    kept = 0
    for i in range(count):
        place, score = (
            peak_places[frame, i] + steps[best[frame, i]],
            about_scores[frame, i * each + best[frame, i]],
        )
        new = score > DROPPED
        for j in range(kept):
            new = new and judged_places[frame, j] != place
        if new:
            judged[frame, kept] = peaks[frame, i]
            judged_places[frame, kept] = place
            judged_scores[frame, kept] = score
            kept += 1
    counts[frame, JUDGED] = kept


@kernel
def look_about(S, whole, quads, half, counts, judged_places, offsets, states):  # type: ignore[no-untyped-def]
    """Write what the cameras saw of the cells about each judged peak to ``states`` (frames, most, offsets)."""
    frame, cells = cuda.blockIdx.y, offsets.shape[0]
    if whole[frame, SEES] == 0:
        return
    volume = S[frame]
    for i in range(cuda.grid(1), counts[frame, JUDGED] * cells, cuda.gridsize(1)):
        n, k = i // cells, i % cells
        x, y, z = cell_of(judged_places[frame, n], volume)
        state = 0
        for sensor in range(whole[frame, SENSORS]):
            at = HEADER + sensor * SENSOR
            if whole[frame, at + KIND] == DEPTH and state != EMPTY:
                data, width, height = (
                    whole[frame, at + DATA],
                    whole[frame, at + WIDTH],
                    whole[frame, at + HEIGHT],
                )
                camera = quads[frame, (at + TABLE) // 4 : (at + TABLE) // 4 + 4]
                column, row, far = _pixel_of(
                    camera,
                    np.float32(x + offsets[k, 0]),
                    np.float32(y + offsets[k, 1]),
                    np.float32(z + offsets[k, 2]),
                )
                if 0 <= column < width and 0 <= row < height:
                    state = max(state, _state_at(half[frame, data + row * width + column], camera, far))
        states[frame, n, k] = state


@kernel
def count_states(whole, counts, states, start, seen):  # type: ignore[no-untyped-def]
    """Count the EMPTY and the HIDDEN cells of each box about each judged peak: ``seen`` (frames, most, boxes, 2)."""
    frame, boxes = cuda.blockIdx.y, seen.shape[2]
    if whole[frame, SEES] == 0:
        return
    for i in range(cuda.grid(1), counts[frame, JUDGED] * boxes, cuda.gridsize(1)):
        n, b = i // boxes, i % boxes
        empty = 0
        hidden = 0
        for k in range(start[b], start[b + 1]):
            empty += states[frame, n, k] == EMPTY
            hidden += states[frame, n, k] == HIDDEN
        seen[frame, n, b, 0] = empty
        seen[frame, n, b, 1] = hidden


@device
def joined(low, high):  # type: ignore[no-untyped-def]
    """Return the int64 that two int32 are the halves of."""
    return (np.int64(high) << np.int64(32)) | (np.int64(low) & np.int64(0xFFFFFFFF))


@kernel
def report(S, whole, counts, judged, judged_places, judged_scores, yaws, kept, rows):  # type: ignore[no-untyped-def]
    """Write a frame's report to ``rows`` (frames, N), and which of the judged are worth a patch to ``kept``.

    One thread a frame: the peaks are few.
    """
    frame = cuda.blockIdx.y
    if cuda.grid(1) > 0:
        return
    count = counts[frame, JUDGED]
    threshold = joined(whole[frame, THRESHOLD], whole[frame, THRESHOLD + 1])
    rows[frame, TOTAL] = S[frame, S.shape[1] - 1, S.shape[2] - 1, S.shape[3] - 1] > 0
    rows[frame, FOUND] = counts[frame, CANDIDATES]
    rows[frame, COUNT] = count
    found = 0
    for i in range(count):
        at, score = REPORT_HEADER + ROW * i, judged_scores[frame, i]
        rows[frame, at + PLACE] = judged_places[frame, i]
        rows[frame, at + SCORE] = score
        rows[frame, at + YAW] = yaws[frame, judged[frame, i]]
        rows[frame, at + PATCH] = found if score >= threshold else -1
        if score >= threshold:
            kept[frame, found] = judged_places[frame, i]
            found += 1
    counts[frame, KEPT] = found


@kernel
def copy_patches(S, counts, cells, kept, reach, patches, begin):  # type: ignore[no-untyped-def]
    """Write the cells within ``reach`` of each kept place to ``patches`` (frames, N), side³ each, from ``begin`` on.

    ``cells`` (frames, N) is the grid as it is on the host, cell by cell. Beyond its edges is 0.
    """
    frame, side = cuda.blockIdx.y, 2 * reach + 1
    volume = S[frame]
    nx, ny, nz = volume.shape[0] - 1, volume.shape[1] - 1, volume.shape[2] - 1
    each = side * side * side
    for i in range(cuda.grid(1), counts[frame, KEPT] * each, cuda.gridsize(1)):
        n, k = i // each, i % each
        x, y, z = cell_of(kept[frame, n], volume)
        x, y, z = x + k // (side * side) - reach, y + k // side % side - reach, z + k % side - reach
        inside = 0 <= x < nx and 0 <= y < ny and 0 <= z < nz
        patches[frame, begin + i] = cells[frame, (x * ny + y) * nz + z] if inside else 0
