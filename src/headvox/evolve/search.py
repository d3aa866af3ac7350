"""The search, step by step: gate, search stages, judge stages, thresholds.

Rendering the views takes nearly all of the time, and they are kept in the work folder: a search that was stopped, or
one with other settings, goes on from there. After each round of the judge there is a cascade file in the folder.
Whatever the number of processes, the same seed gives the same file.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TypeVar

import numpy as np

from headvox.errors import HeadvoxError, MissingExtra
from headvox.evolve import boost, gates
from headvox.evolve.again import Peaks, fit_again, spoilt_peaks
from headvox.evolve.bank import SUBDIVISION, VOXEL_M
from headvox.evolve.check import check
from headvox.evolve.relief import Looks, fit_relief, spoilt_looks
from headvox.evolve.samples import (
    GateSums,
    Samples,
    is_aside,
    join,
    judge_samples,
    of_bags,
    search_samples,
    without_new_heads,
)
from headvox.evolve.verify import Fits, fit_verification, spoilt_fits
from headvox.evolve.views import View, keep_view
from headvox.evolve.write import Found, cascade_text, write_cascade
from headvox.masks.cascade import Cascade, Condition
from headvox.masks.compile import CompiledCascade, CompiledGate, compile_cascade
from headvox.masks.read import load_cascade, parse_cascade
from headvox.parallel.workers import ALONE, Workers
from headvox.writable import make_folder

LEAST_VIEWS = 200
GATE_VIEWS = 3000
GATE_LOSES, TIGHT_GATE_LOSES = 0.03, 0.004
SEARCH_ROUNDS = 2
PRUNED = 0.004
JUDGE_MISSES = 0.10  # of the heads that the search leaves: what the stages before need not keep
PATIENCE = 1.0  # by which stages keep more, once the last look can tell what they cannot
HASTY = 2  # stages that do not, from the first: what these let through costs most
MINED = -4.0  # score of the judge from which a voxel that is no head is worth another look
FALSE_A_FRAME = 0.02
WORTH_A_ROUND = 0.002  # of recall

Made = TypeVar("Made")
Take = Callable[[View], Samples | None]
Say = Callable[[str], None]


@dataclass(frozen=True)
class Settings:
    """What to search with: ``views`` of ``seed``, kept in the folder ``work``; the ``workers`` do it."""

    work: Path
    views: int
    name: str = "evolved"
    seed: int = 0
    rounds: int = 3
    """Of the judge, at most: it ends when a round has not helped."""
    workers: Workers = ALONE


def evolve(settings: Settings, say: Say) -> Found:
    """Search for a cascade, and return the best; its thresholds are set on the views kept aside.

    Raises:
        HeadvoxError: the folder holds views of another seed, too few views, or a library is missing.
    """
    _need_libraries()
    _claim(settings)
    sums = gates.join_sums([s for s in _of_views(settings, GateSums.of, GATE_VIEWS) if s is not None])
    limits = gates.find_limits(sums, GATE_LOSES, settings.seed)
    gate = gates.as_conditions(limits, sums)
    say(f"gate: {_gate_text(limits, sums)}")
    every_voxel = _compile_gate(gate)

    def to_search(fitted: list[boost.Fitted]) -> Take:
        miner = _compile(gate, fitted).stages if fitted else None
        return partial(search_samples, gate=every_voxel, miner=miner)

    *_, (samples, search) = _rounds(settings, SEARCH_ROUNDS, to_search, boost.SEARCH, say)

    def to_judge(fitted: list[boost.Fitted]) -> Take:
        passed = _compile(gate, search, fitted)
        assert passed.stages is not None
        return partial(judge_samples, gate=every_voxel, search=passed.stages, miner=passed.judge, least=MINED)

    best, best_recall = None, -1.0
    for number, (judged, judge) in enumerate(
        _rounds(settings, settings.rounds, to_judge, boost.JUDGE, say), 1
    ):
        found = _assemble(settings, sums, samples, search, judged, judge)
        path = settings.work / f"round-{number}.toml"
        write_cascade(path, settings.name, found)
        found, recall = _with_thresholds(settings, path, found)
        write_cascade(path, settings.name, found)
        say(
            f"round {number}: {100 * recall:.1f} % of the heads kept aside at {FALSE_A_FRAME:g} false a frame"
        )
        if recall < best_recall + WORTH_A_ROUND:
            break
        best, best_recall = found, recall
    assert best is not None
    found = _with_last_look(settings, _with_second_opinion(settings, best, say), say)
    return _with_verification(settings, found, say)


def _with_second_opinion(settings: Settings, found: Found, say: Say) -> Found:
    """Return ``found`` with the judge's last stage, and its thresholds set anew."""
    path = settings.work / "once.toml"
    write_cascade(path, settings.name, found)
    parts = [part for part in _of_views(settings, partial(spoilt_peaks, cascade=path)) if part is not None]
    if not parts:
        return found
    peaks = Peaks.join(parts)
    asked = [group.name for group in load_cascade(str(path)).groups]
    last = fit_again(peaks, asked, settings.seed)
    if last is None:
        return found
    heads = int(peaks.samples.label.sum())
    say(f"peaks of spoilt views: {heads} of heads, {len(peaks.score) - heads} others")
    found = replace(found, judge=[*found.judge, last])
    path = settings.work / "twice.toml"
    write_cascade(path, settings.name, found)
    found, recall = _with_thresholds(settings, path, found)
    say(f"asked again: {100 * recall:.1f} % of the heads kept aside at {FALSE_A_FRAME:g} false a frame")
    return found


def _with_last_look(settings: Settings, found: Found, say: Say) -> Found:
    """Return ``found`` with the relief's trees, and its thresholds set anew."""
    hasty, patient = found.search[:HASTY], found.search[HASTY:]
    found = replace(found, search=[*hasty, *_patient(patient)], judge=_patient(found.judge))
    path = settings.work / "blunt.toml"
    write_cascade(path, settings.name, found)
    parts = [part for part in _of_views(settings, partial(spoilt_looks, cascade=path)) if part is not None]
    relief = fit_relief(Looks.join(parts), settings.seed) if parts else None
    if relief is None:
        return found
    found = replace(found, relief=relief)
    path = settings.work / "sharp.toml"
    write_cascade(path, settings.name, found)
    found, recall = _with_thresholds(settings, path, found)
    say(f"looked again: {100 * recall:.1f} % of the heads kept aside at {FALSE_A_FRAME:g} false a frame")
    return found


def _patient(stages: Sequence[boost.Fitted]) -> list[boost.Fitted]:
    return [replace(stage, keep=stage.keep - PATIENCE) for stage in stages]


def _with_verification(settings: Settings, found: Found, say: Say) -> Found:
    """Return ``found`` with what the pose fit may take from a score; the thresholds stay, for who fits no poses."""
    path = settings.work / "sharp.toml"
    write_cascade(path, settings.name, found)
    parts = [part for part in _of_views(settings, partial(spoilt_fits, cascade=path)) if part is not None]
    rule = fit_verification(Fits.join(parts)) if parts else None
    if rule is None:
        return found
    say(f"verification: a unit of misfit costs {rule.misfit:g}, a centimetre of radius {rule.radius / 100:g}")
    return replace(found, verification=rule)


def _need_libraries() -> None:
    """Say now what would be missed only when the views are made, which takes hours."""
    try:
        for name in ("cmaes", "lightgbm"):
            import_module(name)
    except (ImportError, OSError) as error:  # OSError: LightGBM finds no OpenMP
        raise MissingExtra(f"The search for a cascade needs LightGBM and cmaes: {error}.", "evolve") from None


def _claim(settings: Settings) -> None:
    """Make the folder, or see that its views are of the same seed."""
    if settings.views < LEAST_VIEWS:
        what = f"Expected at least {LEAST_VIEWS} views, of which 20 are kept aside, got {settings.views}."
        raise HeadvoxError(what, "Thousands are better.")
    make_folder(settings.work / "views", settings.work)
    note = settings.work / "search.json"
    mine = {"format": "headvox-search", "version": 1, "seed": settings.seed}
    if note.exists() and json.loads(note.read_text(encoding="utf-8")) != mine:
        raise HeadvoxError(
            f"{settings.work}: holds the views of another seed than {settings.seed}.",
            "Give the same --seed, or another folder with --work.",
        )
    note.write_text(json.dumps(mine) + "\n", encoding="utf-8")


def _assemble(
    settings: Settings, sums: GateSums, samples: Samples, search: list[boost.Fitted], judged: Samples,
    judge: list[boost.Fitted],
) -> Found:  # fmt: skip
    """Put the parts together, each no more patient than the heads that all of it accepts in the end ask for."""
    search, judge = ([replace(stage) for stage in part] for part in (search, judge))
    learnt = ~judged.aside
    least = boost.quantile_of_heads(judged, judge[-1].score, learnt & judged.sees, JUDGE_MISSES)
    least_occupied = boost.quantile_of_heads(judged, judge[-2].score, learnt, JUDGE_MISSES)
    final = np.where(judged.sees, judge[-1].score - least, judge[-2].score - least_occupied)
    heads, score = of_bags(judged, final, learnt)
    accepted = heads[score >= 0.0]
    boost.prune(judge[:-1], judged, np.isin(judged.bag, accepted), PRUNED)
    of_accepted = ~samples.aside & np.isin(samples.bag // 16 * 16, accepted)
    boost.prune(search, samples, of_accepted, PRUNED)
    limits = gates.find_limits(sums, TIGHT_GATE_LOSES, settings.seed, np.unique(samples.bag[of_accepted]))
    return Found(gates.as_conditions(limits, sums), search, judge)


def _with_thresholds(settings: Settings, path: Path, found: Found) -> tuple[Found, float]:
    """Return ``found`` with its thresholds and where they are from, and the recall at the first of them."""
    numbers = np.arange(settings.views)
    aside = numbers[is_aside(numbers)].tolist()
    views = [keep_view(settings.work / "views", settings.seed, number) for number in aside]
    outcome, occupied = check(path, views), check(path, views, as_clouds=True)
    least, least_occupied = outcome.threshold(FALSE_A_FRAME), occupied.threshold(FALSE_A_FRAME)
    given = f"synthetic views 0-{settings.views - 1} of seed {settings.seed}"
    tuned_on = (
        f"boosting: {given}, but those kept aside (180-199 of every 200)",
        f"both thresholds: the {len(aside)} views kept aside, {FALSE_A_FRAME:g} false heads a frame",
    )
    found = replace(found, min_score=least, min_score_occupied=least_occupied, tuned_on=tuned_on)
    return found, outcome.recall(least)


def _gate_text(limits: gates.Limits, sums: GateSums) -> str:
    heads, others = gates.report(limits, sums)
    return f"{100 * heads:.2f} % of the heads pass, {100 * others:.1f} % of what is near points"


def _rounds(
    settings: Settings, count: int, take: Callable[[list[boost.Fitted]], Take], plans: tuple[boost.Plan, ...], say: Say
) -> Iterator[tuple[Samples, list[boost.Fitted]]]:  # fmt: skip
    """Fit, look for what the fit is wrong about, add it, fit again."""
    fitted: list[boost.Fitted] = []
    samples: Samples | None = None
    for _ in range(count):
        parts = [part for part in _of_views(settings, take(fitted)) if part is not None]
        if not parts:  # nothing is left that the last fit was wrong about
            return
        new = join(parts)
        samples = new if samples is None else join([samples, without_new_heads(new)])
        wrong = int((samples.label == 0).sum())
        say(f"samples: {len(samples) - wrong} voxels of heads, {wrong} others")
        fitted = boost.boost(samples, plans, settings.seed, say)
        yield samples, fitted


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
    yield from settings.workers.map(partial(_take, settings.work / "views", settings.seed, take), numbers)


def _take(folder: Path, seed: int, take: Callable[[View], Made], number: int) -> Made:
    return take(keep_view(folder, seed, number))
