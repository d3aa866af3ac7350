"""How long a track lives: for as long as its head is seen, and then by what the sensors see of its place."""

from __future__ import annotations

import numpy as np

from headvox.kernels import kernel
from headvox.visibility import BEHIND, OUT_OF_VIEW

MOST_DRAIN = 0.5  # of its life a track loses in one frame, however long: one miss never ends it


@kernel
def age(roster, now_ns, dt, states, lasts_s, missed_s, weak_s):  # type: ignore[no-untyped-def]
    """Let every track that was not surely seen at ``now_ns`` lose life and trust; mark the dead as lost.

    ``states`` (N,) says what was seen of the places of those that were not seen at all, ``lasts_s`` (5,) how long a
    track lives in each state. One that is missed in plain view loses trust as fast as a sure sighting gives it back,
    ``missed_s`` for the whole of it. One that only weak heads are found for lasts ``weak_s``.
    """
    for n in range(states.shape[0]):
        if roster.lost[n]:
            continue
        life_s, trust_s = np.inf, np.inf
        if roster.seen_ns[n] != now_ns:
            life_s = lasts_s[states[n]]
            if states[n] != OUT_OF_VIEW and states[n] != BEHIND:
                trust_s = missed_s
        elif roster.hits[n] & 1 == 0:
            life_s = trust_s = weak_s
        else:
            roster.life[n] = 1.0
            roster.trust[n] = min(roster.trust[n] + dt / missed_s, 1.0)
        roster.life[n] -= min(dt / life_s, MOST_DRAIN)
        roster.trust[n] -= min(dt / trust_s, MOST_DRAIN)
        roster.lost[n] = min(roster.life[n], roster.trust[n]) <= 0.0


@kernel
def judge_new(roster, least, ready, kept):  # type: ignore[no-untyped-def]
    """Write which tracks without an id (N,) were seen ``least`` times and get one, and which are not given up."""
    for n in range(ready.shape[0]):
        hits, times = roster.hits[n], 0
        while hits > 0:
            times += hits & 1
            hits >>= 1
        new = roster.ids[n] == 0
        kept[n] = not new or (times > 0 and not roster.lost[n])
        ready[n] = new and kept[n] and times >= least
