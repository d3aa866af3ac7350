import math

import numpy as np
import pytest

from headvox.ros.synchronise import Reading, Synchroniser

MS = 1_000_000


def make(tolerance_ms=20, wait_s=0.05, timeout_s=0.5):
    return Synchroniser(tolerance_ms * MS, wait_s, timeout_s)


def reading(sensor, stamp_ms, arrived_s=None):
    stamp_ms = float(stamp_ms)
    return Reading(sensor, round(stamp_ms * MS), stamp_ms / 1e3 if arrived_s is None else arrived_s, None)


def play(synchroniser, readings):
    """Feed readings in the order of their arrival; return the sets as (sensor, ms) and when each was given."""
    sets = []
    for one in sorted(readings, key=lambda r: r.arrived_s):
        while synchroniser.next_s() <= one.arrived_s:
            now = synchroniser.next_s()
            sets += [(now, s) for s in synchroniser.ready(now)]
        sets += [(one.arrived_s, s) for s in synchroniser.add(one)]
    while (now := synchroniser.next_s()) < math.inf:
        sets += [(now, s) for s in synchroniser.ready(now)]
    return [(now, [(r.sensor, r.stamp_ns / MS) for r in s]) for now, s in sets]


def test_one_sensor_never_waits():
    sets = play(make(), [reading("a", t) for t in (0, 33, 66)])
    assert sets == [(t / 1e3, [("a", t)]) for t in (0, 33, 66)]


def test_two_sensors_come_in_pairs_at_once():
    sets = play(
        make(), [reading(s, t + shift) for t in (100, 200, 300) for s, shift in (("a", 0), ("b", 12))]
    )
    # nobody knows of b when a sends its first
    assert [s for _, s in sets] == [
        [("a", 100)],
        [("b", 112)],
        [("a", 200), ("b", 212)],
        [("a", 300), ("b", 312)],
    ]
    assert [now for now, _ in sets][2:] == [0.212, 0.312]


def test_stamps_farther_apart_than_the_tolerance_are_two_frames():
    sets = play(
        make(tolerance_ms=20),
        [reading(s, t + shift) for t in range(0, 500, 100) for s, shift in (("a", 0), ("b", 45))],
    )
    assert all(len(s) == 1 for _, s in sets)
    assert len(sets) == 10
    # b's settles a's; no reading waits longer than it must
    assert max(now - s[0][1] / 1e3 for now, s in sets) <= 0.055


def test_a_camera_that_stops_is_waited_for_until_it_counts_as_gone():
    a = [reading("a", t) for t in range(0, 3000, 100)]
    b = [reading("b", t, t / 1e3 + 0.001) for t in (*range(0, 1000, 100), *range(2000, 3000, 100))]
    sets = {s[0][1]: (now, s) for now, s in play(make(), [*a, *b])}
    assert len(sets[900.0][1]) == 2
    for stamp in range(1000, 1500, 100):  # alive still: waited for
        now, alone = sets[float(stamp)]
        assert alone == [("a", stamp)]
        assert now == pytest.approx(stamp / 1e3 + 0.05)
    for stamp in range(1500, 2000, 100):  # gone
        assert sets[float(stamp)][0] == stamp / 1e3
    assert all(len(sets[float(stamp)][1]) == 2 for stamp in range(2100, 3000, 100))


def test_a_sensor_that_arrives_later_than_the_next_frame_of_the_other_is_still_paired():
    a = [reading("a", t) for t in range(0, 1000, 30)]
    b = [reading("b", t, t / 1e3 + 0.04) for t in range(0, 1000, 30)]
    sets = [s for _, s in play(make(tolerance_ms=10, wait_s=0.1), [*a, *b])]
    assert sum(len(s) == 2 for s in sets) >= 31


def test_late_and_repeated_readings_are_counted_and_dropped():
    synchroniser = make()
    assert len(synchroniser.add(reading("a", 100))) == 1
    assert synchroniser.add(reading("a", 100, 0.2)) == []
    assert synchroniser.add(reading("a", 90, 0.3)) == []
    assert synchroniser.add(reading("b", 50, 0.3)) == []
    assert synchroniser.late == 3


def test_time_that_jumps_back_begins_anew():
    synchroniser = make()
    play(synchroniser, [reading("a", 60_000), reading("b", 60_005)])
    assert synchroniser.add(reading("a", 10, 61.0)) != []
    assert synchroniser.jumps == 1
    assert synchroniser.alive(61.0) == {"a"}
    synchroniser.add(reading("a", 110, 61.1))
    assert synchroniser.jumps == 1


@pytest.mark.parametrize("seed", range(40))
def test_whatever_comes_every_reading_is_given_at_most_once_and_in_order(seed):
    rng = np.random.default_rng(seed)
    readings = []
    for sensor in "abc"[: int(rng.integers(1, 4))]:
        period, phase, jitter = rng.uniform(20, 120), rng.uniform(0, 100), rng.uniform(0, 15)
        stamps = np.cumsum(np.maximum(rng.normal(period, jitter, 60), 1.0)) + phase
        stamps = stamps[rng.random(60) > 0.2]
        arrivals = np.maximum.accumulate(stamps / 1e3 + rng.exponential(0.02, len(stamps)))
        readings += [reading(sensor, t, at) for t, at in zip(stamps, arrivals, strict=True)]
    synchroniser = make()
    sets = play(synchroniser, readings)
    given = [one for _, s in sets for one in s]
    assert len(given) == len(set(given))
    assert len(given) + synchroniser.late == len(readings)
    firsts = [min(t for _, t in s) for _, s in sets]
    assert firsts == sorted(firsts)
    arrived = {(r.sensor, r.stamp_ns / MS): r.arrived_s for r in readings}
    for now, s in sets:
        assert len({sensor for sensor, _ in s}) == len(s)
        stamps = [t for _, t in s]
        assert max(stamps) - min(stamps) <= 20
        assert now - min(arrived[one] for one in s) <= 0.05 + 1e-9


def test_a_sensor_that_is_expected_is_waited_for_from_the_start():
    def first_sets(expected):
        one = Synchroniser(20_000_000, 0.5, 2.0, frozenset(expected))
        sets = one.add(Reading("a", 1_000_000_000, 5.0, None))
        return sets + one.add(Reading("b", 1_001_000_000, 5.01, None)), one.late

    assert [[r.sensor for r in readings] for readings in first_sets("ab")[0]] == [["a", "b"]]
    assert first_sets("ab")[1] == 0
    assert [[r.sensor for r in readings] for readings in first_sets("")[0]] == [["a"]]
    silent = Synchroniser(20_000_000, 9.0, 2.0, frozenset("ab"))
    given = [len(silent.add(Reading("a", k * 500_000_000, 0.5 * k, None))) for k in range(1, 8)]
    assert given == [0, 0, 0, 0, 0, 6, 1]  # b never comes: after two seconds nobody waits for it


def test_what_waits_is_bounded():
    one = Synchroniser(20_000_000, 1e9, 1e9, frozenset("ab"), most_open=3)
    given = [len(one.add(Reading("a", k * 50_000_000, 0.0, None))) for k in range(10)]
    assert given == [0, 0, 0, 1, 1, 1, 1, 1, 1, 1]
