"""Boosting: stages of small trees, one after the other, each fitted to what the ones before it let through.

LightGBM searches. A stage may use a few groups of boxes, chosen by gain per box. Afterwards each stage's threshold is
set to what the whole accepts in the end: multiple-instance pruning (Zhang and Viola, 2007).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.data import F64
from headvox.errors import HeadvoxError
from headvox.evolve.bank import OCCUPIED, SEEN
from headvox.evolve.samples import Samples, of_bags

Mask = npt.NDArray[np.bool_]

NAMES = OCCUPIED.names + SEEN.names
GROUP_OF = np.concatenate([OCCUPIED.group_of, SEEN.group_of])
BOXES = {group.name: len(group.boxes) for group in OCCUPIED.groups + SEEN.groups}
IS_SEEN = np.arange(len(NAMES)) >= len(OCCUPIED.names)
IS_SINGLE = np.array([BOXES[str(group)] == 1 for group in GROUP_OF]) & ~IS_SEEN
POOLS = {"single": IS_SINGLE, "occupied": ~IS_SEEN, "seen": IS_SEEN}

HEAD_WEIGHT = 3.0
CHOOSING_ROWS, CHOOSING_TREES = 250_000, 20


@dataclass(frozen=True, slots=True)
class Plan:
    """A stage to fit: from which pool it may choose how many more groups; trees; learning rate; heads it may lose."""

    name: str
    pool: str
    groups: int
    trees: int
    rate: float
    lose: float
    costly: bool = True
    """Whether a box costs: a stage that few candidates reach may use any."""


SEARCH = (
    Plan("glimpse", "single", 4, 5, 0.40, 0.001),
    Plan("glance", "single", 4, 7, 0.40, 0.001),
    Plan("look", "single", 6, 12, 0.30, 0.002),
    Plan("outline", "occupied", 5, 20, 0.25, 0.003),
    Plan("shape", "occupied", 6, 40, 0.15, 0.005),
)
JUDGE = (
    Plan("nearer", "single", 5, 10, 0.40, 0.001),
    Plan("closer", "occupied", 8, 40, 0.20, 0.002),
    Plan("detail", "occupied", 24, 220, 0.10, 0.006, costly=False),
    Plan("sight", "seen", 16, 200, 0.08, 0.0, costly=False),
)


@dataclass
class Fitted:
    """A stage: its plan, threshold, model, the features that it uses, and every sample's score up to it."""

    plan: Plan
    keep: float
    model: Any
    names: list[str]
    score: F64


def boost(samples: Samples, plans: tuple[Plan, ...], seed: int, say: Callable[[str], None]) -> list[Fitted]:
    """Fit one stage after the other."""
    rows, score = np.ones(len(samples), bool), None
    have: list[str] = []
    fitted: list[Fitted] = []
    for plan in plans:
        pool = POOLS[plan.pool]
        if plan.pool == "seen":
            rows = rows & samples.sees
        if not (rows & ~samples.aside & (samples.label == 1)).any():
            raise HeadvoxError(f"Stage {plan.name}: no head is left to learn from.", "Give more views.")
        have = have + _choose(samples, plan, rows, score, have, seed)
        allowed = pool | POOLS["occupied"] if plan.pool == "seen" else pool
        columns = np.flatnonzero(np.isin(GROUP_OF, have) & allowed)
        model, score = fit(
            samples, columns, rows, score, plan.trees, plan.rate, 1.0 if plan.trees < 40 else 0.5, seed
        )
        keep = quantile_of_heads(samples, score, ~samples.aside & rows, plan.lose)
        fitted.append(Fitted(plan, keep, model, [NAMES[c] for c in columns], score))
        say(f"{plan.name:8s} {describe(samples, score, rows)}")
        rows = rows & (score >= keep)
    return fitted


def _choose(
    samples: Samples, plan: Plan, rows: Mask, score: F64 | None, have: list[str], seed: int
) -> list[str]:
    """Return the groups that a short boosting over all of the pool gains most from."""
    few = rows & ~samples.aside
    negatives = few & (samples.label == 0)
    if negatives.sum() > CHOOSING_ROWS:
        share = CHOOSING_ROWS / negatives.sum()
        few = few & ((np.random.default_rng(seed).random(len(rows)) < share) | (samples.label == 1))
    columns = np.flatnonzero(POOLS[plan.pool])
    model, _ = fit(samples, columns, few, score, CHOOSING_TREES, 0.2, 0.5, seed)
    gain: Counter[str] = Counter()
    for column, value in zip(columns, model.feature_importance("gain"), strict=True):
        group = str(GROUP_OF[column])
        gain[group] += value / (BOXES[group] + 2 if plan.costly else 1)
    return [group for group, _ in gain.most_common() if group not in have][: plan.groups]


def columns_of(samples: Samples, rows: Mask, columns: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Return some features of some rows."""
    border = samples.occupied.shape[1]
    out = np.empty((int(rows.sum()), len(columns)), np.float32)
    where = np.flatnonzero(rows)
    for k, column in enumerate(columns):
        table = samples.occupied if column < border else samples.seen
        out[:, k] = table[where, column if column < border else column - border]
    return out


def fit(
    samples: Samples, columns: npt.NDArray[Any], rows: Mask, start: F64 | None, trees: int, rate: float,
    share: float, seed: int, other: dict[str, int] | None = None, head_weight: float = HEAD_WEIGHT,
) -> tuple[Any, F64]:  # fmt: skip
    """Fit trees to those of ``rows`` that are not kept aside; return the model, and every row's score with it.

    ``start`` is the score before, ``share`` that of the ``columns`` that each tree may use, ``other`` what goes before
    LightGBM's settings here.
    """
    learn = rows & ~samples.aside
    model = train(
        columns_of(samples, learn, columns), samples.label[learn], None if start is None else start[learn],
        np.where(samples.label[learn] == 1, head_weight, 1.0), trees, rate, share, seed, other,
    )  # fmt: skip
    score = np.full(len(rows), -1e3)
    score[rows] = model.predict(columns_of(samples, rows, columns), raw_score=True, num_threads=2)
    if start is not None:
        score[rows] += start[rows]
    return model, score


def train(
    features: npt.NDArray[np.float32], label: npt.NDArray[np.int8], start: F64 | None, weight: F64 | None, trees: int,
    rate: float, share: float, seed: int, other: dict[str, int] | None = None,
) -> Any:  # fmt: skip
    """Return LightGBM's model of rows of ``features`` (N, F): see :func:`fit`."""
    import lightgbm

    data = lightgbm.Dataset(features, label, init_score=start, weight=weight)
    settings = {
        "objective": "binary", "num_leaves": 8, "max_depth": 4, "learning_rate": rate, "min_data_in_leaf": 40,
        "feature_fraction": share, "bagging_fraction": 0.8, "bagging_freq": 1, "lambda_l2": 3.0, "seed": seed + 1,
        "deterministic": True, "force_row_wise": True, "num_threads": 2, "verbose": -1,
        **(other or {}),
    }  # fmt: skip
    return lightgbm.train(settings, data, trees)


def quantile_of_heads(samples: Samples, score: F64, rows: Mask, share: float) -> float:
    """Return the score that this share of the heads stays below."""
    _, best = of_bags(samples, score, rows)
    return float(np.quantile(best, share)) if len(best) else -1e3


def describe(samples: Samples, score: F64, rows: Mask) -> str:
    """Return what the views kept aside say of the candidates that got so far: wrong ones a view at some recalls."""
    aside = samples.aside & rows
    views = len(np.unique(samples.view[aside]))
    wrong = score[aside & (samples.label == 0)]
    parts = []
    for recall in (0.99, 0.98, 0.95, 0.90):
        least = quantile_of_heads(samples, score, aside, 1.0 - recall)
        parts.append(f"{recall:.2f}: {(wrong >= least).sum() / max(views, 1):.2f}")
    return "recall: wrong a view  " + "  ".join(parts)


def prune(fitted: list[Fitted], samples: Samples, accepted: Mask, lose: float) -> None:
    """Raise each stage's threshold to what the heads among the ``accepted`` rows need, all but a share ``lose``."""
    for stage in fitted:
        stage.keep = max(
            stage.keep, quantile_of_heads(samples, stage.score, accepted & (samples.label == 1), lose)
        )
