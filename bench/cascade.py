"""What does a cascade find with larger or smaller voxels, with fewer stages, and without some of its boxes?

    python bench/cascade.py FOLDER [--cascade default] [--seed 0] [--views 6456]

Looks at the views that a search of this seed keeps aside, and prints markdown tables: which share of the heads is found
at so many false heads a frame. FOLDER keeps the views; those of a search are in the folder ``views`` of its ``--work``.

"Without" some boxes: every question about them gets one answer, the same for all voxels: that which finds more heads.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from headvox.evolve.check import Outcome, detector_for, look_at
from headvox.evolve.samples import is_aside
from headvox.evolve.views import View, keep_view
from headvox.masks.cascade import Cascade, Group, Stage, Tree, cuts
from headvox.masks.compile import compile_cascade
from headvox.masks.describe import LOOK_UPS_A_BOX
from headvox.masks.read import load_cascade

RATES = (0.05, 0.1, 0.5)  # false heads a frame
VOXELS_M = (0.04, 0.045, 0.05, 0.06, 0.075)
AT_LEAST_M, AT_MOST_M = 0.1, -0.1  # what is above the head, or below it
PLACES: dict[str, Callable[[Group], bool]] = {
    "above it": lambda group: group.channel == "occupied" and _height(group) >= AT_LEAST_M,
    "at its height": lambda group: group.channel == "occupied" and AT_MOST_M < _height(group) < AT_LEAST_M,
    "below it": lambda group: group.channel == "occupied" and _height(group) <= AT_MOST_M,
    "seen to be empty": lambda group: group.channel == "empty",
    "hidden": lambda group: group.channel == "hidden",
}


def _height(group: Group) -> float:
    return float(np.mean([box.centre[2] for box in group.boxes]))


def of_first_stages(cascade: Cascade, count: int) -> Cascade:
    """Return a cascade with the first ``count`` stages only, and without the look at full resolution."""
    kept = cascade.every_stage[:count]
    stages, judge = (tuple(stage for stage in of if stage in kept) for of in (cascade.stages, cascade.judge))
    return replace(cascade, stages=stages, judge=judge, relief=None)


def without(cascade: Cascade, names: frozenset[str], more: bool) -> Cascade:
    """Return a cascade with one answer to all about the groups ``names``: ``more`` than the cut, or not."""

    def tree(node: Tree) -> Tree:
        if not isinstance(node, tuple):
            return node
        feature, cut, low, high = node
        if feature.rpartition(".")[0] in names:
            return tree(high if more else low)
        return feature, cut, tree(low), tree(high)

    def stages(of: tuple[Stage, ...]) -> tuple[Stage, ...]:
        return tuple(replace(stage, trees=tuple(map(tree, stage.trees))) for stage in of)

    return replace(cascade, stages=stages(cascade.stages), judge=stages(cascade.judge))


def look_ups(cascade: Cascade) -> int:
    """Return how many entries of the integral volume a candidate costs that gets through all stages."""
    used = {
        feature.rpartition(".")[0]
        for stage in cascade.every_stage
        for tree in stage.trees
        for feature, _ in cuts(tree)
    }
    return sum(
        LOOK_UPS_A_BOX * len(group.boxes)
        for group in cascade.groups
        if group.channel == "occupied" and group.name in used
    )


def found(views: Iterable[View], cascade: Cascade) -> Outcome:
    """Return what a cascade finds in ``views``."""
    detector = detector_for("default")
    detector.cascade = compile_cascade(cascade)
    return look_at(views, detector)


def row(name: str, outcome: Outcome, *more: object) -> str:
    """Return a line of a table."""
    shares = (f"{100 * outcome.recall(outcome.threshold(rate)):.1f} %" for rate in RATES)
    return f"| {' | '.join([name, *map(str, more), *shares])} |"


def table(*columns: str) -> Iterator[str]:
    """Yield the head of a table."""
    every = [*columns, *(f"{rate:g} false" for rate in RATES)]
    yield f"| {' | '.join(every)} |"
    yield f"| {' | '.join(['---'] * len(every))} |"


def tables(views: list[View], name: str) -> Iterator[str]:
    """Yield all that is printed, line by line."""
    cascade = load_cascade(name)
    heads = len(found(views, cascade).heads)
    yield f"{len(views)} views, {heads} heads"
    yield ""
    yield from table("stages", "trees", "look-ups")
    for count in range(1, len(cascade.every_stage) + 1):
        part = of_first_stages(cascade, count)
        trees = sum(len(stage.trees) for stage in part.every_stage)
        label = f"{'+ ' if count > 1 else ''}{part.every_stage[-1].name}"
        yield row(label, found(views, part), trees, look_ups(part))
    if cascade.relief is not None:
        yield row("+ relief", found(views, cascade), trees + len(cascade.relief.trees), look_ups(cascade))
    yield ""
    yield from table("voxel")
    for voxel_m in VOXELS_M:
        yield row(f"{1e3 * voxel_m:g} mm", look_at(views, detector_for(name, voxel_m)))
    yield ""
    yield from table("without boxes")
    yield row("none", found(views, cascade))
    for place, lies in PLACES.items():
        names = frozenset(group.name for group in cascade.groups if lies(group))
        yield row(
            place,
            max((found(views, without(cascade, names, more)) for more in (False, True)), key=at_most_false),
        )
    yield row("points instead of images", look_at(views, detector_for(name), as_clouds=True))


def at_most_false(outcome: Outcome) -> float:
    """Return what is found at the middle one of the rates."""
    return outcome.recall(outcome.threshold(RATES[1]))


def main() -> None:
    """Look, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cascade", default="default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--views", type=int, default=6456)
    args = parser.parse_args()
    numbers = np.arange(args.views)
    aside = [keep_view(args.folder, args.seed, int(number)) for number in numbers[is_aside(numbers)]]
    views = [view for view in aside if view.frame.depths and not view.frame.clouds]
    for line in tables(views, args.cascade):
        print(line, flush=True)


if __name__ == "__main__":
    main()
