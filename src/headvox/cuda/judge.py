"""A closer look at the peaks: the best voxel about each, what the cameras saw there, and the report to the host."""

from __future__ import annotations

import numpy as np
from numba import cuda

from headvox.assemble import MOST_POSES
from headvox.cuda.gate import cell_of
from headvox.cuda.lanes import floored, kernel, on_device, product_32
from headvox.cuda.readings import (
    DATA,
    DEPTH,
    HEADER,
    HEIGHT,
    KIND,
    OF_NONE,
    OF_SEEN,
    SEES,
    SENSOR,
    SENSORS,
    TABLE,
    WIDTH,
)
from headvox.cuda.suppress import CANDIDATES, HEADS, JUDGED, PEAKS
from headvox.data import F64
from headvox.pose.fit import Poses
from headvox.visibility import EMPTY, HIDDEN, LEAST_EMPTY, pixel_of, project, state_at
from headvox.vote import DROPPED

_pixel_of = on_device(pixel_of, project=on_device(project, product=product_32), floored=floored)
_state_at = on_device(state_at, product=product_32)

# The report of a frame: a few numbers, then a row for each head, and for the pose of each that has one.
TOTAL, FOUND, COUNT = 0, 1, 2
REPORT_HEADER = 4
PLACE, SCORE, YAW, SPHERE = 0, 1, 2, 3
ROW = 7
POSE = 29


@kernel
def keep_best(counts, steps, about_scores, peaks, peak_places, best, judged, judged_places, judged_scores):
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
def look_about(S, whole, quads, half, counts, judged_places, offsets, states):
    """Write what the cameras saw of the cells about each judged peak to ``states`` (frames, most, offsets)."""
    frame, cells = cuda.blockIdx.y, offsets.shape[0]
    if whole[frame, SEES] == OF_NONE:
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
def count_states(whole, counts, states, start, seen):
    """Count the EMPTY and the HIDDEN cells of each box about each judged peak: ``seen`` (frames, most, boxes, 2)."""
    frame, boxes = cuda.blockIdx.y, seen.shape[2]
    if whole[frame, SEES] == OF_NONE:
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


@kernel
def ask_of(whole, counts, states, shift, asked, judged_scores):
    """Write of which judged peaks the cameras are ``asked`` (frames, most): see :func:`headvox.visibility.not_seen`.

    To the ``judged_scores`` of the others ``shift`` is added: :func:`headvox.keep.shift_of_unseen`.
    """
    frame, cells = cuda.blockIdx.y, states.shape[2]
    for n in range(cuda.grid(1), counts[frame, JUDGED], cuda.gridsize(1)):
        empty = 0
        for k in range(cells):
            empty += states[frame, n, k] == EMPTY
        asked[frame, n] = whole[frame, SEES] != OF_SEEN or LEAST_EMPTY * empty >= cells
        if not asked[frame, n]:
            judged_scores[frame, n] += shift


@kernel
def report(
    S, counts, judged, judged_places, judged_scores, yaws, kept, heads, spheres, poses, has_poses, rows, real
):
    """Write a frame's report to ``rows`` (frames, N), which ``real`` is as float64; a thread a head.

    ``poses`` are of the first heads of each frame, :data:`headvox.assemble.MOST_POSES` rows each.
    """
    frame, most = cuda.blockIdx.y, heads.shape[1]
    count = counts[frame, HEADS]
    if cuda.grid(1) == 0:
        rows[frame, TOTAL] = S[frame, S.shape[1] - 1, S.shape[2] - 1, S.shape[3] - 1] > 0
        rows[frame, FOUND] = counts[frame, CANDIDATES]
        rows[frame, COUNT] = count
    for head in range(cuda.grid(1), count, cuda.gridsize(1)):
        at, i = REPORT_HEADER + ROW * head, heads[frame, head]
        peak = kept[frame, i]
        rows[frame, at + PLACE] = judged_places[frame, peak]
        rows[frame, at + SCORE] = judged_scores[frame, peak]
        rows[frame, at + YAW] = yaws[frame, judged[frame, peak]]
        for k in range(4):
            real[frame, at + SPHERE + k] = spheres[frame, i, k]
        if head >= MOST_POSES or not has_poses:
            continue
        at, i = REPORT_HEADER + ROW * most + POSE * head, frame * MOST_POSES + head
        real[frame, at], real[frame, at + 1] = poses.radii[i], poses.misfits[i]
        real[frame, at + 2], real[frame, at + 3] = poses.coverages[i], poses.crossings[i]
        for k in range(4):
            real[frame, at + 4 + k] = poses.quaternions[i, k]
        for a in range(3):
            real[frame, at + 8 + a] = poses.centres[i, a]
            for b in range(3):
                real[frame, at + 11 + 3 * a + b] = poses.centre_covariances[i, a, b]
                real[frame, at + 20 + 3 * a + b] = poses.rotation_covariances[i, a, b]


def poses_of(rows: F64) -> Poses:
    """Return the poses that are in a report's rows (N, POSE)."""
    radii, misfits, coverages, crossings = rows[:, :4].T.copy()
    return Poses(
        rows[:, 8:11].copy(),
        rows[:, 4:8].copy(),
        radii,
        rows[:, 11:20].reshape(-1, 3, 3).copy(),
        rows[:, 20:29].reshape(-1, 3, 3).copy(),
        misfits,
        coverages,
        crossings,
    )
