"""Detectors over a scenario: one sample a frame, and the frames that went worst."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace

import numpy as np

from headvox.config import DetectorConfig, TrackerConfig
from headvox.data import F64, BadFrame, Frame, Heads, Tracks
from headvox.errors import HeadvoxError
from headvox.evaluate.found import FoundHeads
from headvox.evaluate.match import Rules, match
from headvox.evaluate.metrics import Sample, counted
from headvox.evaluate.scenarios import Scenario
from headvox.evaluate.truth import NO_ID, Bools, TrueHeads
from headvox.masks.read import load_cascade
from headvox.pipeline import Detector
from headvox.run import look
from headvox.tracking.tracker import Tracker
from headvox.warmup import warm_up

LOWEST_SCORE = -100.0
MOST_WORST = 6
MOST_HELD = 24
SAME_PLACE_M = 0.3


@dataclass(frozen=True, slots=True, order=True)
class Mishap:
    """A head that was missed, or a detection that is none; the greater ``badness``, the more it is to be looked at."""

    badness: float
    earlier: int
    """Minus the number of the frame: of equally bad ones the first is kept."""
    words: str = field(compare=False)
    times: int = field(compare=False)
    """In how many frames it happened at this place, at least; where frames follow on each other."""
    frame: Frame = field(compare=False)
    place: F64 = field(compare=False)
    found: FoundHeads = field(compare=False)
    true: TrueHeads = field(compare=False)
    counted: Bools = field(compare=False)
    """Which of the true heads had to be found."""

    @property
    def number(self) -> int:
        """The number of the frame, from 0."""
        return -self.earlier


@dataclass(slots=True)
class Run:
    """What came of a scenario: its samples, the worst of its mistakes, and how many frames could not be used."""

    samples: list[Sample] = field(default_factory=list)
    misses: list[Mishap] = field(default_factory=list)
    false: list[Mishap] = field(default_factory=list)
    bad: int = 0


@dataclass(frozen=True, slots=True)
class Finder:
    """A detector as an evaluation sees it: ``find`` gives what it found, and what it finds without a threshold.

    ``tuned_on`` is what its cascade says; None where nobody can tell.
    """

    name: str
    tuned_on: tuple[str, ...] | None
    find: Callable[[Frame], tuple[FoundHeads, FoundHeads | None]]


def bare(config: DetectorConfig, stack: ExitStack) -> Finder:
    """Return a detector that takes every frame by itself; without a threshold it is not timed."""
    warm_up(config)
    detector = stack.enter_context(closing(Detector(config)))
    sweeper = stack.enter_context(closing(Detector(replace(config, min_score=LOWEST_SCORE))))

    def find(frame: Frame) -> tuple[FoundHeads, FoundHeads]:
        result, _ = look(detector, None, frame, 0)
        return of_heads(result.heads, result.latency_ms), of_heads(sweeper.detect_frame(frame))

    return Finder(config.cascade, load_cascade(config.cascade).tuned_on, find)


def tracked(config: DetectorConfig, tracker_config: TrackerConfig, stack: ExitStack) -> Finder:
    """Return a detector with a tracker, as ``headvox run`` has them: what it states are the tracks."""
    warm_up(config)
    detector = stack.enter_context(closing(Detector(config)))
    tracker = Tracker(tracker_config)

    def find(frame: Frame) -> tuple[FoundHeads, None]:
        result, _ = look(detector, tracker, frame, 0)
        assert result.tracks is not None
        return of_tracks(result.tracks, result.latency_ms), None

    return Finder(f"{config.cascade} tracked", load_cascade(config.cascade).tuned_on, find)


def written(name: str, lines: Mapping[int, FoundHeads], stamps: Set[int]) -> Finder:
    """Return what another program wrote, by the stamps of a recording; a frame without a line has no heads.

    Raises:
        HeadvoxError: no line has one of the ``stamps``.
    """
    if not stamps & lines.keys():
        raise HeadvoxError(
            f"{name}: no line has the stamp of a frame of the recording.", "Is it what was found in this one?"
        )

    def find(frame: Frame) -> tuple[FoundHeads, FoundHeads | None]:
        found = lines.get(frame.stamp_ns, FoundHeads.none())
        return found, found if np.isfinite(found.scores).all() else None

    return Finder(name, None, find)


def of_heads(heads: Heads, latency_ms: float = math.nan) -> FoundHeads:
    """Return bare detections as found heads."""
    return FoundHeads(heads.centres, heads.quaternions, heads.scores, np.full(len(heads), NO_ID), latency_ms)


def of_tracks(tracks: Tracks, latency_ms: float) -> FoundHeads:
    """Return tracks as found heads; those that are tentative have no id."""
    ids = np.where(tracks.ids > 0, tracks.ids, NO_ID)
    return FoundHeads(tracks.centres, tracks.quaternions, tracks.scores, ids, latency_ms)


def go_over(
    scenario: Scenario, finders: Sequence[Finder], rules: Rules, on_frame: Callable[[int], None]
) -> list[Run]:
    """Let every finder look at every frame, one after another."""
    runs = [Run() for _ in finders]
    for number, (frame, true) in enumerate(scenario.frames()):
        sensors = _sensors(frame)
        for finder, run in zip(finders, runs, strict=True):
            try:
                if isinstance(frame, BadFrame):
                    raise HeadvoxError(frame.reason)
                found, swept = finder.find(frame)
            except HeadvoxError:  # a frame that no head can be found in: its heads are missed
                run.bad += 1
                found, swept = FoundHeads.none(), FoundHeads.none()
            run.samples.append(Sample(frame.stamp_ns, found, true, sensors, swept))
            if true is not None and isinstance(frame, Frame):
                _keep_worst(run, scenario.moving, number, frame, found, true, rules)
        on_frame(number + 1)
    for run in runs:
        del run.misses[MOST_WORST:], run.false[MOST_WORST:]
    return runs


def _sensors(frame: Frame | BadFrame) -> F64:
    """Return where the sensors stand, (S, 3), as far as is known."""
    if isinstance(frame, BadFrame):
        return np.empty((0, 3))
    places = [image.T_world_camera[:3, 3] for image in frame.depths]
    places += [cloud.T_world_sensor[:3, 3] for cloud in frame.clouds if cloud.T_world_sensor is not None]
    return np.array(places).reshape(-1, 3)


def _keep_worst(
    outcome: Run, moving: bool, number: int, frame: Frame, found: FoundHeads, true: TrueHeads, rules: Rules
) -> None:
    """Keep the most visible heads that were missed, and the false ones with the best scores."""
    kept = counted(true, rules)
    pairing = match(found.centres, true.centres, kept, rules)
    for j in pairing.missed:
        is_told = not np.isnan(true.visible[j])
        seen = float(true.visible[j]) if is_told else 1.0
        words = f"missed, {seen:.0%} visible" if is_told else "missed"
        miss = Mishap(seen, -number, words, 1, frame, true.centres[j], found, true, kept)
        _hold(outcome.misses, moving, miss)
    for i in pairing.false:
        score = 0.0 if np.isnan(found.scores[i]) else float(found.scores[i])
        _hold(
            outcome.false,
            moving,
            Mishap(score, -number, "no head", 1, frame, found.centres[i], found, true, kept),
        )


def _hold(worst: list[Mishap], moving: bool, mishap: Mishap) -> None:
    """Hold the mishap if it is one of the worst; of those at one place, where frames follow on, the worst only."""
    here = [m for m in worst if moving and np.linalg.norm(m.place - mishap.place) < SAME_PLACE_M]
    if here:
        worst.remove(here[0])
        mishap = replace(max(here[0], mishap), times=here[0].times + 1)
    worst.append(mishap)
    worst.sort(reverse=True)
    del worst[MOST_HELD:]
