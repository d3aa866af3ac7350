"""Stage 2: what the survivors of the gate look like, as votes of masks or as a boosted sum of look-ups.

*Votes* (the paper): each mask is a signed sum of boxes and votes with its sign; mirrored pairs of boxes that differ
cost points; the best of a few yaws counts.

*Stages* (the default): sorted sums of rings of boxes go through small trees whose leaves are added up, all in
integers; after each stage a candidate below the stage's threshold is dropped, so most cost a few trees only.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.integral import Integral, box_sum, set_corners
from headvox.kernels import kernel, rule
from headvox.masks import SCORE_UNIT, STATISTICS, CompiledStages, CompiledVotes

DROPPED = -(1 << 40)
FEATURES_PER_GROUP = len(STATISTICS)

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
F64 = npt.NDArray[np.float64]


@rule
def sum_about(S, x, y, z, box):  # type: ignore[no-untyped-def]
    """Return the exact sum over ``box`` about the voxel x, y, z as a signed number."""
    value = box_sum(S, x + box[0], x + box[1], y + box[2], y + box[3], z + box[4], z + box[5])
    mask = 0xFFFF if S.itemsize == 2 else 0xFFFFFFFF
    return np.int64(value) & mask


# ------------------------------------------------------------------------------------------------ the paper's


@kernel
def vote_masks(S, cells, first, last, boxes, weights, start, masks, pairs, cost, min_votes, scores, best_yaw):  # type: ignore[no-untyped-def]
    """Score the candidates ``first`` to ``last`` of ``cells``: see :func:`score_by_votes`."""
    for i in range(first, last):
        x, y, z = cells[i, 0], cells[i, 1], cells[i, 2]
        best = -np.inf
        for yaw in range(pairs.shape[0]):
            votes = 0
            score = 0.0
            for m in range(yaw * masks, (yaw + 1) * masks):
                total = np.int64(0)
                for b in range(start[m], start[m + 1]):
                    total += weights[b] * sum_about(S, x, y, z, boxes[b])
                if total > 0:
                    votes += 1
                    score += 1.0
                elif total < 0:
                    score -= 1.0
            unlike = 0.0
            for p in range(pairs.shape[1]):
                one = sum_about(S, x, y, z, pairs[yaw, p, 0])
                other = sum_about(S, x, y, z, pairs[yaw, p, 1])
                if one + other > 0:
                    unlike += abs(one - other) / (one + other)
            if pairs.shape[1] > 0:
                score -= cost * (unlike / pairs.shape[1])
            if votes >= min_votes and score > best:
                best = score
                best_yaw[i] = yaw
        scores[i] = DROPPED if best == -np.inf else np.int64(np.floor(best * SCORE_UNIT))


def score_by_votes(S: Integral, cells: I32, votes: CompiledVotes) -> tuple[I64, I32]:
    """Return each candidate's score, in units of 1/1024, and the index of its best yaw (paper, section 5).

    score = sum over masks of sign(weighted sum) - cost * asymmetry, the asymmetry being the mean over the mirrored
    pairs of \\|a - b\\| / (a + b). Candidates with too few positive votes at every yaw get DROPPED.
    """
    scores = np.empty(len(cells), np.int64)
    best_yaw = np.zeros(len(cells), np.int32)
    table = (
        votes.boxes,
        votes.weights,
        votes.start,
        votes.masks,
        votes.pairs,
        votes.asymmetry_cost,
        votes.min_votes,
    )
    vote_masks(S, cells, 0, len(cells), *table, scores, best_yaw)
    return scores, best_yaw


# ---------------------------------------------------------------------------------------------------- boosted


@rule
def _statistics(sums, count, ranked, out):  # type: ignore[no-untyped-def]
    """Write smallest, 3rd smallest, 3rd largest and largest of ``sums`` (if ``ranked``: sorts them) and the total."""
    total = sums[0]
    for i in range(1, count):
        total += sums[i]
    out[4] = total
    if ranked:
        for i in range(1, count):
            value = sums[i]
            j = i - 1
            while j >= 0 and sums[j] > value:
                sums[j + 1] = sums[j]
                j -= 1
            sums[j + 1] = value
        out[0] = sums[0]
        out[1] = sums[2]
        out[2] = sums[count - 3]
        out[3] = sums[count - 1]


@rule
def _sum_at(flat, at, corner, mask):  # type: ignore[no-untyped-def]
    """Return the sum over a box that lies within the volume: eight look-ups and no more."""
    a = np.int64(flat[at + corner[0]]) - np.int64(flat[at + corner[1]])
    b = np.int64(flat[at + corner[2]]) - np.int64(flat[at + corner[3]])
    c = np.int64(flat[at + corner[4]]) - np.int64(flat[at + corner[5]])
    d = np.int64(flat[at + corner[6]]) - np.int64(flat[at + corner[7]])
    return (a - b - c + d) & mask


@rule
def _leaf(nodes, root, depth, features):  # type: ignore[no-untyped-def]
    """Return the weight of the leaf of a tree that ``features`` lead to, without any branch to mispredict."""
    # Unsigned, because a signed index costs a check for counting from the end.
    at = np.uint64(root)
    for _ in range(depth):
        above = features[np.uint64(nodes[at])] > nodes[at + np.uint64(1)]
        at = np.uint64(nodes[at + np.uint64(2) + np.uint64(above)])
    return nodes[at + np.uint64(1)]


@kernel
def vote_stages(  # type: ignore[no-untyped-def]
    S, cells, seen, first, last, to_stage, boxes, reach, group_start, group_channel, group_ranked, seen_start, nodes,
    root, depth, stage_groups, stage_trees, stage_keep, corners, features, scores,
):  # fmt: skip
    """Write the sum of the trees of the first ``to_stage`` stages to ``scores``; DROPPED where a stage says so.

    ``corners`` (boxes, 8) and ``features`` (features,) are working memory. ``seen`` (candidates, boxes of other
    channels, 2) holds how many cells of a box are known-empty and hidden.
    """
    for b in range(boxes.shape[0]):
        set_corners(
            S, boxes[b, 0], boxes[b, 1], boxes[b, 2], boxes[b, 3], boxes[b, 4], boxes[b, 5], corners[b]
        )
    flat = S.reshape(-1)
    nx, ny, nz = S.shape[0] - 1, S.shape[1] - 1, S.shape[2] - 1
    mask = 0xFFFF if S.itemsize == 2 else 0xFFFFFFFF
    sums = np.empty(64, np.int64)
    for i in range(first, last):
        x, y, z = np.int64(cells[i, 0]), np.int64(cells[i, 1]), np.int64(cells[i, 2])
        at = np.uint64((x * S.shape[1] + y) * S.shape[2] + z)
        inside = (
            x + reach[0] >= 0 and x + reach[1] <= nx and y + reach[2] >= 0 and y + reach[3] <= ny
            and z + reach[4] >= 0 and z + reach[5] <= nz
        )  # fmt: skip
        score = np.int64(0)
        for s in range(to_stage):
            for g in range(stage_groups[s], stage_groups[s + 1]):
                begin, count, channel = group_start[g], group_start[g + 1] - group_start[g], group_channel[g]
                if channel:
                    for k in range(count):
                        sums[k] = seen[i, seen_start[g] + k, channel - 1]
                elif inside:
                    for k in range(count):
                        sums[k] = _sum_at(flat, at, corners[begin + k], mask)
                else:
                    for k in range(count):
                        sums[k] = sum_about(S, x, y, z, boxes[begin + k])
                _statistics(sums, count, group_ranked[g], features[FEATURES_PER_GROUP * g :])
            for t in range(stage_trees[s], stage_trees[s + 1]):
                score += _leaf(nodes, root[t], depth[t], features)
            if score < stage_keep[s]:
                score = np.int64(DROPPED)
                break
        scores[i] = score


def seen_boxes(stages: CompiledStages) -> tuple[I32, I32]:
    """Return the boxes (B, 6) that look at the channels "empty" and "hidden", and where each group's begin (G,)."""
    start = np.zeros(len(stages.group_channel), np.int32)
    boxes: list[I32] = []
    for g, channel in enumerate(stages.group_channel):
        if channel:
            start[g] = len(boxes)
            boxes += list(stages.boxes[stages.group_start[g] : stages.group_start[g + 1]])
    return np.array(boxes, np.int32).reshape(-1, 6), start


def feature_count(stages: CompiledStages) -> int:
    """Return how many features a candidate has."""
    return FEATURES_PER_GROUP * len(stages.group_channel)


def score_by_stages(S: Integral, cells: I32, stages: CompiledStages, seen: I32 | None = None) -> I64:
    """Return each candidate's score, in units of 1/1024; DROPPED where a stage dropped it.

    Without ``seen`` (candidates, boxes, 2; see :func:`headvox.visibility.count_seen`) the stages that need the
    channels "empty" and "hidden" are left out.
    """
    _, seen_start = seen_boxes(stages)
    to_stage = stages.occupied_stages if seen is None else len(stages.stage_keep)
    seen = np.zeros((len(cells), 1, 2), np.int32) if seen is None else seen
    scores = np.zeros(len(cells), np.int64)
    features = np.zeros(feature_count(stages), np.int64)
    corners = np.empty((len(stages.boxes), 8), np.uint64)
    vote_stages(
        S, cells, seen, 0, len(cells), to_stage, *stage_tables(stages, seen_start), corners, features, scores
    )
    return scores


def stage_tables(stages: CompiledStages, seen_start: I32) -> tuple[npt.NDArray[Any], ...]:
    """Return the tables of ``stages`` in the order of :func:`vote_stages`."""
    looked_up = stages.boxes[np.repeat(stages.group_channel == 0, np.diff(stages.group_start))].astype(
        np.int64
    )
    reach = np.array(
        [(looked_up[:, k].min if k % 2 == 0 else looked_up[:, k].max)(initial=0) for k in range(6)]
    )
    ranked = np.zeros(len(stages.group_channel), np.bool_)
    features = stages.nodes[0::4][_inner(stages.nodes)]
    ranked[features[features % FEATURES_PER_GROUP != FEATURES_PER_GROUP - 1] // FEATURES_PER_GROUP] = True
    return (
        stages.boxes, reach, stages.group_start, stages.group_channel, ranked, seen_start, stages.nodes, stages.root,
        stages.depth, stages.stage_groups, stages.stage_trees, stages.stage_keep,
    )  # fmt: skip


def _inner(nodes: I64) -> npt.NDArray[np.bool_]:
    """Tell which nodes are no leaves: a leaf leads to itself."""
    inner: npt.NDArray[np.bool_] = nodes[2::4] != np.arange(0, len(nodes), 4)
    return inner
