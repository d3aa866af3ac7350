"""What comes of scenarios: every finder goes over each, here or on a cluster, and is scored."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path

from headvox.config import DetectorConfig, TrackerConfig
from headvox.evaluate.found import read_found
from headvox.evaluate.heldout import tuned_frames, word
from headvox.evaluate.loop import Finder, Run, bare, go_over, tracked, written
from headvox.evaluate.match import Rules
from headvox.evaluate.scenarios import Scenario
from headvox.evaluate.scores import Scores, score
from headvox.parallel.workers import Workers


@dataclass(frozen=True, slots=True)
class Plan:
    """What each scenario is evaluated with: detectors, and a tracker unless it is None; or the results in ``heads``."""

    configs: tuple[DetectorConfig, ...]
    tracker: TrackerConfig | None
    rules: Rules
    heads: Path | None = None
    name: str | None = None
    """Of the detector that wrote ``heads``; by default that of the file."""
    pictures: bool = False
    """Whether the frames that went worst are to be kept."""

    def rules_of(self, scenario: Scenario) -> Rules:
        """Return what counts in a scenario."""
        return scenario.rules or self.rules


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one finder made of one scenario; ``scores`` has a second entry where some frames were kept aside."""

    scores: tuple[Scores, ...]
    run: Run


def evaluate(scenario: Scenario, plan: Plan, on_frame: Callable[[int], None] | None = None) -> list[Outcome]:
    """Let all that the plan asks for go over a scenario, one frame after the other."""
    rules = plan.rules_of(scenario)
    with ExitStack() as stack:
        finders = _finders(scenario, plan, stack)
        runs = go_over(scenario, finders, rules, on_frame or (lambda number: None))
    for run in runs:
        if not plan.pictures:  # frames are large, and nobody is going to look at them
            run.misses.clear()
            run.false.clear()
    return [
        Outcome(_scores(scenario, finder, run, rules), run) for finder, run in zip(finders, runs, strict=True)
    ]


def evaluate_all(
    scenarios: Sequence[Scenario], plan: Plan, workers: Workers, on_done: Callable[[int], None]
) -> Iterator[tuple[Scenario, list[Outcome]]]:
    """Yield what comes of each scenario, in their order; each is one piece of work for the ``workers``."""
    outcomes = workers.map(partial(evaluate, plan=plan), scenarios)
    for number, (scenario, outcome) in enumerate(zip(scenarios, outcomes, strict=True), 1):
        on_done(number)
        yield scenario, outcome


def pooled(outcomes: Sequence[Outcome], rules: Rules) -> Scores | None:
    """Return the figures of one detector over all frames of several recordings; of tracks each tells for itself."""
    if len(outcomes) < 2:
        return None
    samples = list(chain.from_iterable(outcome.run.samples for outcome in outcomes))
    words = {outcome.scores[0].tuned for outcome in outcomes}
    tuned = words.pop() if len(words) == 1 else "partly" if words & {"yes", "partly"} else "no"
    return score(f"all {len(outcomes)} recordings", outcomes[0].scores[0].detector, samples, rules, tuned)


def _finders(scenario: Scenario, plan: Plan, stack: ExitStack) -> list[Finder]:
    """Return what is to look at a scenario: another program's lines, or each cascade, bare and with a tracker."""
    if plan.heads is not None:
        stamps = {frame.stamp_ns for frame, _ in scenario.frames()}
        return [written(plan.name or plan.heads.stem, read_found(plan.heads), stamps)]
    finders = []
    for config in plan.configs:
        finders.append(bare(config, stack))
        if scenario.moving and scenario.length != 1 and plan.tracker is not None:
            finders.append(tracked(config, plan.tracker, stack))
    return finders


def _scores(scenario: Scenario, finder: Finder, run: Run, rules: Rules) -> tuple[Scores, ...]:
    """Return the scores on all frames, and those on the frames kept aside where some were not."""
    labelled = [sample for sample in run.samples if sample.true is not None]
    if finder.tuned_on is None:
        return (score(scenario.name, finder.name, run.samples, rules),)
    used = tuned_frames(finder.tuned_on, scenario.recording, len(labelled))
    tuned = word(used, finder.tuned_on, scenario.synthetic)
    whole = score(scenario.name, finder.name, run.samples, rules, tuned)
    if used.all() or not used.any():
        return (whole,)
    aside = [sample for sample, was_used in zip(labelled, used, strict=True) if not was_used]
    return (whole, score(f"{scenario.name}, kept aside", finder.name, aside, rules, "no"))
