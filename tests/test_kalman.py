"""The compiled filters, held equal to plain matrix algebra, and one step worked out by hand."""

from __future__ import annotations

import naive_kalman as naive
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from headvox.config import TrackerConfig
from headvox.tracking import kalman
from headvox.tracking.roster import blank
from headvox.tracking.tracker import TURN_FADE_S

TIGHT = {"rtol": 1e-9, "atol": 1e-12}
PLACE_NOISE, TURN_NOISE = np.array([0.8, 0.7, 0.1]), np.array([3.0, 2.0, 4.0])
FADE_S = np.array([2.0, 2.0, 0.3])
TURN_DENSITY = np.radians(TrackerConfig().turn_change_deg_s) ** 2
FOREVER_S = 1e6
ONE = np.zeros(1, np.int64)
SEEN, UNSEEN = 0, 1  # at the stamp before: rows are blank, so seen at 0


def covariance(rng, size, scale=0.1):
    A = rng.normal(size=(size, size)) * scale
    return A @ A.T + 1e-4 * np.eye(size)


def some_tracks(rng, count=5):
    roster = blank(count)
    for n in range(count):
        roster["x"][n] = rng.normal(size=(2, 6))
        roster["P"][n] = [covariance(rng, 6), covariance(rng, 6)]
        roster["weights"][n] = rng.dirichlet((1, 1))
        roster["q"][n] = Rotation.from_rotvec(rng.normal(size=3)).as_quat()
        roster["rate"][n] = rng.normal(size=3)
        roster["C"][n] = covariance(rng, 6)
    return roster


@pytest.mark.parametrize("dt", [1e-9, 1 / 30, 0.5, 4.0])
def test_prediction_equals_matrix_algebra(dt):
    rng = np.random.default_rng(int(dt * 100))
    now = some_tracks(rng)
    seen = np.array([True, False, True, False, True])
    now["seen_ns"] = np.where(seen, SEEN, UNSEEN)
    was = now.copy()
    motion = dt, 1.0, 2.0, 1e-6, PLACE_NOISE, FADE_S
    kalman.predict_places(now, SEEN, *motion)
    kalman.predict_turns(now, dt, TURN_NOISE, TURN_FADE_S)
    for n in range(len(now)):
        x, P, weight = naive.predict_place(
            was["x"][n], was["P"][n], was["weights"][n], seen[n], *motion, kalman.STILL_SPEED_M_S
        )
        np.testing.assert_allclose(now["x"][n], x, **TIGHT)
        np.testing.assert_allclose(now["P"][n], P, **TIGHT)
        np.testing.assert_allclose(now["weights"][n], weight, **TIGHT)
        q, rate, C = naive.predict_turn(was["q"][n], was["rate"][n], was["C"][n], dt, TURN_NOISE, TURN_FADE_S)
        np.testing.assert_allclose(now["rate"][n], rate, **TIGHT)
        np.testing.assert_allclose(now["q"][n] * np.sign(now["q"][n] @ q), q, **TIGHT)
        np.testing.assert_allclose(now["C"][n], C, **TIGHT)
    np.testing.assert_array_equal(now["P"], np.swapaxes(now["P"], 2, 3))


def test_correction_equals_matrix_algebra():
    rng = np.random.default_rng(5)
    now = some_tracks(rng)
    was = now.copy()
    heads, tracks = np.array([2, 0, 1]), np.array([4, 1, 2])
    centres = was["x"][tracks, 0, :3][np.argsort(heads)] + rng.normal(size=(3, 3)) * 0.1
    measured = np.empty((3, 4))
    for track, head in zip(tracks, heads, strict=True):
        near = Rotation.from_quat(was["q"][track]) * Rotation.from_rotvec(rng.normal(size=3) * 0.2)
        measured[head] = near.as_quat()
    R = np.array([covariance(rng, 3) for _ in range(3)])
    kalman.correct_places(now, tracks, heads, centres, R)
    kalman.correct_turns(now, tracks, heads, measured, R, np.inf)
    for n, head in zip(tracks, heads, strict=True):
        x, P, weight = naive.correct_place(
            was["x"][n], was["P"][n], was["weights"][n], centres[head], R[head]
        )
        np.testing.assert_allclose(now["x"][n], x, **TIGHT)
        np.testing.assert_allclose(now["P"][n], P, **TIGHT)
        np.testing.assert_allclose(now["weights"][n], weight, rtol=1e-6, atol=2 * kalman.LEAST_WEIGHT)
        q, rate, C, _ = naive.correct_turn(was["q"][n], was["rate"][n], was["C"][n], measured[head], R[head])
        np.testing.assert_allclose(now["q"][n] * np.sign(now["q"][n] @ q), q, **TIGHT)
        np.testing.assert_allclose(now["rate"][n], rate, **TIGHT)
        np.testing.assert_allclose(now["C"][n], C, **TIGHT)
        np.testing.assert_array_equal(now["P"][n], np.swapaxes(now["P"][n], 1, 2))
    for name in now.dtype.names:
        np.testing.assert_array_equal(now[name][[0, 3]], was[name][[0, 3]])


def test_models_combine_as_a_mixture_and_distances_are_mahalanobis():
    rng = np.random.default_rng(6)
    roster = some_tracks(rng, 4)
    mean, cov = np.empty((4, 6)), np.empty((4, 6, 6))
    for n in range(4):
        kalman.combine(roster[n], mean[n], cov[n])
        assert kalman.widest(cov[n]) == pytest.approx(np.sqrt(np.trace(cov[n, :3, :3])))
    centres, R = rng.normal(size=(3, 3)), np.array([covariance(rng, 3) for _ in range(3)])
    squared, surprise = np.empty((2, 4, 3))
    kalman.compare(roster, mean, cov, centres, R, squared, surprise)
    for n in range(4):
        row = roster["x"][n], roster["P"][n], roster["weights"][n]
        m, C = naive.mixture(row[2], row[0], row[1])
        np.testing.assert_allclose(mean[n], m, **TIGHT)
        np.testing.assert_allclose(cov[n], C, **TIGHT)
        for k in range(3):
            d = centres[k] - m[:3]
            assert squared[n, k] == pytest.approx(d @ np.linalg.solve(C[:3, :3] + R[k], d))
            assert surprise[n, k] == pytest.approx(naive.surprise(*row, centres[k], R[k]))


def test_a_step_worked_out_by_hand():
    """One axis of a moving head: variances 1 and 4 of place and speed, no covariance, half a second, q = 12.

    P_place = 1 + 0.25 * 4 + 12 * 0.125 / 3 = 2.5, P_place_speed = 0.5 * 4 + 12 * 0.25 / 2 = 3.5,
    P_speed = 4 + 12 * 0.5 = 10. A place measured 7 ahead with variance 4.5: S = 7, K = (2.5, 3.5) / 7,
    so the place moves on by 2.5 and the speed by 3.5; P = (2.5 - 6.25 / 7, 3.5 - 8.75 / 7, 10 - 12.25 / 7).
    """
    roster = blank(1)
    roster["P"][:] = np.diag([1.0, 1, 1, 4, 4, 4])
    roster["x"][0, :, 3] = 2.0
    roster["weights"][:] = (kalman.LEAST_WEIGHT, 1.0 - kalman.LEAST_WEIGHT)
    never = 1e12  # no change of model
    kalman.predict_places(roster, SEEN, 0.5, never, never, 0.0, np.full(3, 12.0), FADE_S)
    x, P = roster["x"][0, kalman.MOVING], roster["P"][0, kalman.MOVING]
    np.testing.assert_allclose(x, [1, 0, 0, 2, 0, 0], atol=1e-6)
    np.testing.assert_allclose([P[0, 0], P[0, 3], P[3, 3]], [2.5, 3.5, 10.0])
    R = 4.5 * np.eye(3)[None]
    kalman.correct_places(roster, ONE, ONE, np.array([[8.0, 0, 0]]), R)
    np.testing.assert_allclose(x, [3.5, 0, 0, 5.5, 0, 0], atol=1e-9)
    np.testing.assert_allclose([P[0, 0], P[0, 3], P[3, 3]], [2.5 - 6.25 / 7, 3.5 - 8.75 / 7, 10 - 12.25 / 7])


def test_a_head_at_rest_is_told_from_one_that_walks():
    for speed, model in ((0.0, kalman.STILL), (0.8, kalman.MOVING)):
        rng = np.random.default_rng(1)
        roster = blank(1)
        roster["P"][:], roster["weights"][:] = np.eye(6) * 0.1, 0.5
        for k in range(1, 30):
            kalman.predict_places(roster, SEEN, 0.1, 1.0, 2.0, 1e-6, np.ones(3), FADE_S)
            seen = np.array([[speed * 0.1 * k, 0.0, 1.6]]) + 0.01 * rng.normal(size=(1, 3))
            kalman.correct_places(roster, ONE, ONE, seen, 1e-4 * np.eye(3)[None])
        assert roster["weights"][0, model] > 0.9
        assert roster["x"][0, kalman.MOVING, 3] == pytest.approx(speed, abs=0.15)


def test_what_is_not_seen_stays_where_it_was_or_goes_on_ever_slower():
    roster = blank(1)
    roster["P"][:], roster["weights"][:] = np.eye(6) * 1e-4, 0.5
    roster["x"][0, :, 3] = 1.0
    for _ in range(30):
        kalman.predict_places(roster, UNSEEN, 0.1, 1.0, 2.0, 1e-6, np.ones(3), FADE_S)
    assert roster["weights"][0, kalman.STILL] == pytest.approx(0.5 * np.exp(-3.0))
    assert roster["x"][0, kalman.STILL, 0] == 0.0
    assert roster["P"][0, kalman.STILL, 0, 0] == pytest.approx(1e-4 + 3e-6)
    # what set off along the way came from rest, so less than the whole way
    assert 0.1 < roster["x"][0, kalman.MOVING, 0] < FADE_S[0] * (1.0 - np.exp(-3.0 / FADE_S[0]))


def follow_turns(orientations, fade_s=TURN_FADE_S, gate=16.3, sigma=0.1, dt=0.1):
    roster = blank(1)
    roster["q"][:] = np.nan
    for q in orientations:
        kalman.predict_turns(roster, dt, np.full(3, TURN_DENSITY), fade_s)
        kalman.correct_turns(roster, ONE, ONE, q[None], sigma**2 * np.eye(3)[None], gate)
    return roster


def yaws(degrees):
    return Rotation.from_rotvec(np.radians(degrees)[:, None] * [0.0, 0.0, 1.0]).as_quat()


def yaw_of(row):
    """Return the yaw of a roster's only row, degrees from -180."""
    return Rotation.from_quat(row["q"][0]).as_euler("ZYX", degrees=True)[0]


def test_orientation_begins_when_it_is_known_and_follows_a_turn():
    unknown = np.full((3, 4), np.nan)
    assert np.isnan(follow_turns(unknown)["q"]).all()
    turning = yaws(np.arange(0.0, 240.0, 6.0))  # 60 degrees a second, past where quaternions change sign
    path = np.concatenate([unknown, turning, unknown[:1]])
    row = follow_turns(path, fade_s=FOREVER_S)
    # foretold by a tenth of a second
    assert (yaw_of(row) - 240.0 + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=2.0)
    assert np.degrees(row["rate"][0]) == pytest.approx([0.0, 0.0, 60.0], abs=3.0)
    row = follow_turns(path)  # and a little behind, where turns are taken to fade
    assert -5.0 < (yaw_of(row) - 240.0 + 180.0) % 360.0 - 180.0 < 0.0
    assert 30.0 < np.degrees(row["rate"][0, 2]) < 60.0


def test_a_track_that_was_led_astray_is_put_right_and_does_not_spin():
    astray = np.cumsum([0.0, 5, 20, 10, 20, 30, 20, 20, 20, 40, 10])
    path = yaws(np.concatenate([astray, np.zeros(24)]))
    right = [abs(yaw_of(follow_turns(path[: len(astray) + k]))) < 10.0 for k in range(1, 25)]
    assert right == [False] * (kalman.REJECTED_BEFORE_RESET - 1) + [True] * (
        25 - kalman.REJECTED_BEFORE_RESET
    )
    spinning = follow_turns(path, fade_s=FOREVER_S)  # what happens where a turn does not fade
    assert np.degrees(spinning["rate"][0, 2]) == pytest.approx(1200.0, abs=10.0)


def test_a_flip_is_left_out_and_believed_when_it_stays():
    flipped = [0.0] * 10 + [180.0] * (kalman.REJECTED_BEFORE_RESET - 1)
    row = follow_turns(yaws(np.array(flipped)))
    assert Rotation.from_quat(row["q"][0]).magnitude() < 0.01
    assert row["rejected"][0] == kalman.REJECTED_BEFORE_RESET - 1
    row = follow_turns(yaws(np.array([*flipped, 180.0])))
    assert Rotation.from_quat(row["q"][0]).magnitude() == pytest.approx(np.pi, abs=0.01)
    assert row["rejected"][0] == 0
