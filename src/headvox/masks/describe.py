"""A cascade in words and tables."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from headvox.commands.table import printable, table
from headvox.masks.cascade import (
    MEASURES,
    Cascade,
    Condition,
    Group,
    Relief,
    Stage,
    Verification,
    Votes,
    cuts,
)
from headvox.masks.compile import volume, voxel_box

LOOK_UPS_A_BOX = 8


def describe_cascade(cascade: Cascade) -> str:
    """Return what ``cascade`` asks, in the order in which it asks it, and what that costs a candidate."""
    parts = [_heading(cascade), _gate(cascade.conditions)]
    if cascade.votes is not None:
        parts.append(_votes(cascade.votes))
    else:
        parts += [_groups(cascade), _stages(cascade)]
    if cascade.relief is not None:
        parts.append(_relief(cascade.relief))
    if cascade.verification is not None:
        parts.append(_verification(cascade.verification))
    return "\n\n".join(parts)


def statistic_in_words(condition: Condition) -> str:
    """Return what a gate condition looks at: the sum of its boxes, or the box at a rank of fullness."""
    count, rank = len(condition.group.boxes), condition.rank
    if rank == 0:
        weighted = any(box.weight != 1 for box in condition.group.boxes)
        together = f"the weighted sum of {count} boxes" if weighted else f"all {count} boxes together"
        return "the box" if count == 1 else together
    if rank == 1:
        return f"the emptiest of {count} boxes"
    if rank == count:
        return f"the fullest of {count} boxes"
    return f"the {_ordinal(rank)} emptiest of {count} boxes"


def _ordinal(number: int) -> str:
    return {1: "1st", 2: "2nd", 3: "3rd"}.get(number, f"{number}th")


def first_use(cascade: Cascade) -> dict[str, int]:
    """Return for each group that some tree asks for the index of the first stage that does."""
    first: dict[str, int] = {}
    for s, stage in enumerate(cascade.every_stage):
        for tree in stage.trees:
            for name, _ in cuts(tree):
                first.setdefault(name.rpartition(".")[0], s)
    return first


def _heading(cascade: Cascade) -> str:
    occupancy = "points a voxel" if cascade.counting else f"{cascade.subdivision}x{cascade.subdivision}x"
    occupancy += "" if cascade.counting else f"{cascade.subdivision} parts of a voxel, each empty or not"
    rows = [
        ["voxel", f"{1e3 * cascade.voxel_m:g} mm"],
        ["counts", occupancy],
        ["least score", f"{cascade.min_score:g}"],
    ]
    if cascade.sees:
        rows.append(["least score without depth images", f"{cascade.min_score_occupied:g}"])
    rows.append(["tuned on", ", ".join(cascade.tuned_on) or "not told"])
    return f"{printable(cascade.name)}: {printable(cascade.summary)}\n\n{table([], rows)}"


def _limit(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else ""


def _gate(conditions: tuple[Condition, ...]) -> str:
    rows = [
        [
            condition.group.name,
            statistic_in_words(condition),
            _limit(condition.minimum),
            _limit(condition.maximum),
            str(LOOK_UPS_A_BOX * len(condition.group.boxes)),
        ]
        for condition in conditions
    ]
    total = sum(LOOK_UPS_A_BOX * len(condition.group.boxes) for condition in conditions)
    heading = f"Stage 1, the gate: {len(conditions)} conditions, at most {total} look-ups a voxel"
    return f"{heading}\n{table(['condition', 'looks at', 'least share', 'most share', 'look-ups'], rows)}"


def _votes(votes: Votes) -> str:
    yaws = len(votes.yaws_deg)
    rows = []
    for mask in votes.masks:
        up = sum(box.weight > 0 for box in mask.boxes)
        rows.append(
            [mask.name, str(up), str(len(mask.boxes) - up), str(LOOK_UPS_A_BOX * len(mask.boxes) * yaws)]
        )
    boxes = sum(len(mask.boxes) for mask in votes.masks) + 2 * len(votes.mirrored)
    heading = (
        f"Stage 2, votes: {len(votes.masks)} masks and {len(votes.mirrored)} mirrored pairs at {yaws} "
        f"yaw{'s' * (yaws > 1)}, {LOOK_UPS_A_BOX * boxes * yaws} look-ups a candidate"
    )
    rule = f"kept with {votes.min_votes} votes or more; asymmetry costs {votes.asymmetry_cost:g}"
    return f"{heading}\n{rule}\n{table(['mask', 'positive boxes', 'negative boxes', 'look-ups'], rows)}"


def _groups(cascade: Cascade) -> str:
    first = first_use(cascade)
    counts: dict[str, int] = {}
    for stage in cascade.every_stage:
        for tree in stage.trees:
            for feature, _ in cuts(tree):
                name = feature.rpartition(".")[0]
                counts[name] = counts.get(name, 0) + 1
    rows = []
    for group in sorted(cascade.groups, key=lambda group: first.get(group.name, len(first))):
        used = group.name in first
        rows.append(
            [
                group.name,
                group.channel,
                _placed(group),
                str(len(group.boxes)),
                str(counts.get(group.name, 0)),
                cascade.every_stage[first[group.name]].name if used else "never",
            ]
        )
    heading = f"Groups: {len(cascade.groups)}, of which {len(first)} are asked for"
    return (
        f"{heading}\n{table(['group', 'channel', 'boxes at (m)', 'boxes', 'cuts', 'first in stage'], rows)}"
    )


def _placed(group: Group) -> str:
    centres = np.array([box.centre for box in group.boxes])
    size = "x".join(f"{v:g}" for v in group.boxes[0].size)
    if len(centres) == 1:
        return f"({', '.join(f'{v:g}' for v in centres[0])}), {size}"
    radius, height = np.hypot(centres[:, 0], centres[:, 1]).mean(), centres[:, 2].mean()
    return f"radius {radius:.3g}, height {height:+.3g}, {size}"


def _stages(cascade: Cascade) -> str:
    first = first_use(cascade)
    rows = []
    for s, stage in enumerate(cascade.every_stage):
        new = [group for group in cascade.groups if first.get(group.name) == s]
        look_ups = sum(LOOK_UPS_A_BOX * len(group.boxes) for group in new if group.channel == "occupied")
        cells = sum(_cells(group, cascade.voxel_m) for group in new if group.channel != "occupied")
        keep = f"{stage.keep:g}" if math.isfinite(stage.keep) else ""
        rows.append(
            [
                stage.name,
                _at(cascade, stage),
                str(len(new)),
                str(look_ups),
                str(cells),
                str(len(stage.trees)),
                _depth(stage),
                keep,
            ]
        )
    columns = ["stage", "at", "new groups", "look-ups", "voxels looked at", "trees", "deepest", "keeps from"]
    trees = sum(len(stage.trees) for stage in cascade.every_stage)
    heading = f"Stage 2, boosted: {trees} trees in {len(rows)} stages"
    return f"{heading}\n{table(columns, rows)}"


def _relief(relief: Relief) -> str:
    asked = Counter(
        name if name in MEASURES else name.rpartition(".")[0]
        for tree in relief.trees
        for name, _ in cuts(tree)
    )
    rows = [[spot.name, f"{spot.side:g}", f"{spot.up:+g}", str(asked[spot.name])] for spot in relief.spots]
    measures = [[name, "", "", str(asked[name])] for name in MEASURES if asked[name]]
    heading = (
        f"The last look, in depth images: {len(relief.trees)} trees over {len(rows)} pairs of spots, which change the "
        f"score by {relief.most:g} at most"
    )
    if math.isfinite(relief.reach):
        heading += f";\nwhat lacks more than {relief.reach:g} after the first {relief.first} is given up"
    return f"{heading}\n{table(['spot', 'to either side (m)', 'up (m)', 'cuts'], rows + measures)}"


def _verification(rule: Verification) -> str:
    return (
        f"Verification, by the pose fit: lowers the score by {rule.misfit:g} x misfit + {rule.radius:g} x (metres that "
        f"the radius is off {rule.radius_m:g}) - {rule.free:g},\nby {rule.most:g} at most, where the centre is stated "
        f"to {rule.sure_m:g} m"
    )


def _at(cascade: Cascade, stage: Stage) -> str:
    if stage not in cascade.judge:
        return "candidates"
    return "both" if stage in cascade.stages else "peaks"


def _cells(group: Group, voxel_m: float) -> int:
    return volume(np.array([voxel_box(box, voxel_m) for box in group.boxes], dtype=np.int32))


def _depth(stage: Stage) -> str:
    def depth(tree: object) -> int:
        return 1 + max(depth(tree[2]), depth(tree[3])) if isinstance(tree, tuple) else 0

    return str(max(map(depth, stage.trees), default=0))
