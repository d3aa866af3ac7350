"""The search, step by step: gate, search stages, judge stages, thresholds.

Every step reads the views that :mod:`headvox.evolve.views` keeps on disk and leaves a cascade file in the work folder,
so a stopped search goes on where it was. Whatever the number of processes, the same seed gives the same file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from headvox.evolve import boost, gates
from headvox.evolve.bank import SUBDIVISION, VOXEL_M
from headvox.evolve.samples import (
    GateSums,
    Samples,
    join,
    judge_samples,
    of_bags,
    search_samples,
    without_new_heads,
)
from headvox.evolve.views import View, keep_view
from headvox.evolve.write import Found, cascade_text
from headvox.masks import Cascade, CompiledCascade, CompiledGate, Condition, compile_cascade, parse_cascade
from headvox.synth.processes import in_processes

GATE_LOSES, TIGHT_GATE_LOSES = 0.03, 0.004
GATE_VIEWS = 3000
PRUNED = 0.004
JUDGE_MISSES = 0.10  # of the heads that the search leaves, when the search's thresholds are set
MINED = -4.0  # score of the judge from which a voxel that is no head is worth another look
Made = TypeVar("Made")
Take = Callable[[View], Samples | None]


@dataclass(frozen=True)
class Settings:
    """What to search with."""

    work: Path
    views: int
    seed: int = 0
    rounds: int = 2
    workers: int = 1


def evolve(settings: Settings, say: Callable[[str], None]) -> Found:
    """Search for a cascade; its thresholds are those that synthetic views kept aside ask for."""
    sums = gates.join_sums([s for s in _of_views(settings, GateSums.of, GATE_VIEWS) if s is not None])
    limits = gates.find_limits(sums, GATE_LOSES, settings.seed)
    gate = gates.as_conditions(limits, sums)
    say(f"gate: {_gate_text(limits, sums)}")

    every_voxel = _compile_gate(gate)

    def to_search(fitted: list[boost.Fitted]) -> Take:
        return partial(
            search_samples, gate=every_voxel, miner=_compile(gate, fitted).stages if fitted else None
        )

    def to_judge(fitted: list[boost.Fitted]) -> Take:
        passed = _compile(gate, search, fitted)
        assert passed.stages is not None
        return partial(judge_samples, gate=every_voxel, search=passed.stages, miner=passed.judge, least=MINED)

    samples, search = _rounds(settings, settings.rounds, to_search, boost.SEARCH, say)
    judged, judge = _rounds(settings, settings.rounds + 1, to_judge, boost.JUDGE, say)
    least = boost.quantile_of_heads(judged, judge[-1].score, ~judged.aside & judged.sees, JUDGE_MISSES)
    least_occupied = boost.quantile_of_heads(judged, judge[-2].score, ~judged.aside, JUDGE_MISSES)
    accepted = _accepted(judged, judge, least, least_occupied)
    boost.prune(judge[:-1], judged, np.isin(judged.bag, accepted), PRUNED)
    mine = ~samples.aside & np.isin(samples.bag // 16 * 16, accepted)
    boost.prune(search, samples, mine, PRUNED)
    bags = np.unique(samples.bag[mine])
    limits = gates.find_limits(sums, TIGHT_GATE_LOSES, settings.seed, bags)
    say(f"gate: {_gate_text(limits, sums)}")
    return Found(gates.as_conditions(limits, sums), search, judge, least, least_occupied)


def _accepted(samples: Samples, judge: list[boost.Fitted], least: float, least_occupied: float) -> np.ndarray:
    """Return the heads that the judge accepts."""
    final = np.where(samples.sees, judge[-1].score - least, judge[-2].score - least_occupied)
    bags, best = of_bags(samples, final, ~samples.aside)
    return bags[best >= 0.0]


def _gate_text(limits: gates.Limits, sums: GateSums) -> str:
    heads, others = gates.report(limits, sums)
    return f"{100 * heads:.2f} % of the heads pass, {100 * others:.1f} % of what is near points"


def _rounds(
    settings: Settings,
    rounds: int,
    take: Callable[[list[boost.Fitted]], Take],
    plans: tuple[boost.Plan, ...],
    say: Callable[[str], None],
) -> tuple[Samples, list[boost.Fitted]]:
    """Fit, look for what the fit is wrong about, add it, fit again."""
    fitted: list[boost.Fitted] = []
    samples: Samples | None = None
    for number in range(1, rounds + 1):
        new = join(part for part in _of_views(settings, take(fitted)) if part is not None)
        samples = new if samples is None else join([samples, without_new_heads(new)])
        wrong = int((samples.label == 0).sum())
        say(f"round {number}: {len(samples) - wrong} voxels of heads, {wrong} others")
        fitted = boost.boost(samples, plans, settings.seed, say)
    assert samples is not None
    return samples, fitted


def _compile(
    gate: tuple[Condition, ...], search: Sequence[boost.Fitted], judge: Sequence[boost.Fitted] = ()
) -> CompiledCascade:
    """Return what was found so far as the detector has it: through its file."""
    return compile_cascade(parse_cascade(cascade_text("search", Found(gate, search, judge)), "search"))


def _compile_gate(gate: tuple[Condition, ...]) -> CompiledGate:
    """Return the gate alone, for every voxel: which of them the detector looks at depends on where it stands."""
    return compile_cascade(
        Cascade("gate", "", VOXEL_M, SUBDIVISION, False, gate, None, (), (), 0.0, 0.0, ())
    ).gate


def _of_views(settings: Settings, take: Callable[[View], Made], most: int | None = None) -> Iterator[Made]:
    numbers = range(min(settings.views, most or settings.views))
    folder = settings.work / "views"
    folder.mkdir(parents=True, exist_ok=True)
    yield from in_processes(partial(_take, folder, settings.seed, take), numbers, settings.workers)


def _take(folder: Path, seed: int, take: Callable[[View], Made], number: int) -> Made:
    return take(keep_view(folder, seed, number))
