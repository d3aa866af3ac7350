"""Stage 2: what the survivors of the gate look like, as votes of masks or as a boosted sum of look-ups.

*Votes* (the paper): each mask is a signed sum of boxes and votes with its sign; mirrored pairs of boxes that differ
cost points; the best of a few yaws counts.

*Stages* (the default): sorted sums of rings of boxes go through small trees whose leaves are added up, all in
integers; after each stage a candidate below the stage's threshold is dropped, so most cost a few trees only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.data import I32, I64
from headvox.integral import Integral, box_reach, place, set_corners, with_margins
from headvox.machine.kernels import bare_kernel, kernel, product, rule
from headvox.machine.simd import LANES, add, choose, fill, larger, load, smaller, store, sub
from headvox.masks.cascade import STATISTICS
from headvox.masks.compile import SCORE_UNIT, CompiledStages
from headvox.slabs import ONE_SLAB, slice_of

DROPPED = -(1 << 40)
FEATURES_PER_GROUP = len(STATISTICS)


@rule
def sum_in_halves(S, x, y, z, box):
    """Return the exact sum over ``box`` about the voxel x, y, z as a signed number; S, which holds it, is in halves."""
    half = S.shape[2] // 2
    x0, x1, y0, y1 = x + box[0], x + box[1], y + box[2], y + box[3]
    z0, z1 = place(z + box[4], half), place(z + box[5], half)
    high = S[x1, y1, z1] - S[x0, y1, z1] - S[x1, y0, z1] + S[x0, y0, z1]
    low = S[x1, y1, z0] - S[x0, y1, z0] - S[x1, y0, z0] + S[x0, y0, z0]
    mask = 0xFFFF if S.itemsize == 2 else 0xFFFFFFFF
    return np.int64(high - low) & mask


# ------------------------------------------------------------------------------------------------ the paper's


@rule
def votes_at(S, x, y, z, boxes, weights, start, masks, pairs, cost, min_votes):
    """Return the score of the voxel x, y, z, in units of 1/1024, and its best yaw or -1 (paper, section 5).

    score = sum over masks of sign(weighted sum) - cost * asymmetry, the asymmetry being the mean over the mirrored
    pairs of \\|a - b\\| / (a + b). With too few positive votes at every yaw it is DROPPED.
    """
    best = -np.inf
    best_yaw = -1
    for yaw in range(pairs.shape[0]):
        votes = 0
        score = 0.0
        for m in range(yaw * masks, (yaw + 1) * masks):
            total = np.int64(0)
            for b in range(start[m], start[m + 1]):
                total += weights[b] * sum_in_halves(S, x, y, z, boxes[b])
            if total > 0:
                votes += 1
                score += 1.0
            elif total < 0:
                score -= 1.0
        unlike = 0.0
        for p in range(pairs.shape[1]):
            one = sum_in_halves(S, x, y, z, pairs[yaw, p, 0])
            other = sum_in_halves(S, x, y, z, pairs[yaw, p, 1])
            if one + other > 0:
                unlike += abs(one - other) / (one + other)
        if pairs.shape[1] > 0:
            score -= product(cost, unlike / pairs.shape[1])
        if votes >= min_votes and score > best:
            best = score
            best_yaw = yaw
    return (DROPPED if best_yaw < 0 else np.int64(math.floor(best * SCORE_UNIT))), best_yaw


@kernel
def vote_masks(
    S, seams, overlap, cells, first, last, boxes, weights, start, masks, pairs, cost, min_votes, scores, best_yaw,
):  # fmt: skip
    """Score the candidates ``first`` to ``last`` of ``cells``: see :func:`votes_at`.

    A candidate that is dropped keeps the yaw that it had. S is in halves and in slabs (:mod:`headvox.slabs`).
    """
    for i in range(first, last):
        x, y, z = slice_of(cells[i, 0], seams, overlap), cells[i, 1], cells[i, 2]
        scores[i], yaw = votes_at(S, x, y, z, boxes, weights, start, masks, pairs, cost, min_votes)
        if yaw >= 0:
            best_yaw[i] = yaw


# ---------------------------------------------------------------------------------------------------- boosted


@bare_kernel
def rank(sums, count):
    """Bring the three smallest of ``count`` rows to the first rows and the three largest to the last, lane by lane."""
    for i in range(min(3, count - 1)):
        for j in range(i + 1, count):
            order(sums, LANES * i, LANES * j)
    for i in range(count - 1, max(3, count - 3) - 1, -1):
        for j in range(3, i):
            order(sums, LANES * j, LANES * i)


@rule
def order(sums, one, other):
    """Exchange two rows where the first is larger, lane by lane."""
    a, b = load(sums, one), load(sums, other)
    store(sums, one, smaller(a, b))
    store(sums, other, larger(a, b))


@bare_kernel
def statistics_of(sums, count, ranked, features, first):
    """Write the statistics of ``count`` rows of ``sums`` to the rows of ``features`` from ``first`` on."""
    total = load(sums, 0)
    for i in range(1, count):
        total = add(total, load(sums, LANES * i))
    store(features, first + 4 * LANES, total)
    if ranked:
        rank(sums, count)
        store(features, first, load(sums, 0))
        store(features, first + LANES, load(sums, 2 * LANES))
        store(features, first + 2 * LANES, load(sums, LANES * (count - 3)))
        store(features, first + 3 * LANES, load(sums, LANES * (count - 1)))


@bare_kernel
def _add_trees(first, last, leaf_start, leaves, node_start, nodes, cuts, features, values, total):
    """Write the sum of the leaves that the trees ``first`` to ``last`` lead to, to ``total`` (LANES,).

    From the leaves down to the root, every node takes the value of its one branch or of the other: no step depends on
    where a candidate goes, so all lanes go together.
    """
    before = load(total, 0)
    score = sub(before, before)
    for t in range(first, last):
        row = np.uint64(0)
        for k in range(np.uint64(leaf_start[t]), np.uint64(leaf_start[t + 1])):
            store(values, row, fill(leaves[k]))
            row += np.uint64(LANES)
        for k in range(np.uint64(node_start[t]), np.uint64(node_start[t + 1])):
            at_most, above = load(values, nodes[k, 1]), load(values, nodes[k, 2])
            store(values, row, choose(load(features, nodes[k, 0]), cuts[k], at_most, above))
            row += np.uint64(LANES)
        score = add(score, load(values, row - np.uint64(LANES)))
    store(total, 0, score)


@bare_kernel
def _look_up(flat, at, is_odd, width, corners, first, count, sums):
    """Write the sums over ``count`` boxes from ``first`` on to as many rows of ``sums``, a lane a candidate.

    ``at`` and ``is_odd`` say where a candidate is: see :func:`headvox.integral.set_corners`.
    """
    mask = 0xFFFF if flat.itemsize == 2 else 0xFFFFFFFF
    # Unsigned, because a signed index costs a check for counting from the end.
    for k in range(np.uint64(count)):
        row, b = k * np.uint64(LANES), np.uint64(first) + k
        c0, c1, c2, c3 = corners[b, 0], corners[b, 1], corners[b, 2], corners[b, 3]
        z0, z0_if_odd, z1, z1_if_odd = corners[b, 4], corners[b, 5], corners[b, 6], corners[b, 7]
        for lane in range(np.uint64(width)):
            low = at[lane] + z0 + (z0_if_odd & is_odd[lane])
            high = at[lane] + z1 + (z1_if_odd & is_odd[lane])
            one = np.int64(flat[np.uint64(high + c0)]) - np.int64(flat[np.uint64(low + c0)])
            one -= np.int64(flat[np.uint64(high + c1)]) - np.int64(flat[np.uint64(low + c1)])
            other = np.int64(flat[np.uint64(high + c2)]) - np.int64(flat[np.uint64(low + c2)])
            other -= np.int64(flat[np.uint64(high + c3)]) - np.int64(flat[np.uint64(low + c3)])
            sums[row + lane] = (one - other) & mask


@bare_kernel
def vote_stages(
    S, seams, overlap, cells, seen, first, last, from_stage, to_stage, group_start, group_channel, seen_start,
    used_start, used, leaf_start, leaves, node_start, nodes, cuts, stage_trees, stage_keep, corners, alive, at, is_odd,
    sums, features, values, total, scores,
):  # fmt: skip
    """Write the sum of the trees of the stages before ``to_stage`` to ``scores``; DROPPED where a stage says so.

    With a ``from_stage`` above 0, ``scores`` has the sum of those before it, and none that was dropped.

    Each stage takes the candidates that are left, LANES at a time: it looks up the groups its trees ask for, and adds
    its trees up. ``seen`` (candidates, boxes of other channels, 2) holds how many cells of a box are known-empty and
    hidden. S is in halves and in slabs (:mod:`headvox.slabs`), which no box may leave; ``corners`` are those of the
    boxes. ``alive`` (candidates,), ``at`` and ``is_odd`` (LANES,) and the rows of LANES numbers ``sums``, ``features``,
    ``values`` and ``total`` are working memory.
    """
    flat, end, slices = S.reshape(-1), last, overlap * S.shape[1] * S.shape[2]
    for i in range(first, last):
        if from_stage == 0:
            scores[i] = 0
        alive[i] = i
    for s in range(from_stage, to_stage):
        kept = first
        for begin in range(first, end, LANES):
            width = min(LANES, end - begin)
            for lane in range(width):
                i = alive[begin + lane]
                column = (cells[i, 0] * S.shape[1] + cells[i, 1]) * S.shape[2]
                at[lane], is_odd[lane] = column + (cells[i, 2] >> 1), -(cells[i, 2] & 1)
            for seam in range(seams.shape[0]):  # as headvox.slabs.slice_of, of the whole vector
                for lane in range(width):
                    at[lane] += slices * (cells[alive[begin + lane], 0] >= seams[seam])
            for u in range(used_start[s], used_start[s + 1]):
                g, ranked = used[u, 0], used[u, 1]
                count, channel = group_start[g + 1] - group_start[g], group_channel[g]
                if channel:
                    for k in range(count):
                        for lane in range(width):
                            sums[LANES * k + lane] = seen[alive[begin + lane], seen_start[g] + k, channel - 1]
                else:
                    _look_up(flat, at, is_odd, width, corners, group_start[g], count, sums)
                statistics_of(sums, count, ranked, features, FEATURES_PER_GROUP * LANES * g)
            _add_trees(
                stage_trees[s], stage_trees[s + 1], leaf_start, leaves, node_start, nodes, cuts, features, values, total
            )  # fmt: skip
            for lane in range(width):
                i = alive[begin + lane]
                scores[i] += total[lane]
                alive[kept] = i
                kept += scores[i] >= stage_keep[s]
                scores[i] = scores[i] if scores[i] >= stage_keep[s] else DROPPED
        end = kept


def seen_boxes(stages: CompiledStages) -> tuple[I32, I32]:
    """Return the boxes (B, 6) that look at the channels "empty" and "hidden", and where each group's begin (G,)."""
    start = np.zeros(len(stages.group_channel), np.int32)
    boxes: list[I32] = []
    for g, channel in enumerate(stages.group_channel):
        if channel:
            start[g] = len(boxes)
            boxes += list(stages.boxes[stages.group_start[g] : stages.group_start[g + 1]])
    return np.array(boxes, np.int32).reshape(-1, 6), start


@dataclass(frozen=True, slots=True)
class StageTables:
    """Boosted stages for one type of integral volume, as :func:`vote_stages` reads them."""

    tables: tuple[npt.NDArray[Any], ...]
    sizes: tuple[int, ...]
    """Rows of sums, features and values."""
    number: np.dtype[Any]
    """What sums, cuts and the leaves of a stage added up fit in."""

    @classmethod
    def of(cls, stages: CompiledStages, sum_type: np.dtype[Any]) -> StageTables:
        """Return the tables for an integral volume of ``sum_type``."""
        nodes, depth_first = stages.nodes.reshape(-1, 4), np.arange(len(stages.nodes) // 4)
        is_leaf = nodes[:, 2] // 4 == depth_first
        tree = np.searchsorted(stages.root // 4, depth_first, side="right") - 1
        leaf_start = _starts(tree[is_leaf], len(stages.root))
        node_start = _starts(tree[~is_leaf], len(stages.root))
        # A tree's rows are its leaves, then its other nodes from the last to the first, which are children before
        # parents; the last row is the root's.
        row = np.empty(len(nodes), np.int64)
        row[is_leaf] = np.arange(is_leaf.sum()) - leaf_start[tree[is_leaf]]
        order = np.lexsort((-depth_first, tree))
        order = order[~is_leaf[order]]
        row[order] = np.arange(len(order)) - node_start[tree[order]] + np.diff(leaf_start)[tree[order]]
        inner = nodes[order]
        table = np.column_stack([inner[:, 0], row[inner[:, 2] // 4], row[inner[:, 3] // 4]])
        used = [
            _groups_used(inner[node_start[first] : node_start[last], 0])
            for first, last in zip(stages.stage_trees[:-1], stages.stage_trees[1:], strict=True)
        ]
        leaves = nodes[is_leaf, 1]
        greatest = np.abs(np.concatenate([[0], leaves])).max() * np.diff(stages.stage_trees).max(initial=0)
        narrow = sum_type.itemsize == 2 and greatest <= np.iinfo(np.int32).max
        number = np.dtype(np.int32 if narrow else np.int64)
        info = np.iinfo(np.int32 if narrow else np.int64)
        _, seen_start = seen_boxes(stages)
        return cls(
            (
                stages.group_start, stages.group_channel, seen_start,
                np.cumsum([0, *map(len, used)]), np.concatenate(used),
                leaf_start, leaves.astype(number), node_start, (LANES * table).astype(np.uint64),
                np.clip(inner[:, 1], info.min, info.max).astype(number), stages.stage_trees, stages.stage_keep,
            ),
            (
                int(np.diff(stages.group_start).max(initial=1)),
                FEATURES_PER_GROUP * len(stages.group_channel),
                int(np.bincount(tree).max()),
            ),
            number,
        )  # fmt: skip

    def memory(self) -> tuple[npt.NDArray[Any], ...]:
        """Return the working memory of one thread."""
        rows = [np.zeros(LANES * count, self.number) for count in (*self.sizes, 1)]
        return (np.zeros(LANES, np.int64), np.zeros(LANES, np.int64), *rows)


def _starts(of: I64, count: int) -> I64:
    """Return where the items of each of ``count`` owners begin, and the end; ``of`` has the items' owners in order."""
    return np.concatenate([[0], np.cumsum(np.bincount(of, minlength=count))])


def _groups_used(features: I64) -> I32:
    """Return the groups that ``features`` are of (U, 2), and whether any asks for more than the sum of the group."""
    groups = np.unique(features // FEATURES_PER_GROUP)
    not_sums = features[features % FEATURES_PER_GROUP != FEATURES_PER_GROUP - 1]
    ranked = np.isin(groups, not_sums // FEATURES_PER_GROUP)
    return np.column_stack([groups, ranked]).astype(np.int32)


def score_by_stages(S: Integral, cells: I32, stages: CompiledStages, seen: I32 | None = None) -> I64:
    """Return each candidate's score, in units of 1/1024; DROPPED where a stage dropped it.

    Without ``seen`` (candidates, boxes, 2; see :func:`headvox.visibility.count_seen`) the stages that need the
    channels "empty" and "hidden" are left out.
    """
    to_stage = stages.occupied_stages if seen is None else len(stages.stage_keep)
    seen = np.zeros((len(cells), 1, 2), np.int32) if seen is None else seen
    tables = StageTables.of(stages, S.dtype)
    reach = box_reach(stages.boxes)
    S, cells = with_margins(S, reach), cells - reach[0::2].astype(np.int32)
    corners = np.empty((len(stages.boxes), 8), np.int64)
    set_corners(S, stages.boxes, corners)
    scores, alive = np.empty(len(cells), np.int64), np.empty(len(cells), np.int64)
    settings = (seen, 0, len(cells), 0, to_stage, *tables.tables, corners, alive, *tables.memory())
    vote_stages(S, *ONE_SLAB, cells, *settings, scores)
    return scores
