"""Everything that is compared is called in turn, a few calls each, round after round.

So whatever else the machine does hits all of it alike. The first call of a few finds in the caches what the others left
there, and the second one is still slower than those that follow: both are told apart, as "cold" and "second".
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from headvox.pipeline import Detector

BURST = 6  # calls in a row, the first of which is cold, and the second told apart


@dataclass(slots=True)
class Case:
    """One thing that is called a few times a round, or once in ``every`` rounds."""

    name: str
    call: Callable[[], object]
    detector: Detector | None = None
    every: int = 1
    ms: list[float] = field(default_factory=list)
    cold_ms: list[float] = field(default_factory=list)
    second_ms: list[float] = field(default_factory=list)
    stages: dict[str, list[float]] = field(default_factory=dict)

    def measure(self) -> None:
        """Call a few times and keep the times, and those of each stage; the first two apart from the others."""
        self.cold_ms.append(self._time())
        if self.every > 1:  # slow enough not to care about caches
            self.second_ms.append(self.cold_ms[-1])
            self.ms.append(self.cold_ms[-1])
            return
        self.second_ms.append(self._time())
        for _ in range(BURST - 2):
            self.ms.append(self._time())
            if self.detector is not None:
                for stage, ms in self.detector.stage_ms.items():
                    self.stages.setdefault(stage, []).append(ms)

    def _time(self) -> float:
        begun = time.perf_counter()
        self.call()
        return 1e3 * (time.perf_counter() - begun)


def run_rounds(cases: list[Case], rounds: int) -> None:
    """Measure each case in turn, ``rounds`` times, after a call each without looking at the clock."""
    for case in cases:
        case.call()
    gc.collect()
    for index in range(rounds):
        for case in cases:
            if index % case.every == 0:
                case.measure()


def percentiles(ms: Iterable[float]) -> dict[str, Any]:
    """Return the median and the 99th percentile of some times, and their ratio."""
    p50, p99 = (float(v) for v in np.percentile(np.array(list(ms)), (50, 99)))
    return {
        "p50": round(p50, 4),
        "p99": round(p99, 4),
        "p99_over_p50": round(p99 / p50, 3) if p50 > 0 else None,
    }
