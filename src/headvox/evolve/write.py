"""A cascade as a text file that a person can read, plot and edit."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from headvox.atomic import write_text
from headvox.evolve.bank import OCCUPIED, SEEN, SUBDIVISION, VOXEL_M
from headvox.evolve.boost import Fitted
from headvox.masks.cascade import Condition, Group, Relief, Tree, Verification

WHY = {
    "crown": "the upper half is there", "beside": "about the crown there is less than in it",
    "cap": "the crown narrows upwards", "top": "nothing close above", "above": "nothing above",
    "brow": "what is at the brow is in the middle", "middle": "something is in the middle",
    "shell": "a head holds surface", "below": "something is below",
}  # fmt: skip
VOLUMES = {**OCCUPIED.volumes, **SEEN.volumes}


@dataclass(frozen=True)
class Found:
    """What a search has found so far. Without a judge the search's peaks are the answer."""

    gate: tuple[Condition, ...]
    search: Sequence[Fitted]
    judge: Sequence[Fitted] = ()
    min_score: float = 0.0
    min_score_occupied: float = 0.0
    tuned_on: tuple[str, ...] = ()
    relief: Relief | None = None
    verification: Verification | None = None


def write_cascade(path: Path, name: str, found: Found) -> None:
    """Write the cascade, at once and whole."""
    write_text(path, cascade_text(name, found))


def cascade_text(name: str, found: Found) -> str:
    """Return the cascade as TOML."""
    stages = [*found.search, *found.judge]
    trees = [
        [_tree(info["tree_structure"], stage.names) for info in stage.model.dump_model()["tree_info"]]
        for stage in stages
    ]
    count = sum(map(len, trees))
    parts = f"{len(found.gate)} signed gate masks, {count} small trees in {len(stages)} stages"
    lines = [
        "# Found by `headvox masks evolve`: a gate of signed boxes, then boosted sums of look-ups over boxes and",
        "# rings. Shares are filled parts over all parts of a box (occupied), or cells over all cells (empty,",
        "# hidden). A tree is [feature, cut, at most the cut, above it]; the leaves that are reached are added up.",
        "# The stages at peaks score the peaks of the others, and the voxels about them, anew.",
        "",
        'format = "headvox-cascade"',
        "version = 1",
        f"name = {json.dumps(name)}",
        f"summary = {json.dumps('Boosted on synthetic depth: ' + parts)}",
        f"voxel_m = {VOXEL_M}",
        f"subdivision = {SUBDIVISION}",
        'occupancy = "parts"',
        'candidates = "every fourth"  # voxels; the stages at peaks look at all that are about a peak',
        f"min_score = {found.min_score:g}           # with depth images: what was seen empty and hidden counts",
        f"min_score_occupied = {found.min_score_occupied:g}  # with clouds: occupied voxels only",
        "tuned_on = [",
        *(f"  {json.dumps(entry)}," for entry in found.tuned_on),
        "]",
        "",
    ]
    for condition in found.gate:
        group = condition.group
        lines += [f"[[gate]]  # {WHY[group.name]}", f'name = "{group.name}"', _boxes(group)]
        lines += [f"min = {condition.minimum:g}"] if math.isfinite(condition.minimum) else []
        lines += [f"max = {condition.maximum:g}"] if math.isfinite(condition.maximum) else []
        lines.append("")
    text = "\n".join(tree for stage in trees for tree in stage)
    for group in OCCUPIED.groups + SEEN.groups:
        if f'"{group.name}.' in text:
            channel = [f'channel = "{group.channel}"'] if group.channel != "occupied" else []
            lines += ["[[group]]", f'name = "{group.name}"', *channel, _boxes(group), ""]
    for stage, its_trees in zip(stages, trees, strict=True):
        last = stage is stages[-1] or stage.plan.pool == "seen"
        keep = [] if last or stage.keep <= -1e3 else [f"keep = {math.floor(stage.keep * 100) / 100:g}"]
        at = ['at = "peaks"'] if stage in found.judge else []
        lines += ["[[stage]]", f'name = "{stage.plan.name}"', *at, *keep, "trees = ["]
        lines += [*(f"  {tree}," for tree in its_trees), "]", ""]
    return "\n".join(lines + relief_lines(found.relief) + verification_lines(found.verification))


def relief_lines(relief: Relief | None) -> list[str]:
    """Return the last look as lines of TOML."""
    if relief is None:
        return []
    spots = [f"{spot.name} = [{spot.side:g}, {spot.up:g}]" for spot in relief.spots]
    trees = [f"  '{' '.join(_words(tree))}'," for tree in relief.trees]
    limits = [f"{name} = {getattr(relief, name):g}" for name in ("most", "first", "reach")]
    return ["[relief]", *limits, "trees = [", *trees, "]", "", "[relief.spots]", *spots, ""]


def _words(tree: Tree) -> Iterator[str]:
    if not isinstance(tree, tuple):
        yield f"{tree:g}"
        return
    name, cut, below, above = tree
    yield from (name, f"{cut:.10g}", *_words(below), *_words(above))


def verification_lines(rule: Verification | None) -> list[str]:
    """Return the verification as lines of TOML."""
    if rule is None:
        return []
    return [
        "[verification]",
        *(f"{entry.name} = {getattr(rule, entry.name):g}" for entry in fields(rule)),
        "",
    ]


def _numbers(values: Sequence[float]) -> str:
    return f"[{', '.join(f'{value:.6g}' for value in values)}]"


def _boxes(group: Group) -> str:
    first = group.boxes[0]
    if group.name.startswith(("ring", "fine")) or (group.channel != "occupied" and len(group.boxes) > 1):
        radius, height = first.centre[0], first.centre[2]
        return f"ring = {{ radius = {radius:g}, height = {height:g}, size = {_numbers(first.size)} }}"
    weights = ["" if box.weight == 1 else f", weight = {box.weight}" for box in group.boxes]
    entries = [
        f"{{ centre = {_numbers(box.centre)}, size = {_numbers(box.size)}{weight} }}"
        for box, weight in zip(group.boxes, weights, strict=True)
    ]
    return f"boxes = [{', '.join(entries)}]"


def _tree(node: dict[str, Any], names: list[str]) -> str:
    if "leaf_value" in node:
        return f"{round(node['leaf_value'], 3) + 0.0:g}"
    name = names[node["split_feature"]]
    share = (math.floor(node["threshold"]) + 0.5) / VOLUMES[name]
    below, above = (_tree(node[side], names) for side in ("left_child", "right_child"))
    return f'["{name}", {share:.5g}, {below}, {above}]'
