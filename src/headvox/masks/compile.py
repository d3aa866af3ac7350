"""Compiles a cascade to voxel offsets for any voxel size.

Compiled, everything is integer: boxes are offsets, cuts are sums, leaf weights are multiples of 1/1024.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from headvox.data import I32, I64
from headvox.errors import HeadvoxError
from headvox.masks.cascade import (
    CHANNELS,
    MEASURES,
    SIDES,
    STATISTICS,
    Box,
    Cascade,
    Group,
    Relief,
    Stage,
    Tree,
    Votes,
    cuts,
    statistics,
    turned,
)
from headvox.masks.forest import Forest, plant

SCORE_UNIT = 1024
FARTHEST_M = 1000.0  # cuts of the last look: nothing that it asks reaches as far, and millimetres fit 32 bits
MAX_SEEN_CELLS = 1 << 20


def voxel_range(centre: float, size: float, voxel_m: float) -> tuple[int, int]:
    """Return the half-open range of voxels, from the candidate's, that a box covers along one axis.

    It is as many voxels as the size is near to, at least one; ties move away from the candidate, so that mirrored
    boxes stay mirrored.
    """
    count = max(1, round(size / voxel_m))
    steps = round(centre / voxel_m, 6)  # 0.075 / 0.025 is not 3 in binary
    first = steps - (count - 1) / 2
    start = math.floor(first + 0.5) if steps >= 0 else math.ceil(first - 0.5)
    return start, start + count


def voxel_box(box: Box, voxel_m: float) -> list[int]:
    """Return x0 x1 y0 y1 z0 z1, half-open, in voxels from the candidate's."""
    return [edge for c, s in zip(box.centre, box.size, strict=True) for edge in voxel_range(c, s, voxel_m)]


def volume(boxes: I32) -> int:
    """Return the number of voxels in ``boxes`` (B, 6), overlaps counted as often as they occur."""
    return int(np.prod(boxes[:, 1::2] - boxes[:, 0::2], axis=1).sum())


@dataclass(frozen=True, slots=True)
class CompiledGate:
    """Stage 1 in voxels: condition i asks boxes ``start[i]`` to ``start[i + 1]`` for ``low[i] <= . <= high[i]``."""

    boxes: I32
    weights: I32
    start: I32
    rank: I32
    low: I64
    high: I64
    spacing: int


@dataclass(frozen=True, slots=True)
class CompiledVotes:
    """The paper's stage 2 in voxels; boxes and weights of yaw y, mask m are ``start[y * masks + m]`` onwards."""

    boxes: I32
    weights: I32
    start: I32
    masks: int
    pairs: I32
    """(yaws, pairs, 2, 6)"""
    yaws_rad: npt.NDArray[np.float64]
    asymmetry_cost: float
    min_votes: int


@dataclass(frozen=True, slots=True)
class CompiledStages:
    """The boosted stage 2 in voxels.

    Group g has boxes ``group_start[g]`` to ``group_start[g + 1]``; its statistics are features 5 g to 5 g + 4. A node
    is four numbers: feature, cut, and where the nodes for at most the cut and for above it begin. A leaf is a node
    whose cut is its weight and which leads to itself, so that every path of a tree is ``depth`` steps long. Stage s
    needs the groups before ``stage_groups[s + 1]`` and adds the trees ``stage_trees[s]`` to ``stage_trees[s + 1]``.
    """

    boxes: I32
    group_start: I32
    group_channel: I32
    nodes: I64
    root: I64
    depth: I32
    stage_groups: I32
    stage_trees: I32
    stage_keep: I64
    occupied_stages: int
    """How many stages, from the first, do without the channels "empty" and "hidden"."""


UNREACHED = 1e9  # a score that nothing lacks


@dataclass(frozen=True, slots=True)
class CompiledRelief:
    """The last look in millimetres. It asks 2 k for the near, 2 k + 1 for the far side of spot k; then the measures."""

    spots: npt.NDArray[np.float64]
    """(K, 2) metres to the side and up"""
    forest: Forest
    first: int
    reach: int
    """A candidate that lacks more than ``reach``, in steps, after the ``first`` trees is given up."""
    most: int
    """The score changes by no more than that, in steps."""


@dataclass(frozen=True, slots=True)
class CompiledCascade:
    """A cascade for one voxel size, all integer."""

    source: Cascade
    voxel_m: float
    gate: CompiledGate
    votes: CompiledVotes | None
    stages: CompiledStages | None
    judge: CompiledStages | None
    largest_sum: int
    """Volume in voxel parts of the largest thing that is summed: tells which integer type an integral volume needs."""
    relief: CompiledRelief | None = None


def compile_cascade(cascade: Cascade, voxel_m: float | None = None) -> CompiledCascade:
    """Return ``cascade`` in voxels of ``voxel_m`` (its own by default)."""
    voxel = cascade.voxel_m if voxel_m is None else voxel_m
    unit = 1 if cascade.counting else cascade.subdivision**3
    gate = _compile_gate(cascade, voxel, unit)
    votes = _compile_votes(cascade.votes, voxel) if cascade.votes else None
    stages = _compile_stages(cascade, cascade.stages, voxel, unit) if cascade.stages else None
    judge = _compile_stages(cascade, cascade.judge, voxel, unit) if cascade.judge else None
    # The gate adds up the boxes of a condition in the type of the volume, signed; stage 2 adds up in 64 bits.
    sums = [
        2
        * sum(
            abs(int(w)) * volume(box[None]) for w, box in zip(gate.weights[a:b], gate.boxes[a:b], strict=True)
        )
        for a, b in zip(gate.start[:-1], gate.start[1:], strict=True)
    ]
    tables = [gate.boxes]
    if votes:
        tables += [votes.boxes, votes.pairs.reshape(-1, 6)]
    tables += [part.boxes for part in (stages, judge) if part]
    sums += [volume(box[None]) for table in tables for box in table]
    largest = max(sums, default=1) * unit
    if largest > 0xFFFFFFFF:
        raise HeadvoxError(
            f"Cascade {cascade.name}: in voxels of {voxel:g} m a condition of its gate outgrows 32 bits.",
            "Make its boxes smaller or fewer, or their weights less.",
        )
    relief = _compile_relief(cascade.relief) if cascade.relief else None
    return CompiledCascade(cascade, voxel, gate, votes, stages, judge, largest, relief)


def _box_table(boxes: list[list[int]]) -> I32:
    return np.array(boxes, dtype=np.int32).reshape(-1, 6)


def _rounded(value: float) -> float:
    """Take away what binary fractions add: 0.1 * 30 is not 3."""
    return round(value, 6) if math.isfinite(value) else value


def _floor(value: float) -> int:
    return math.floor(min(max(value, -(2.0**40)), 2.0**40))


def _compile_gate(cascade: Cascade, voxel: float, unit: int) -> CompiledGate:
    boxes: list[list[int]] = []
    weights: list[int] = []
    start, ranks, lows, highs = [0], [], [], []
    for condition in cascade.conditions:
        mine = [voxel_box(box, voxel) for box in condition.group.boxes]
        mine_weights = [box.weight for box in condition.group.boxes]
        pairs = zip(mine, mine_weights, strict=True)
        size: float = sum(w * volume(_box_table([box])) for box, w in pairs if w > 0) * unit
        if condition.rank:
            size /= len(mine)
        boxes += mine
        weights += mine_weights
        start.append(len(boxes))
        ranks.append(condition.rank)
        lows.append(-_floor(-_rounded(condition.minimum * size)))
        highs.append(_floor(_rounded(condition.maximum * size)))
    return CompiledGate(
        _box_table(boxes),
        np.array(weights, dtype=np.int32),
        np.array(start, dtype=np.int32),
        np.array(ranks, dtype=np.int32),
        np.array(lows, dtype=np.int64),
        np.array(highs, dtype=np.int64),
        cascade.spacing,
    )


def _compile_votes(votes: Votes, voxel: float) -> CompiledVotes:
    boxes: list[list[int]] = []
    weights: list[int] = []
    start = [0]
    yaws = np.radians(np.array(votes.yaws_deg))
    pairs = []
    for yaw in yaws:
        for mask in votes.masks:
            boxes += [voxel_box(turned(box, yaw), voxel) for box in mask.boxes]
            weights += [box.weight for box in mask.boxes]
            start.append(len(boxes))
        pairs.append([[voxel_box(turned(box, yaw), voxel) for box in pair] for pair in votes.mirrored])
    return CompiledVotes(
        _box_table(boxes),
        np.array(weights, dtype=np.int32),
        np.array(start, dtype=np.int32),
        len(votes.masks),
        np.array(pairs, dtype=np.int32).reshape(len(yaws), -1, 2, 6),
        yaws,
        votes.asymmetry_cost,
        votes.min_votes,
    )


def _compile_stages(cascade: Cascade, stages: tuple[Stage, ...], voxel: float, unit: int) -> CompiledStages:
    groups = _groups_by_first_use(cascade.groups, stages)
    index = {group.name: g for g, (group, _) in enumerate(groups)}
    sizes: dict[str, float] = {}
    boxes: list[list[int]] = []
    group_start = [0]
    for group, _ in groups:
        mine = [voxel_box(box, voxel) for box in group.boxes]
        boxes += mine
        group_start.append(len(boxes))
        cells = volume(_box_table(mine)) * (unit if group.channel == "occupied" else 1)
        for statistic in statistics(group):
            sizes[f"{group.name}.{statistic}"] = cells if statistic == "sum" else cells / len(mine)

    seen = [
        voxel_box(box, voxel) for group, _ in groups if group.channel != "occupied" for box in group.boxes
    ]
    if volume(_box_table(seen)) > MAX_SEEN_CELLS:
        raise HeadvoxError(
            f'Cascade {cascade.name}: its "empty" and "hidden" boxes have {volume(_box_table(seen))} cells of '
            f"{voxel:g} m, more than {MAX_SEEN_CELLS}.",
            "Make them smaller or fewer, or the voxels larger.",
        )

    def asked(name: str, share: float) -> tuple[int, int]:
        group, _, statistic = name.rpartition(".")
        feature = len(STATISTICS) * index[group] + STATISTICS.index(statistic)
        return feature, _floor(round(share * sizes[name], 6))

    nodes: list[int] = []
    roots: list[tuple[int, int]] = []
    stage_trees = [0]
    for stage in stages:
        roots += [_add_tree(tree, asked, nodes) for tree in stage.trees]
        stage_trees.append(len(roots))
    channel = [CHANNELS.index(group.channel) for group, _ in groups]
    first = [stage for _, stage in groups]
    count = len(stages)
    seeing = [stage for (group, stage) in groups if group.channel != "occupied"]
    return CompiledStages(
        _box_table(boxes),
        np.array(group_start, dtype=np.int32),
        np.array(channel, dtype=np.int32),
        np.array(nodes, dtype=np.int64),
        np.array([root for root, _ in roots], dtype=np.int64),
        np.array([depth for _, depth in roots], dtype=np.int32),
        np.array([0, *(sum(f <= s for f in first) for s in range(count))], dtype=np.int32),
        np.array(stage_trees, dtype=np.int32),
        np.array([-_floor(-stage.keep * SCORE_UNIT) for stage in stages], dtype=np.int64),
        min(seeing, default=count),
    )


def _add_tree(
    tree: Tree, asked: Callable[[str, float], tuple[int, int]], nodes: list[int]
) -> tuple[int, int]:
    """Add a tree to ``nodes``; return where its first node begins, and how deep it is.

    ``asked`` turns the name and the cut of a node into a feature and a whole number.
    """
    at = len(nodes)
    if not isinstance(tree, tuple):
        nodes.extend([0, round(tree * SCORE_UNIT), at, at])
        return at, 0
    name, cut, below, above = tree
    nodes.extend([*asked(name, cut), 0, 0])
    (nodes[at + 2], left), (nodes[at + 3], right) = (
        _add_tree(below, asked, nodes),
        _add_tree(above, asked, nodes),
    )
    return at, 1 + max(left, right)


def _compile_relief(relief: Relief) -> CompiledRelief:
    sides = [f"{spot.name}.{side}" for spot in relief.spots for side in SIDES]
    numbers = {name: k for k, name in enumerate((*sides, *MEASURES))}

    def asked(name: str, metres: float) -> tuple[int, int]:
        return numbers[name], _floor(round(1000.0 * min(max(metres, -FARTHEST_M), FARTHEST_M), 6))

    return CompiledRelief(
        np.array([(spot.side, spot.up) for spot in relief.spots]),
        plant(relief.trees, asked, lambda leaf: round(leaf * SCORE_UNIT)),
        relief.first,
        math.floor(min(relief.reach, UNREACHED) * SCORE_UNIT),
        math.floor(relief.most * SCORE_UNIT),
    )


def _groups_by_first_use(groups: tuple[Group, ...], stages: tuple[Stage, ...]) -> list[tuple[Group, int]]:
    """Return the groups that some tree asks for, in the order of the first stage that does, with that stage."""
    first: dict[str, int] = {}
    for s, stage in enumerate(stages):
        for tree in stage.trees:
            for name, _ in cuts(tree):
                first.setdefault(name.rpartition(".")[0], s)
    used = [(group, first[group.name]) for group in groups if group.name in first]
    return sorted(used, key=lambda pair: pair[1])
