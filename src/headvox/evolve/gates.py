"""The limits of the gate: the fewest survivors that cost hardly a head, by CMA-ES (Hansen, 2016).

The conditions are given (:data:`headvox.evolve.bank.GATE_GROUPS`), and each has a lower and an upper limit. What is
minimised is the share of voxels that pass; a share of heads lost above what is allowed costs far more.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.data import F64, I64
from headvox.evolve.bank import GATE
from headvox.evolve.samples import GateSums
from headvox.masks.cascade import Condition

LOST_COST = 30.0
GENERATIONS = 400
OTHERS = 40_000
LEAST_CROWN = 2  # parts: the gate has to ask for something, as only places near points are searched
NEVER = 0.0002  # a limit that throws out less than this share of the voxels is left out

Limits = npt.NDArray[np.int64]


def join_sums(parts: list[GateSums]) -> GateSums:
    """Put the sums of several views one after the other."""
    return GateSums(np.concatenate([p.sums for p in parts]), np.concatenate([p.bag for p in parts]))


def find_limits(sums: GateSums, lost: float, seed: int, bags: I64 | None = None) -> Limits:
    """Return the limits (conditions, 2) that pass the fewest voxels and lose at most a share ``lost`` of the heads.

    ``bags``, if given, are the heads that count: those that the rest of the cascade accepts.
    """
    from cmaes import CMA

    heads = sums.bag >= 0 if bags is None else np.isin(sums.bag, bags)
    values, (_, bag) = sums.sums[heads], np.unique(sums.bag[heads], return_inverse=True)
    others = sums.sums[sums.bag < 0][:OTHERS]
    middle, scale = values.mean(axis=0), values.std(axis=0) + 1.0

    def limits_of(x: F64) -> F64:
        return np.stack([middle + scale * x[0::2], middle + scale * x[1::2]], axis=1)

    def cost(x: F64) -> float:
        limits = limits_of(x)
        kept = np.zeros(bag.max() + 1, bool)
        kept[bag[_passing(values, limits)]] = True
        too_many = max(1.0 - kept.mean() - lost, 0.0)
        return float(_passing(others, limits).mean() + LOST_COST * too_many)

    quantiles = (np.quantile(values, [0.25 * lost, 1.0 - 0.25 * lost], axis=0) - middle) / scale
    start = quantiles.T.reshape(-1)
    search = CMA(start, 0.3, seed=seed, population_size=24)
    best, best_cost = start, cost(start)
    for _ in range(GENERATIONS):
        asked = [search.ask() for _ in range(search.population_size)]
        told = [(x, cost(x)) for x in asked]
        search.tell(told)
        x, value = min(told, key=lambda pair: pair[1])
        if value < best_cost:
            best, best_cost = x, value
    limits = limits_of(best)
    return np.stack([np.floor(limits[:, 0]), np.ceil(limits[:, 1])], axis=1).astype(np.int64)


def _passing(sums: npt.NDArray[Any], limits: F64) -> npt.NDArray[np.bool_]:
    return np.asarray(((sums >= limits[:, 0]) & (sums <= limits[:, 1])).all(axis=1))


def as_conditions(limits: Limits, sums: GateSums) -> tuple[Condition, ...]:
    """Return the gate with these limits, the one that throws out most first, without limits that do nothing."""
    others = sums.sums[sums.bag < 0]
    conditions: list[Condition] = []
    alive = np.ones(len(others), bool)
    todo = list(range(len(GATE.groups)))
    while todo:
        passing = {i: alive & (others[:, i] >= limits[i, 0]) & (others[:, i] <= limits[i, 1]) for i in todo}
        # The crown comes first: its lower limit bounds whole columns.
        best = 0 if 0 in todo else min(todo, key=lambda i: (int(passing[i].sum()), i))
        todo.remove(best)
        group, (low, high) = GATE.groups[best], limits[best]
        volume = sum(
            np.prod(np.diff(box.reshape(3, 2), axis=1)) * weight.weight * 8
            for box, weight in zip(
                GATE.boxes[GATE.start[best] : GATE.start[best + 1]], group.boxes, strict=True
            )
            if weight.weight > 0
        )
        asks_low = best == 0 or (alive & (others[:, best] < low)).mean() >= NEVER
        asks_high = (alive & (others[:, best] > high)).mean() >= NEVER
        least = (max(low, LEAST_CROWN) if best == 0 else low) - 0.5
        minimum = round(float(least) / volume, 5) if asks_low else -math.inf
        maximum = round(float(high + 0.5) / volume, 5) if asks_high else math.inf
        if asks_low or asks_high:
            conditions.append(Condition(group, 0, minimum, maximum))
            alive = passing[best]
    return tuple(conditions)


def report(limits: Limits, sums: GateSums) -> tuple[float, float]:
    """Return the shares of heads and of other voxels that pass."""
    passing = _passing(sums.sums, limits.astype(np.float64))
    heads = np.unique(sums.bag[sums.bag >= 0])
    return len(np.unique(sums.bag[passing & (sums.bag >= 0)])) / max(len(heads), 1), float(
        passing[sums.bag < 0].mean()
    )
