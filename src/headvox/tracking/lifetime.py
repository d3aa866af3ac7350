"""How long a track lives: for as long as its head is seen, and then by what the sensors see of its place."""

from __future__ import annotations

import numpy as np

from headvox.machine.kernels import kernel
from headvox.visibility import BEHIND, OUT_OF_VIEW

WEAK = 1.5  # times that a track trusts weak heads longer than none
MISS = 0.5  # of a sighting: what speaks against a new head
MOST_DRAIN = 0.5  # of its life a track loses in one frame, however long: one miss never ends it


@kernel
def turn_page(roster, stamp_ns, longest_ns, frames, kept):
    """Begin a frame: no hit in it yet, of so many ``frames`` that are remembered.

    Write which rows are not forgotten, seen ``longest_ns`` ago at most; return whether all are ``kept`` (N,).
    """
    for n in range(roster.shape[0]):
        row = roster[n]
        row.hits = row.hits << 1 & (1 << frames) - 1
        kept[n] = stamp_ns - row.seen_ns <= longest_ns
    return kept.all()


@kernel
def age(roster, now_ns, dt, states, lasts_s, present_s, weak_s):
    """Let every track that was not surely seen at ``now_ns`` lose life and trust; mark the dead as lost.

    ``states`` (N,) says what was seen of the places of those that were not seen at all, ``lasts_s`` (5,) how long a
    track lives in each state. One that is missed in plain view loses trust as fast as sure and strong sightings give it
    back, ``present_s`` for the whole of it. One that only weak heads are found for lasts ``weak_s``, and loses trust
    ``WEAK`` times slower.
    """
    for n in range(states.shape[0]):
        row = roster[n]
        if row.lost:
            continue
        life_s, trust_s = np.inf, np.inf
        row.absent = row.absent and row.seen_ns != now_ns
        if row.seen_ns != now_ns:
            life_s = lasts_s[states[n]]
            if states[n] != OUT_OF_VIEW and states[n] != BEHIND:
                trust_s = present_s
        elif row.hits & 1 == 0:
            life_s, trust_s = weak_s, WEAK * present_s
        else:
            row.life = 1.0
            row.trust = min(row.trust + dt / present_s * min(row.strength, 1.0), 1.0)
        row.life -= min(dt / life_s, MOST_DRAIN)
        row.trust -= min(dt / trust_s, MOST_DRAIN)
        row.lost = min(row.life, row.trust) <= 0.0


@kernel
def judge_new(roster, least, frames, ready, kept):
    """Write which tracks without an id (N,) get one, and which are not given up.

    It takes ``least`` sightings within ``frames`` frames, as many more as make up for what they score less, and one for
    every two misses since the first of them; or one in each of these frames. Return whether any is ``ready`` and
    whether all are ``kept``.
    """
    for n in range(ready.shape[0]):
        hits, times, misses = roster[n].hits, 0, 0
        while hits > 0:
            times += hits & 1
            misses += 1 - (hits & 1)
            hits >>= 1
        new = roster[n].id == 0
        kept[n] = not new or (times > 0 and not roster[n].lost)
        ready[n] = (
            new and kept[n] and (times * roster[n].strength - MISS * misses >= least or times == frames)
        )
    return ready.any(), kept.all()
