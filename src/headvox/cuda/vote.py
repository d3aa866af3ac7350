"""Stage 2 on the device: a thread a candidate for the paper's votes, a block a candidate for boosted stages.

The threads of a block share out the boxes, then the groups, then the trees of a stage; what they add up is whole
numbers, so that the order does not matter.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import cuda

from headvox.cuda.blocks import sum_of_all
from headvox.cuda.gate import cell_of
from headvox.cuda.lanes import LANE_WISE, device, kernel, on_device, product_64, sum_about_voxel
from headvox.cuda.readings import OF_NONE, SEES
from headvox.masks.compile import CompiledStages, CompiledVotes
from headvox.vote import DROPPED, FEATURES_PER_GROUP, StageTables, order, rank, statistics_of, votes_at

MOST_THREADS = 256  # of a block; a power of two

_rank = on_device(rank, **LANE_WISE, order=on_device(order, **LANE_WISE))
_statistics_of = on_device(statistics_of, **LANE_WISE, rank=_rank)
_votes_at = on_device(votes_at, sum_in_halves=sum_about_voxel, product=product_64)


@kernel
def vote_masks(S, places, counts, which, table, masks, cost, min_votes, scores, yaws):
    """Write the votes for each candidate, and its best yaw: see :func:`headvox.vote.votes_at`.

    ``places`` (frames, N) are the candidates, ``counts[:, which]`` of them in each frame; ``table`` is that of
    :func:`votes_table`.
    """
    frame = cuda.blockIdx.y
    volume = S[frame]
    boxes, weights, start, pairs = table
    for i in range(cuda.grid(1), min(counts[frame, which], places.shape[1]), cuda.gridsize(1)):
        x, y, z = cell_of(places[frame, i], volume)
        score, yaw = _votes_at(volume, x, y, z, boxes, weights, start, masks, pairs, cost, min_votes)
        scores[frame, i] = score
        yaws[frame, i] = max(yaw, 0)


def votes_table(votes: CompiledVotes) -> tuple[npt.NDArray[Any], ...]:
    """Return the arrays of ``votes`` that :func:`vote_masks` reads."""
    return votes.boxes, votes.weights, votes.start, votes.pairs


@device
def leaf_of(tree, root, depth, nodes, features):
    """Return the leaf that a tree leads to, see :class:`headvox.masks.compile.CompiledStages`."""
    at = root[tree]
    for _ in range(depth[tree]):
        at = nodes[at + 2] if features[nodes[at]] <= nodes[at + 1] else nodes[at + 3]
    return nodes[at + 1]


@kernel
def vote_stages(
    S, whole, places, steps, counts, which, table, seen, asked, sees, to_stage, sums, features, scores
):
    """Write the scores of the first ``to_stage`` stages to ``scores`` (frames, N): DROPPED where a stage says so.

    Candidate i is ``steps[i % len(steps)]`` from the place ``places[:, i // len(steps)]``; ``counts[:, which]`` places
    are there. ``table`` is that of :func:`stages_table`. ``seen`` (frames, N, boxes, 2) tells how many cells of a box
    are known-empty and hidden; with ``sees``, the frames and the candidates of which no camera is ``asked`` (frames, N)
    are left alone. ``sums`` and ``features`` are working memory, a row a block.
    """
    totals = cuda.shared.array(MOST_THREADS, np.int64)
    (
        boxes, box_channel, box_seen, group_start, box_start, box_list, used_start, used, nodes, root, depth,
        stage_trees, stage_keep,
    ) = table  # fmt: skip
    frame, thread, threads = cuda.blockIdx.y, cuda.threadIdx.x, cuda.blockDim.x
    if sees and whole[frame, SEES] == OF_NONE:
        return
    volume = S[frame]
    block = frame * cuda.gridDim.x + cuda.blockIdx.x
    mine, statistics = sums[block], features[block]
    each = steps.shape[0]
    candidates = min(counts[frame, which], places.shape[1]) * each
    for i in range(cuda.blockIdx.x, candidates, cuda.gridDim.x):
        if sees and not asked[frame, i]:
            continue
        x, y, z = cell_of(places[frame, i // each] + steps[i % each], volume)
        score = np.int64(0)
        for stage in range(to_stage):
            for k in range(box_start[stage] + thread, box_start[stage + 1], threads):
                b = box_list[k]
                if box_channel[b]:
                    mine[b] = seen[frame, i, box_seen[b], box_channel[b] - 1]
                else:
                    mine[b] = sum_about_voxel(volume, x, y, z, boxes[b])
            cuda.syncthreads()
            for u in range(used_start[stage] + thread, used_start[stage + 1], threads):
                g = used[u, 0]
                first, after = group_start[g], group_start[g + 1]
                _statistics_of(
                    mine[first:after], after - first, used[u, 1], statistics, FEATURES_PER_GROUP * g
                )
            cuda.syncthreads()
            part = np.int64(0)
            for tree in range(stage_trees[stage] + thread, stage_trees[stage + 1], threads):
                part += leaf_of(tree, root, depth, nodes, statistics)
            totals[thread] = part
            score += sum_of_all(totals, thread, threads)
            if score < stage_keep[stage]:
                score = np.int64(DROPPED)
                break
        if thread == 0:
            scores[frame, i] = score


def stages_table(stages: CompiledStages) -> tuple[npt.NDArray[Any], ...]:
    """Return the arrays of ``stages`` that :func:`vote_stages` reads."""
    group_start, group_channel, seen_start, used_start, used, *_ = StageTables.of(
        stages, np.dtype(np.uint32)
    ).tables
    group_of = np.repeat(np.arange(len(group_channel)), np.diff(group_start))
    lists = [np.flatnonzero(np.isin(group_of, used[first:after, 0])) for first, after in pairwise(used_start)]
    return (
        stages.boxes,
        group_channel[group_of],
        (seen_start[group_of] + np.arange(len(group_of)) - group_start[group_of]).astype(np.int32),
        group_start,
        np.cumsum([0, *map(len, lists)]),
        np.concatenate(lists),
        used_start,
        used,
        stages.nodes,
        stages.root,
        stages.depth,
        stages.stage_trees,
        stages.stage_keep,
    )


@dataclass(frozen=True, slots=True)
class Sizes:
    """How much working memory a block of :func:`vote_stages` needs."""

    boxes: int
    features: int

    @classmethod
    def of(cls, *parts: CompiledStages | None) -> Sizes:
        """Return the largest of ``parts``."""
        there = [part for part in parts if part is not None]
        return cls(
            max((len(part.boxes) for part in there), default=1),
            FEATURES_PER_GROUP * max((len(part.group_channel) for part in there), default=1),
        )
