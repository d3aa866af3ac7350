"""The slow and obvious twin of the search: gate, votes and boosted trees, and suppression."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
from naive_visibility import count_in
from naive_voxels import about, box_sum, volume, voxel_box

from headvox.masks.cascade import Cascade, Condition, Group, Votes

DROPPED = -(2**40)
SCORE_UNIT = 1024


# ----------------------------------------------------------------------------------------------------------------- gate


def condition_holds(amount: np.ndarray, cell, condition: Condition, voxel: float, unit: int) -> bool:
    boxes = [(voxel_box(box, voxel), box.weight) for box in condition.group.boxes]
    sums = [box_sum(amount, about(cell, box)) for box, _ in boxes]
    if condition.rank:
        got = sorted(sums)[condition.rank - 1]
        cells = sum(volume(box) for box, _ in boxes) * unit / len(boxes)
    else:
        got = sum(weight * total for (_, weight), total in zip(boxes, sums, strict=True))
        cells = sum(weight * volume(box) for box, weight in boxes if weight > 0) * unit
    return round(condition.minimum * cells, 6) <= got <= round(condition.maximum * cells, 6)


def is_candidate(cell, spacing: int, odd=(0, 0, 0)) -> bool:
    x, y, z = ((c + o) % 2 for c, o in zip(cell, odd, strict=True))
    return spacing == 1 or (spacing == 2 and (x + y + z) % 2 == 0) or (spacing == 4 and x == y == z)


def gate(amount: np.ndarray, cascade: Cascade, voxel: float, odd=(0, 0, 0)) -> np.ndarray:
    """Return the voxels that pass every condition, in the order of x, y, z."""
    unit = 1 if cascade.counting else cascade.subdivision**3
    passed = [
        (x, y, z)
        for x in range(amount.shape[0])
        for y in range(amount.shape[1])
        for z in range(amount.shape[2])
        if is_candidate((x, y, z), cascade.spacing, odd)
        and all(condition_holds(amount, (x, y, z), c, voxel, unit) for c in cascade.conditions)
    ]
    return np.array(passed, np.int32).reshape(-1, 3)


# ----------------------------------------------------------------------------------------------------------------- vote


def score_by_votes(amount: np.ndarray, cell, votes: Votes, voxel: float) -> tuple[int, int]:
    """Return the score of the best yaw, in units of 1/1024, and which yaw that is."""
    best, best_yaw = -math.inf, 0
    for i, yaw in enumerate(math.radians(deg) for deg in votes.yaws_deg):
        sums = [
            sum(box.weight * box_sum(amount, about(cell, voxel_box(box, voxel, yaw))) for box in mask.boxes)
            for mask in votes.masks
        ]
        positive = sum(total > 0 for total in sums)
        score = float(positive - sum(total < 0 for total in sums))
        if votes.mirrored:
            unlike = 0.0
            for pair in votes.mirrored:
                a, b = (box_sum(amount, about(cell, voxel_box(box, voxel, yaw))) for box in pair)
                unlike += abs(a - b) / (a + b) if a + b else 0.0
            score -= votes.asymmetry_cost * (unlike / len(votes.mirrored))
        if positive >= votes.min_votes and score > best:
            best, best_yaw = score, i
    return (DROPPED if best == -math.inf else math.floor(best * SCORE_UNIT)), best_yaw


def group_sums(group: Group, amount: np.ndarray, cell, states, voxel: float) -> list[int]:
    boxes = [about(cell, voxel_box(box, voxel)) for box in group.boxes]
    if group.channel == "occupied":
        return [box_sum(amount, box) for box in boxes]
    return [count_in(states, box)[0 if group.channel == "empty" else 1] for box in boxes]


def feature(name: str, cascade: Cascade, amount: np.ndarray, cell, states, voxel: float) -> tuple[int, float]:
    """Return the statistic ``name`` and the volume that makes a share of it."""
    group_name, statistic = name.rsplit(".", 1)
    (group,) = [group for group in cascade.groups if group.name == group_name]
    sums = sorted(group_sums(group, amount, cell, states, voxel))
    parts = cascade.subdivision**3 if group.channel == "occupied" and not cascade.counting else 1
    cells = sum(volume(voxel_box(box, voxel)) for box in group.boxes) * parts
    if statistic == "sum":
        return sum(sums), cells
    return sums[{"min": 0, "low": 2, "high": -3, "max": -1}[statistic]], cells / len(sums)


def tree_leaf(tree, look) -> float:
    """Return the leaf that a tree leads to; ``look`` gives a feature and the volume of its boxes."""
    if not isinstance(tree, tuple):
        return tree
    name, cut, at_most, above = tree
    got, cells = look(name)
    return tree_leaf(at_most if got <= round(cut * cells, 6) else above, look)


def names_in(tree) -> set[str]:
    if not isinstance(tree, tuple):
        return set()
    return {tree[0]} | names_in(tree[2]) | names_in(tree[3])


def score_by_stages(
    amount: np.ndarray, cell, cascade: Cascade, voxel: float, states=None, judge=False
) -> int:
    """Return the score in units of 1/1024. Without ``states`` the first stage that needs them ends it."""
    seeing = {group.name for group in cascade.groups if group.channel != "occupied"}
    known = {}

    def look(name):
        if name not in known:
            known[name] = feature(name, cascade, amount, cell, states, voxel)
        return known[name]

    score = 0
    for stage in cascade.judge if judge else cascade.stages:
        needed = {name.rsplit(".", 1)[0] for tree in stage.trees for name in names_in(tree)}
        if states is None and needed & seeing:
            break
        score += sum(round(tree_leaf(tree, look) * SCORE_UNIT) for tree in stage.trees)
        if score < stage.keep * SCORE_UNIT:
            return DROPPED
    return score


# ------------------------------------------------------------------------------------------------------------- suppress


def best_of_each(cells: np.ndarray, scores, group: int, least) -> list[int]:
    """Return the first best of every ``group`` cells, without such as score too low or were best before."""
    best: dict[tuple[int, ...], int] = {}
    for first in range(0, len(cells), group):
        i = max(range(first, first + group), key=lambda k: scores[k])
        if scores[i] >= least:
            best.setdefault(tuple(cells[i].tolist()), i)
    return list(best.values())


def suppress(cells: np.ndarray, scores: np.ndarray, least: int, reach: int = 1) -> np.ndarray:
    """Return the candidates that beat every neighbour; of equal neighbours the first wins."""
    number = {tuple(cell): i for i, cell in enumerate(cells.tolist())}
    peaks = []
    for (x, y, z), i in number.items():
        around = [(x + a, y + b, z + c) for a, b, c in product(range(-reach, reach + 1), repeat=3)]
        others = [number[cell] for cell in around if cell in number and cell != (x, y, z)]
        if scores[i] >= least and all((scores[i], -i) > (scores[j], -j) for j in others):
            peaks.append(i)
    return np.array(peaks, np.int64)


def suppress_overlaps(centres: np.ndarray, scores: np.ndarray, distance: float) -> np.ndarray:
    kept = []
    for i in sorted(range(len(scores)), key=lambda i: (-scores[i], i)):
        if all(sum((centres[i][k] - centres[j][k]) ** 2 for k in range(3)) >= distance**2 for j in kept):
            kept.append(i)
    return np.array(kept, np.int64)
