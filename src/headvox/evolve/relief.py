"""The trees of the last look: fitted to the peaks that the detector leaves in spoilt views, as the judge's last stage.

What is asked is new to the cascade, at the full resolution of the images, so many leaves a tree are no luxury here;
how far all of them together may change a score is limited instead.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.data import F64
from headvox.evolve import samples
from headvox.evolve.again import label_places
from headvox.evolve.boost import train
from headvox.evolve.check import heads_in
from headvox.evolve.spoil import cut_off, spoil
from headvox.evolve.views import View
from headvox.masks.cascade import MEASURES, SIDES, Relief, Spot, Tree, cuts
from headvox.relief import relief_about

LEAST_SCORE = -6.0  # of the peaks that are looked at
MOST_SPOTS = 110  # chosen by what a short boosting over all gains from them
CHOOSING_TREES, CHOOSING_RATE, CHOOSING_SHARE = 100, 0.15, 0.2
TREES, RATE, SHARE_OF_FEATURES = 800, 0.12, 0.15
LEAVES, DEEPEST, LEAST_ROWS = 96, 10, 60
TURNS = 3  # how often each view is taken, besides once with a head that the border of the image cuts
MOST = 5.0  # how far the score may change
FIRST = 64  # trees, after which a candidate is given up that lacks more than nearly any head does
GIVEN_UP = 0.001  # of the heads that score 0 or more in the end

FINE_CM = [(side, up) for side in range(0, 16, 3) for up in range(-15, 16, 3)]
COARSE_CM = [(side, up) for side in range(0, 37, 6) for up in range(-60, 31, 6)]
WIDE_CM = [
    (side, up) for side in range(0, 61, 15) for up in range(-105, 61, 15) if side > 36 or not -60 <= up <= 30
]
SPOTS = tuple(
    Spot(f"s{side:02d}{'u' if up >= 0 else 'd'}{abs(up):02d}", side / 100, up / 100)
    for side, up in dict.fromkeys(FINE_CM + COARSE_CM + WIDE_CM)
)
PLACES: F64 = np.array([(spot.side, spot.up) for spot in SPOTS])


@dataclass(frozen=True)
class Looks:
    """What was seen about some peaks: ``relief`` (N, 2 SPOTS + 4) mm, whether it is a head, and the score before.

    Those that are ``aside`` are of views that no tree is fitted to.
    """

    relief: npt.NDArray[np.int16]
    label: npt.NDArray[np.int8]
    score: F64
    aside: npt.NDArray[np.bool_]

    @classmethod
    def join(cls, parts: Sequence[Looks]) -> Looks:
        """Put those of several views one after the other."""
        columns = zip(*((part.relief, part.label, part.score, part.aside) for part in parts), strict=True)
        return cls(*map(np.concatenate, columns))

    def of(self, which: npt.NDArray[np.bool_]) -> Looks:
        """Return those of some peaks, (N,) bool."""
        return Looks(self.relief[which], self.label[which], self.score[which], self.aside[which])


def spoilt_looks(view: View, cascade: Path) -> Looks | None:
    """Return what is seen about the peaks of ``view``, spoilt several times; None: of none, or for others."""
    number = np.array([view.number])
    if samples.is_for_verification(number)[0]:
        return None
    if not view.frame.depths or view.frame.clouds:
        return None
    turned = [spoil(view, np.random.default_rng([view.number, 7, k])) for k in range(TURNS + 1)]
    turned[-1] = cut_off(turned[-1], np.random.default_rng([view.number, 8]))
    some = [looks for looks in (looks_at(one, cascade) for one in turned) if looks is not None]
    return Looks.join(some) if some else None


def looks_at(view: View, cascade: Path) -> Looks | None:
    """Return what is seen about the peaks that are certainly a head or none."""
    heads = heads_in(view, cascade, LEAST_SCORE)
    if heads is None:
        return None
    label, _ = label_places(view, heads.centres)
    known = np.flatnonzero(label >= 0)
    if not len(known):
        return None
    relief, _ = relief_about(view.frame.depths, heads.centres[known], heads.radii[known], PLACES)
    aside = np.repeat(samples.is_aside(np.array([view.number])), len(known))
    return Looks(relief, label[known], heads.scores[known], aside)


def fit_relief(looks: Looks, seed: int) -> Relief | None:
    """Return the trees that were fitted to ``looks``, or None: there is nothing to tell apart."""
    aside, looks = looks.of(looks.aside), looks.of(~looks.aside)
    if len(np.unique(looks.label)) < 2:
        return None

    def fit(columns: npt.NDArray[np.int64], trees: int, rate: float, share: float) -> Any:
        settings = {"num_leaves": LEAVES, "max_depth": DEEPEST, "min_data_in_leaf": LEAST_ROWS}
        features = looks.relief[:, columns].astype(np.float32)
        return train(features, looks.label, looks.score, None, trees, rate, share, seed, settings)

    sides = len(SIDES) * len(SPOTS)
    every = np.arange(sides + len(MEASURES))
    gain = fit(every, CHOOSING_TREES, CHOOSING_RATE, CHOOSING_SHARE).feature_importance("gain")
    of_spot = gain[:sides].reshape(-1, len(SIDES)).sum(axis=1)
    chosen = np.sort(np.argsort(-of_spot, kind="stable")[:MOST_SPOTS])
    columns = every[np.isin(every // len(SIDES), chosen) | (every >= sides)]
    model = fit(columns, TREES, RATE, SHARE_OF_FEATURES)
    trees = tuple(_tree(info["tree_structure"], columns) for info in model.dump_model()["tree_info"])
    used = {name.rpartition(".")[0] for tree in trees for name, _ in cuts(tree)} - {""}
    spots = tuple(spot for spot in SPOTS if spot.name in used)
    if not used:
        return None
    reach = _reach(model, columns, aside.of(aside.label == 1))
    return Relief(MOST, spots, trees, min(FIRST, len(trees)), reach)


def _reach(model: Any, columns: npt.NDArray[np.int64], heads: Looks) -> float:
    """Return how much too little heads may score after the first trees, rounded up.

    They are of views that no tree was fitted to: in others the later trees raise what the first ones left far behind.
    """
    if not len(heads.score):
        return math.inf

    def scores(trees: int | None) -> F64:
        gains = model.predict(
            heads.relief[:, columns].astype(np.float32), num_iteration=trees, raw_score=True
        )
        return np.asarray(heads.score + np.clip(gains, -MOST, MOST))

    found = scores(FIRST)[scores(None) >= 0.0]
    if not len(found):
        return math.inf
    return max(0.0, math.ceil(-100.0 * float(np.quantile(found, GIVEN_UP))) / 100.0)


def _tree(node: dict[str, Any], columns: npt.NDArray[np.int64]) -> Tree:
    if "leaf_value" in node:
        return round(float(node["leaf_value"]), 3) + 0.0
    metres = (math.floor(node["threshold"]) + 0.5) / 1000.0
    below, above = (_tree(node[child], columns) for child in ("left_child", "right_child"))
    return _name(int(columns[node["split_feature"]])), metres, below, above


def _name(column: int) -> str:
    spot, side = divmod(column, len(SIDES))
    if spot < len(SPOTS):
        return f"{SPOTS[spot].name}.{SIDES[side]}"
    return MEASURES[column - len(SIDES) * len(SPOTS)]
