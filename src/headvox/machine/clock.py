"""What each stage of a frame takes."""

from __future__ import annotations

import time


class Clock:
    """Writes to ``stage_ms`` how long each stage took, from the end of the one before it."""

    def __init__(self, stage_ms: dict[str, float]) -> None:
        self.stage_ms = stage_ms
        self.last = time.perf_counter()

    def done(self, stage: str) -> None:
        """End ``stage``."""
        now = time.perf_counter()
        self.stage_ms[stage] = 1e3 * (now - self.last)
        self.last = now
