"""What the pictures of a cascade show: boxes with their colours, words and legends. No plotting here.

Green is what a head must have or what speaks for it; red is what it must not have.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from headvox.commands.table import file_name
from headvox.masks.cascade import Box, Cascade, Condition, Group, Tree
from headvox.masks.describe import statistic_in_words

GREEN, RED, BLUE, VIOLET = "#2a9d4a", "#d1383d", "#2f6fb5", "#8a4fb0"


@dataclass(frozen=True, slots=True)
class Painted:
    """A box and its colours; ``label`` is written on it where it is cut."""

    box: Box
    face: str
    edge: str
    label: str = ""


@dataclass(frozen=True, slots=True)
class Picture:
    """One thing to draw."""

    stem: str
    title: str
    words: str
    boxes: tuple[Painted, ...]
    legend: tuple[tuple[str, str], ...]
    """Colours and what they mean."""


@dataclass(frozen=True, slots=True)
class Influence:
    """How much the cuts of a feature, or of a group, move the score.

    A cut counts as the mean of the leaves above it minus that of those below, as if all were as likely.
    """

    cuts: int
    change: float
    """Added up with its sign: above 0, more in the boxes speaks for a head."""
    total: float
    """Added up without the sign."""


def pictures_of(cascade: Cascade) -> Iterator[Picture]:
    """Yield the pictures of ``cascade``: gate conditions, masks and mirrored pairs, the groups in use."""
    unit = "points a voxel" if cascade.counting else "full"
    for n, condition in enumerate(cascade.conditions, 1):
        yield _gate_picture(n, condition, unit)
    if cascade.votes is not None:
        for n, mask in enumerate(cascade.votes.masks, 1):
            yield _mask_picture(n, mask.name, mask.boxes, len(cascade.votes.yaws_deg))
        if cascade.votes.mirrored:
            yield _mirror_picture(cascade.votes.mirrored, cascade.votes.asymmetry_cost)
    influences = influence_of_groups(cascade)
    used = [group for group in cascade.groups if group.name in influences]
    for n, group in enumerate(sorted(used, key=lambda group: -influences[group.name].total), 1):
        yield _group_picture(n, group, influences[group.name])


def _gate_picture(n: int, condition: Condition, unit: str) -> Picture:
    low, high = math.isfinite(condition.minimum), math.isfinite(condition.maximum)
    limits = [f"at least {_share(condition.minimum, unit)}"] if low else []
    limits += [f"at most {_share(condition.maximum, unit)}"] if high else []
    wanted, unwanted = (GREEN, RED) if low else (RED, GREEN)
    painted = []
    for box in condition.group.boxes:
        face, other = (wanted, unwanted) if box.weight > 0 else (unwanted, wanted)
        painted.append(Painted(box, face, other if low and high else face, _times(box.weight)))
    filled, empty = (GREEN, "lower limit: must be filled"), (RED, "upper limit: must be empty")
    legend: tuple[tuple[str, str], ...]
    if low and high:
        legend = (filled, (RED, "upper limit, too: edges"))
    elif any(box.weight < 0 for box in condition.group.boxes):
        legend = ((GREEN, "counts for it: filled is good"), (RED, "counts against it: empty is good"))
    else:
        legend = (filled,) if low else (empty,)
    return Picture(
        f"gate-{n:02d}-{file_name(condition.group.name)}",
        f"gate: {condition.group.name}",
        f"{statistic_in_words(condition)}: {' and '.join(limits) or 'no limit'}",
        tuple(painted),
        legend,
    )


def _share(value: float, unit: str) -> str:
    return f"{100 * value:.3g} % full" if unit == "full" else f"{value:.3g} {unit}"


def _times(weight: int) -> str:
    return "" if abs(weight) == 1 else f"{'−' if weight < 0 else ''}{abs(weight)}×"


def _mask_picture(n: int, name: str, boxes: Sequence[Box], yaws: int) -> Picture:
    colours = [GREEN if box.weight > 0 else RED for box in boxes]
    turned = f", at {yaws} yaws" if yaws > 1 else ""
    return Picture(
        f"mask-{n:02d}-{file_name(name)}",
        f"mask: {name}",
        f"votes with the sign of green minus red{turned}",
        tuple(
            Painted(box, colour, colour, _times(box.weight))
            for box, colour in zip(boxes, colours, strict=True)
        ),
        ((GREEN, "positive: filled speaks for a head"), (RED, "negative: filled speaks against it")),
    )


def _mirror_picture(pairs: Sequence[tuple[Box, Box]], cost: float) -> Picture:
    painted = []
    for k, pair in enumerate(pairs):
        colour = (BLUE, VIOLET, GREEN, RED)[k % 4]
        painted += [
            Painted(box, colour, colour, f"{k + 1}{side}") for box, side in zip(pair, "ab", strict=True)
        ]
    return Picture(
        "mirrored",
        "mirrored pairs",
        f"how much a and b differ, relative to a + b, costs up to {cost:g}",
        tuple(painted),
        tuple(((BLUE, VIOLET, GREEN, RED)[k % 4], f"pair {k + 1}") for k in range(min(len(pairs), 4))),
    )


def _group_picture(n: int, group: Group, influence: Influence) -> Picture:
    colour = GREEN if influence.change >= 0 else RED
    what = {"occupied": "surface", "empty": "seen-empty space", "hidden": "hidden space"}[group.channel]
    effect = "for a head" if influence.change >= 0 else "against a head"
    cuts = f"{influence.cuts} cut{'s' * (influence.cuts != 1)}"
    return Picture(
        f"group-{n:02d}-{file_name(group.name)}",
        f"group: {group.name}" + ("" if group.channel == "occupied" else f" ({group.channel})"),
        f"more {what} here speaks {effect}; {cuts} move the score by {influence.total:.3g} in all",
        tuple(Painted(box, colour, colour, _times(box.weight)) for box in group.boxes),
        ((colour, f"speaks {effect} ({influence.change:+.3g})"),),
    )


def influence_of_features(cascade: Cascade) -> dict[str, Influence]:
    """Return the influence of each feature that some tree asks for."""
    found: dict[str, Influence] = {}
    for stage in cascade.every_stage:
        for tree in stage.trees:
            for feature, change in _changes(tree):
                old = found.get(feature, Influence(0, 0.0, 0.0))
                found[feature] = Influence(old.cuts + 1, old.change + change, old.total + abs(change))
    return found


def influence_of_groups(cascade: Cascade) -> dict[str, Influence]:
    """Return the influence of each group that some tree asks for."""
    found: dict[str, Influence] = {}
    for feature, new in influence_of_features(cascade).items():
        name = feature.rpartition(".")[0]
        old = found.get(name, Influence(0, 0.0, 0.0))
        found[name] = Influence(old.cuts + new.cuts, old.change + new.change, old.total + new.total)
    return found


def _changes(tree: Tree) -> Iterator[tuple[str, float]]:
    if isinstance(tree, tuple):
        feature, _, below, above = tree
        yield feature, float(np.mean(list(_leaves(above))) - np.mean(list(_leaves(below))))
        yield from _changes(below)
        yield from _changes(above)


def _leaves(tree: Tree) -> Iterator[float]:
    if isinstance(tree, tuple):
        yield from _leaves(tree[2])
        yield from _leaves(tree[3])
    else:
        yield tree
