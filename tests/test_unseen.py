"""Where heads may be that were not found: the compiled loops held equal to plain ones, and what they are for."""

from __future__ import annotations

import naive_kalman as kalman
import naive_unseen as naive
import numpy as np
import pytest
import scenes

from headvox.data import DepthImage, Frame, Heads, Intrinsics
from headvox.tracking import unseen
from headvox.tracking.roster import blank
from headvox.tracking.tracker import Tracker
from headvox.visibility import BEHIND, OUT_OF_VIEW, SEEN_EMPTY, SURFACE

CAMERA = Intrinsics(160, 120, 120.0, 120.0, 79.5, 59.5)
LOOKING = scenes.looking_along_x(0.0, 0.0, 1.6)


def some_missed(rng, count=6):
    """Tracks about one metre, whose models agree by some centimetres; some are tentative."""
    roster = blank(count)
    for n in range(count):
        roster["x"][n, :, :3] = rng.uniform(0.0, 0.6, 3) + rng.normal(0.0, 0.03, (2, 3))
        roster["x"][n, :, 3:] = rng.normal(0.0, 0.5, (2, 3))
        A = rng.normal(size=(2, 6, 6)) * rng.choice([0.02, 0.1])
        roster["P"][n] = A @ A.transpose(0, 2, 1) + 1e-4 * np.eye(6)
        roster["weights"][n] = rng.dirichlet((1, 1))
    roster["id"][:] = rng.integers(0, 2, count) * np.arange(1, count + 1)
    return roster


@pytest.mark.parametrize("seed", range(8))
def test_samples_weights_and_moments_equal_the_plain_ones(seed) -> None:
    rng = np.random.default_rng(seed)
    roster = some_missed(rng)
    rows = np.array([0, 2, 3, 5])
    places, weights = np.empty((4, unseen.SAMPLES, 3)), np.empty((4, unseen.SAMPLES))
    unseen.spread(roster, rows, places)
    for k, n in enumerate(rows):
        np.testing.assert_allclose(places[k], naive.spread(roster["x"][n], roster["P"][n]), atol=1e-12)

    seen = rng.integers(OUT_OF_VIEW, SEEN_EMPTY + 1, weights.shape)
    seen[0] = SEEN_EMPTY if seed % 2 else seen[0]
    centres = rng.uniform(0.0, 0.6, (seed % 3, 3))
    unseen.weigh(roster, rows, places, seen, centres, weights)
    np.testing.assert_allclose(weights, naive.weigh(roster, rows, places, seen, centres), rtol=1e-9)

    before, states = roster.copy(), np.empty(4, np.int64)
    unseen.narrow(roster, rows, weights)
    for k, n in enumerate(rows):
        shares = weights[k].reshape(2, -1)
        for i in range(2):
            x, P = naive.narrow(before["x"][n, i], before["P"][n, i], shares[i])
            np.testing.assert_allclose(roster["x"][n, i], x, rtol=1e-7, atol=1e-10)
            np.testing.assert_allclose(roster["P"][n, i], P, rtol=1e-7, atol=1e-10)
            np.testing.assert_array_equal(roster["P"][n, i], roster["P"][n, i].T)
            assert np.linalg.eigvalsh(roster["P"][n, i]).min() > 0.0
        np.testing.assert_allclose(roster["weights"][n], shares.sum(axis=1) / shares.sum())
    for name in ("x", "P", "weights"):
        np.testing.assert_array_equal(roster[name][[1, 4]], before[name][[1, 4]])

    unseen.conclude(roster, rows, places, seen, weights, states)
    for k, n in enumerate(rows):
        mean, _ = kalman.mixture(roster["weights"][n], roster["x"][n], roster["P"][n])
        expected = naive.conclude(mean, places[k], seen[k], weights[k])
        assert (states[k], roster["absent"][n]) == expected


def test_without_evidence_nothing_changes() -> None:
    roster = some_missed(np.random.default_rng(20), 1)
    before, rows = roster.copy(), np.zeros(1, np.int64)
    states = unseen.search(roster, rows, Frame(0), 5.0, np.empty((0, 3)))
    for name in ("x", "P", "weights"):
        np.testing.assert_allclose(roster[name], before[name], rtol=1e-9, atol=1e-12)
    assert states[0] < SURFACE
    assert not roster["absent"][0]


def at_the_origin(sigma_m: float):
    """One confirmed track that expects its head at (2.0, 0.0, 1.6), known to ``sigma_m`` along the floor."""
    roster = blank(1)
    roster["id"], roster["weights"] = 1, 0.5
    roster["x"][:, :, :3] = 2.0, 0.0, 1.6
    roster["P"] = np.diag([sigma_m**2, sigma_m**2, 1e-4, 0.1, 0.1, 0.1])
    return roster


def room_with(*heads) -> DepthImage:
    """A wall 4 m away, and of each of the ``heads`` what is within 10 cm of it in the image, at its distance."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    depth = np.full(u.shape, 4000, np.uint16)
    for x, y, z in heads:
        column, row = CAMERA.cx - CAMERA.fx * y / x, CAMERA.cy - CAMERA.fy * (z - 1.6) / x
        depth[np.hypot(u - column, v - row) < 0.1 * CAMERA.fx / x] = round(1000 * (x - 0.05))
    return DepthImage("front", depth, CAMERA, LOOKING)


def search(roster, image: DepthImage, *found):
    centres = np.array(found, np.float64).reshape(-1, 3)
    return unseen.search(roster, np.zeros(1, np.int64), Frame(0, depths=(image,)), 5.0, centres)[0]


def test_a_missed_head_is_where_something_is_and_not_where_it_was_expected() -> None:
    roster = at_the_origin(0.2)
    assert search(roster, room_with((2.0, 0.3, 1.6))) == SURFACE
    for place in roster["x"][0, :, :2]:
        np.testing.assert_allclose(place, [2.0, 0.3], atol=0.1)
    assert (roster["P"][0, :, 1, 1] < 0.15**2).all()
    assert not roster["absent"][0]


def test_where_another_head_was_found_it_is_not() -> None:
    """Two surfaces at the same distance to both sides; the head of one of them was found."""
    image, offsets = room_with((2.0, 0.25, 1.6), (2.0, -0.25, 1.6)), []
    for found in ([(2.0, 0.25, 1.6)], [], [(2.0, -0.25, 1.6)]):
        roster = at_the_origin(0.2)
        assert search(roster, image, *found) == SURFACE
        offsets.append(roster["x"][0, :, 1])
    assert (offsets[0] < -0.05).all()
    np.testing.assert_allclose(offsets[1], 0.0, atol=0.02)
    assert (offsets[2] > 0.05).all()


def test_where_everything_is_empty_there_is_nobody() -> None:
    assert search(at_the_origin(0.05), room_with()) == SEEN_EMPTY
    assert search(at_the_origin(0.2), room_with()) == SEEN_EMPTY
    # What may be anywhere in a room may be behind a wall a metre away, too.
    wall = DepthImage("front", np.full((120, 160), 1000, np.uint16), CAMERA, LOOKING)
    assert search(at_the_origin(0.2), wall) == BEHIND


def test_who_walks_on_unfound_is_followed_by_what_is_seen_there() -> None:
    """Found for a second, then missed for one and a half, in which it turns off to the side by half a metre."""
    tracker, errors = Tracker(), []
    for k in range(26):
        turned = max(k - 10, 0)
        place = np.array([1.8 + 0.04 * turned, -0.9 + 0.06 * min(k, 10) + 0.02 * turned, 1.6])
        n = 1 if k <= 10 else 0
        heads = Heads(
            place[None][:n], np.full((n, 4), np.nan), np.full(n, 0.1), np.full(n, 5.0), sure=np.ones(n, np.bool_)
        )  # fmt: skip
        tracks = tracker.update(heads, Frame(k * 100_000_000, depths=(room_with(place),)))
        if 1 <= k <= 20:
            assert tracks.ids.tolist() == [1]
            errors.append(np.linalg.norm(tracks.centres[0] - place))
    assert max(errors) < 0.3
