"""Who is who: the compiled loops about a roster of tracks, held equal to plain ones, and what they are for."""

from __future__ import annotations

import naive_track as naive
import numpy as np
import pytest

from headvox.tracking import identity, noise
from headvox.tracking.lifetime import age, judge_new, turn_page
from headvox.tracking.roster import blank
from headvox.visibility import OUT_OF_VIEW, SEEN_EMPTY

NOW_NS, BEFORE_NS = 10_000_000_000, 9_900_000_000


def some_tracks(rng, count=12):
    """Tracks about one metre: seen just now, missed, lost, tentative."""
    roster = blank(count)
    for n in range(count):
        place = rng.uniform(0.0, 0.6, 3)
        roster["x"][n, :, :3] = place + rng.normal(0.0, 0.03, (2, 3))
        A = rng.normal(size=(2, 6, 6)) * rng.choice([0.02, 0.1])
        roster["P"][n] = A @ A.transpose(0, 2, 1) + 1e-4 * np.eye(6)
        roster["weights"][n] = rng.dirichlet((1, 1))
        roster["place"][n] = place
        roster["height"][n] = place[2] + rng.normal(0.0, 0.03)
    roster["id"][:] = rng.integers(0, 2, count) * np.arange(1, count + 1)
    roster["lost"][:] = (roster["id"] > 0) & (rng.random(count) < 0.4)
    roster["sightings"][:] = rng.integers(1, 31, count)
    roster["seen_ns"][:] = BEFORE_NS - rng.integers(0, 2, count) * rng.integers(1, 5_000_000_000, count)
    return roster


@pytest.mark.parametrize("seed", range(20))
def test_the_price_of_a_pair_equals_the_plain_one(seed):
    rng = np.random.default_rng(seed)
    roster = some_tracks(rng)
    heads = 8
    centres = roster["x"][rng.integers(0, len(roster), heads), 0, :3] + rng.normal(0.0, 0.05, (heads, 3))
    A = rng.normal(size=(heads, 3, 3)) * 0.01
    R = A @ A.transpose(0, 2, 1) + 1e-5 * np.eye(3)
    sure = rng.random(heads) < 0.7
    costs = np.empty((len(roster), heads))
    identity.price(roster, centres, R, sure, 16.0, NOW_NS, costs)
    expected = naive.price(roster, centres, R, sure, 16.0, NOW_NS)
    np.testing.assert_allclose(costs, expected, rtol=1e-9, atol=1e-9)
    assert 0 < (costs < identity.NOT_A_PAIR).sum() < costs.size


def test_pairs_are_the_likeliest_as_a_whole():
    costs = np.array([[0.0, 1.0], [0.5, identity.NOT_A_PAIR], [9.0, identity.NOT_A_PAIR]])
    rows, columns = identity.pairs(costs)
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == [(0, 1), (1, 0)]
    assert len(identity.pairs(np.empty((0, 3)))[0]) == 0


def test_a_sighting_is_entered():
    roster = some_tracks(np.random.default_rng(3))
    roster["sightings"][4], roster["height"][4], roster["hits"][4] = 3, 1.6, 2
    centres = np.array([[9.0, 9, 9], [1.0, 2.0, 1.7]])
    roster["strength"][4] = 0.9
    heads = centres, np.array([0.1, 0.11]), np.array([1.0, 2.0]), np.array([True, True])
    identity.note_sightings(roster, np.array([4]), np.array([1]), NOW_NS, *heads, 4.0)
    assert roster["strength"][4] == pytest.approx(0.9 + (2.0 / 4.0 - 0.9) / 4)
    mean = roster["weights"][4] @ roster["x"][4]
    np.testing.assert_allclose(roster["place"][4], mean[:3])
    np.testing.assert_allclose(roster["velocity"][4], mean[3:])
    assert (roster["seen_ns"][4], roster["sightings"][4], roster["hits"][4]) == (NOW_NS, 4, 3)
    assert roster["height"][4] == pytest.approx(1.6 + 0.1 / 4)
    assert (roster["radius"][4], roster["score"][4]) == (0.11, 2.0)


def test_who_comes_back_is_told_by_way_and_height():
    """Two left at the same place, of different heights, and both are there again; and somebody who is neither."""
    roster = blank(5)
    roster["sightings"][:] = 30
    roster["height"][:] = 1.60, 1.75, 1.74, 1.61, 1.68
    roster["place"][:, :2] = (1.0, 1.0), (1.1, 1.0), (1.0, 1.2), (1.2, 1.2), (0.4, 0.5)
    roster["born_ns"][2:] = roster["seen_ns"][2:] = NOW_NS
    roster["seen_ns"][:2] = NOW_NS - 8_000_000_000
    new, known = identity.come_back(roster, np.array([2, 3, 4]), np.array([0, 1]))
    assert dict(zip(new.tolist(), known.tolist(), strict=True)) == {2: 1, 3: 0}
    roster["place"][:2, 0] = 4.0
    assert len(identity.come_back(roster, np.array([2, 3, 4]), np.array([0, 1]))[0]) == 0


# ------------------------------------------------------------------------------------------------------------- noise


def test_the_scatter_of_a_head_equals_the_plain_one_and_widens_what_is_stated():
    rng = np.random.default_rng(7)
    stamps_ns = np.cumsum(rng.choice([33, 40, 100, 400], 60)) * 1_000_000
    centres = np.cumsum(rng.normal(0.0, 0.02, (60, 3)), axis=0)
    roster, stated = blank(3), np.diag([1e-4, 2e-4, 3e-4])
    for k, now_ns in enumerate(stamps_ns.tolist()):
        R = np.stack([np.eye(3), stated])
        heads = np.stack([np.zeros(3), centres[k]])
        noise.widen(roster, np.array([2]), np.array([1]), now_ns, heads, R)
        np.testing.assert_allclose(
            R[1] - stated, naive.scatter_of(stamps_ns[: k + 1], centres[: k + 1]), rtol=1e-9, atol=1e-15
        )
        np.testing.assert_array_equal(R[0], np.eye(3))
    assert not roster["scatter"][:2].any()


def test_the_scatter_is_that_of_the_noise_and_not_of_the_way():
    rng, roster, sigma = np.random.default_rng(8), blank(1), np.array([0.03, 0.01, 0.005])
    one, found = np.zeros(1, np.int64), []
    for k in range(600):
        centre = np.array([[0.04 * k, 0.0, 1.6]]) + rng.normal(0.0, sigma, (1, 3))
        noise.widen(roster, one, one, k * 33_000_000, centre, np.zeros((1, 3, 3)))
        found.append(roster["scatter"][0].copy())
    np.testing.assert_allclose(np.sqrt(np.diag(np.mean(found[100:], axis=0))), sigma, rtol=0.15)


# ---------------------------------------------------------------------------------------------------------- lifetime


def test_ages_equal_the_plain_ones():
    rng = np.random.default_rng(9)
    lasts_s = np.array([0.5, 1.0, 3.0, np.inf, 0.3])
    roster = some_tracks(rng, 200)
    roster["life"][:], roster["trust"][:] = rng.uniform(0.1, 1.0, (2, 200))
    roster["strength"][:] = rng.uniform(0.2, 1.0, 200)
    roster["seen_ns"][::2] = NOW_NS
    roster["hits"][:] = rng.integers(0, 4, 200)
    states = rng.integers(OUT_OF_VIEW, SEEN_EMPTY + 1, 200)
    roster["absent"][:] = rng.random(200) < 0.5
    before = roster.copy()
    age(roster, NOW_NS, 0.1, states, lasts_s, 3.0, 2.0)
    for n in range(200):
        if before["lost"][n]:
            expected, lost = (before["life"][n], before["trust"][n]), True
        else:
            seen, sure = before["seen_ns"][n] == NOW_NS, before["hits"][n] & 1
            row = before["life"][n], before["trust"][n], before["strength"][n]
            expected = naive.age(*row, seen, sure, states[n], 0.1, lasts_s, 3.0, 2.0)
            assert roster["absent"][n] == (before["absent"][n] and not seen)
            lost = min(expected) <= 0.0
        assert (roster["life"][n], roster["trust"][n]) == pytest.approx(expected)
        assert roster["lost"][n] == lost
    assert before["lost"].sum() < roster["lost"].sum() < 200


def test_new_tracks_are_judged_by_their_hits_and_how_these_score():
    """Against two: hits by their strength, less half a hit for every miss since the first; or each of five frames."""
    judged = [
        # hits, strength, id, lost, ready, kept
        (0b11, 1.0, 0, False, True, True),
        (0b101, 1.0, 0, False, False, True),
        (0b101, 1.3, 0, False, True, True),
        (0b10101, 1.0, 0, False, True, True),
        (0b10001, 1.5, 0, False, False, True),
        (0b111, 0.6, 0, False, False, True),
        (0b11111, 0.3, 0, False, True, True),
        (0b11110, 0.3, 0, False, False, True),
        (0b111, 1.0, 0, True, False, False),
        (0, 1.0, 0, False, False, False),
        (0, 1.0, 7, True, False, True),
    ]
    roster = blank(len(judged))
    for name, column in zip(("hits", "strength", "id", "lost"), zip(*judged, strict=True), strict=False):
        roster[name] = column
    ready, kept = np.empty((2, len(judged)), np.bool_)
    assert judge_new(roster, 2, 5, ready, kept) == (True, False)
    assert ready.tolist() == [row[4] for row in judged]
    assert kept.tolist() == [row[5] for row in judged]


def test_a_page_is_turned():
    roster = blank(3)
    roster["hits"] = 0b10011, 0b01111, 0
    roster["seen_ns"] = NOW_NS - 5, NOW_NS - 6, NOW_NS
    kept = np.empty(3, np.bool_)
    assert not turn_page(roster, NOW_NS, 5, 5, kept)
    assert kept.tolist() == [True, False, True]
    assert roster["hits"].tolist() == [0b00110, 0b11110, 0]
    assert turn_page(roster, NOW_NS, 6, 5, kept)
