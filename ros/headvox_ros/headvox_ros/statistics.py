"""How a node is doing: rates, latencies and counts over the last seconds; nothing here imports ROS."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np

WINDOW_S = 5.0
MOST = 4096  # frames that are looked back over


@dataclass(slots=True)
class Statistics:
    """Counts since the start, and the frames of the last ``WINDOW_S`` seconds."""

    counts: Counter[str] = field(default_factory=Counter)
    reasons: dict[str, str] = field(default_factory=dict)
    """The last reason for each count that has one."""
    last_problem: str = ""
    _frames: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=MOST))

    def frame(self, done_s: float, latency_s: float) -> None:
        """Note a frame that was published ``latency_s`` after its last reading had arrived."""
        self.counts["frames"] += 1
        self._frames.append((done_s, latency_s))

    def problem(self, kind: str, reason: str, times: int = 1) -> None:
        """Count something that went wrong."""
        self.counts[kind] += times
        self.reasons[kind] = self.last_problem = reason

    def rate_hz(self, now_s: float) -> float:
        """Return how many frames a second were published lately."""
        self._look(now_s)
        return len(self._frames) / WINDOW_S

    def latency_ms(self, now_s: float) -> tuple[float, float] | None:
        """Return the median and the 99th percentile of the latency, if there was a frame lately."""
        self._look(now_s)
        if not self._frames:
            return None
        p50, p99 = np.percentile([1e3 * latency for _, latency in self._frames], [50, 99])
        return float(p50), float(p99)

    def _look(self, now_s: float) -> None:
        while self._frames and self._frames[0][0] < now_s - WINDOW_S:
            self._frames.popleft()
