"""How many messages were lost on the way, by the numbers that their publishers give them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

MOST_PUBLISHERS = 64  # those that are known at a time: what is held is bounded, whoever publishes


@dataclass(slots=True)
class Losses:
    """Finds the gaps in the numbers of each publisher's messages.

    Where the middleware tells no numbers, or not whose they are, there are none.
    """

    _last: dict[bytes, int] = field(default_factory=dict)
    """The last number of each publisher, those heard last at the end."""

    def before(self, info: Mapping[str, Any]) -> int:
        """Return how many messages were lost just before one, by what rclpy tells of it."""
        number: int | None = info.get("publication_sequence_number")
        publisher: bytes | None = (info.get("publisher_gid") or {}).get("data")
        if number is None or publisher is None:
            return 0
        last = self._last.pop(publisher, number - 1)
        self._last[publisher] = number
        if len(self._last) > MOST_PUBLISHERS:
            del self._last[next(iter(self._last))]
        return max(0, number - last - 1)
