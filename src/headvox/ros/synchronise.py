"""Readings of several sensors -> sets that belong to one moment, by their stamps."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

NS = 1_000_000_000
JUMP_BACK_NS = NS  # a sensor whose stamps go back by more than this is in a bag that began again


@dataclass(frozen=True, slots=True)
class Reading:
    """What one sensor sent: ``stamp_ns`` is the message's own, ``arrived_s`` a steady clock's."""

    sensor: str
    stamp_ns: int
    arrived_s: float
    message: Any


@dataclass(slots=True)
class _Open:
    """A set that may still get a reading."""

    readings: dict[str, Reading]
    opened_s: float

    def takes(self, reading: Reading, tolerance_ns: int) -> bool:
        stamps = [reading.stamp_ns, *(other.stamp_ns for other in self.readings.values())]
        return reading.sensor not in self.readings and max(stamps) - min(stamps) <= tolerance_ns

    def first_ns(self) -> int:
        return min(reading.stamp_ns for reading in self.readings.values())


@dataclass(slots=True)
class Synchroniser:
    """Puts readings together whose stamps differ by ``tolerance_ns`` at most.

    A set is given out as soon as every sensor that is alive is in it, or has sent something too late for it, and after
    ``wait_s`` in any case. A sensor is alive until nothing came from it for ``timeout_s``: others do not wait for it
    any more. Sets come in the order of their stamps. When a sensor's stamps jump back by more than a second everything
    is forgotten and ``jumps`` goes up.
    """

    tolerance_ns: int
    wait_s: float
    timeout_s: float
    expected: frozenset[str] = frozenset()
    """Sensors that are taken to be alive from the first reading on, before anything came from them."""
    most_open: int = 1000
    """Sets that may wait at a time: what is held is bounded, whatever the stamps are."""
    late: int = 0
    """Readings that came after a newer set had been given out."""
    jumps: int = 0
    _newest: dict[str, Reading] = field(default_factory=dict)
    _open: list[_Open] = field(default_factory=list)
    _given_ns: float = -math.inf
    _begun_s: float = math.inf

    def add(self, reading: Reading) -> list[list[Reading]]:
        """Take a reading in; return the sets that are ready by it, oldest first."""
        before = self._newest.get(reading.sensor)
        if before is not None and reading.stamp_ns < before.stamp_ns - JUMP_BACK_NS:
            self._forget()
        elif before is not None and reading.stamp_ns <= before.stamp_ns:
            self.late += 1
            return []
        self._newest[reading.sensor] = reading
        self._begun_s = min(self._begun_s, reading.arrived_s)
        if reading.stamp_ns <= self._given_ns:
            self.late += 1
            return []
        fitting = next((one for one in self._open if one.takes(reading, self.tolerance_ns)), None)
        if fitting is not None:
            fitting.readings[reading.sensor] = reading
        else:
            self._open.append(_Open({reading.sensor: reading}, reading.arrived_s))
            self._open.sort(key=_Open.first_ns)
        return self.ready(reading.arrived_s)

    def ready(self, now_s: float) -> list[list[Reading]]:
        """Return the sets that need not, or must not, wait any longer, oldest first."""
        sets = []
        while self._open and (self._is_settled(self._open[0], now_s) or self._is_overdue(now_s)):
            readings = self._open.pop(0).readings
            self._given_ns = max(reading.stamp_ns for reading in readings.values())
            sets.append([readings[name] for name in sorted(readings)])
        return sets

    def alive(self, now_s: float) -> set[str]:
        """Return the sensors that something came from lately."""
        heard = {name for name, last in self._newest.items() if now_s - last.arrived_s <= self.timeout_s}
        if now_s - self._begun_s <= self.timeout_s:
            return heard | (self.expected - self._newest.keys())
        return heard

    def next_s(self) -> float:
        """Return when :meth:`ready` should be called again at the latest, infinite when nothing waits."""
        return min((one.opened_s + self.wait_s for one in self._open), default=math.inf)

    def _is_settled(self, one: _Open, now_s: float) -> bool:
        last_ns = one.first_ns() + self.tolerance_ns
        return all(
            name in one.readings or (name in self._newest and self._newest[name].stamp_ns > last_ns)
            for name in self.alive(now_s)
        )

    def _is_overdue(self, now_s: float) -> bool:
        return self.next_s() <= now_s or len(self._open) > self.most_open

    def _forget(self) -> None:
        self.jumps += 1
        self._newest.clear()
        self._open.clear()
        self._given_ns = -math.inf
