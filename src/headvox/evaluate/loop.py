"""A detector over a scenario: one sample a frame, and the frames that went worst."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace

import numpy as np

from headvox.config import DetectorConfig
from headvox.data import F64, BadFrame, Frame, Heads
from headvox.errors import HeadvoxError
from headvox.evaluate.found import FoundHeads
from headvox.evaluate.match import Rules, match
from headvox.evaluate.metrics import Sample, counted
from headvox.evaluate.scenarios import Scenario
from headvox.evaluate.truth import NO_ID, Bools, TrueHeads
from headvox.pipeline import Detector
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


def run_detector(
    scenario: Scenario,
    config: DetectorConfig,
    rules: Rules,
    on_frame: Callable[[int], None] = lambda number: None,
) -> Run:
    """Find the heads in every frame: once as configured, timed, and once more without threshold, not timed."""
    warm_up(config)
    outcome = Run()
    with ExitStack() as stack:
        detector = stack.enter_context(closing(Detector(config)))
        sweeper = stack.enter_context(closing(Detector(replace(config, min_score=LOWEST_SCORE))))

        def find(frame: Frame) -> tuple[FoundHeads, FoundHeads | None]:
            begun = time.perf_counter()
            heads = detector.detect_frame(frame)
            found = found_of(heads, 1e3 * (time.perf_counter() - begun))
            return found, found_of(sweeper.detect_frame(frame))

        _go_over(scenario, find, outcome, rules, on_frame)
    return outcome


def run_lines(scenario: Scenario, lines: dict[int, FoundHeads], rules: Rules) -> Run:
    """Take what another program found, by the stamps; a frame without a line has no heads.

    Raises:
        HeadvoxError: no line has the stamp of a frame.
    """
    outcome = Run()
    seen: set[int] = set()

    def find(frame: Frame) -> tuple[FoundHeads, FoundHeads | None]:
        seen.add(frame.stamp_ns)
        found = lines.get(frame.stamp_ns, FoundHeads.none())
        return found, found if np.isfinite(found.scores).all() else None

    _go_over(scenario, find, outcome, rules, lambda number: None)
    if not seen & lines.keys():
        raise HeadvoxError(
            f"{scenario.name}: no line has the stamp of one of its frames.",
            "Are the lines of this recording?",
        )
    return outcome


def found_of(heads: Heads, latency_ms: float = float("nan")) -> FoundHeads:
    """Return bare detections as found heads."""
    return FoundHeads(heads.centres, heads.quaternions, heads.scores, np.full(len(heads), NO_ID), latency_ms)


def _go_over(
    scenario: Scenario,
    find: Callable[[Frame], tuple[FoundHeads, FoundHeads | None]],
    outcome: Run,
    rules: Rules,
    on_frame: Callable[[int], None],
) -> None:
    for number, (frame, true) in enumerate(scenario.frames()):
        if isinstance(frame, BadFrame):
            outcome.bad += 1
            outcome.samples.append(Sample(frame.stamp_ns, FoundHeads.none(), true, np.empty((0, 3))))
            continue
        try:
            found, swept = find(frame)
        except HeadvoxError:  # a frame that no head can be found in; its heads are missed
            outcome.bad += 1
            found, swept = FoundHeads.none(), FoundHeads.none()
        sensors = [image.T_world_camera[:3, 3] for image in frame.depths]
        sensors += [cloud.T_world_sensor[:3, 3] for cloud in frame.clouds if cloud.T_world_sensor is not None]
        outcome.samples.append(Sample(frame.stamp_ns, found, true, np.array(sensors).reshape(-1, 3), swept))
        if true is not None:
            _keep_worst(outcome, scenario.moving, number, frame, found, true, rules)
        on_frame(number + 1)
    del outcome.misses[MOST_WORST:], outcome.false[MOST_WORST:]


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
