"""Who a head is that is found again, and who it is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from walks import STANDING, at, follow, heads, walk

from headvox.data import Heads
from headvox.pipeline import Detector
from headvox.sources import open_source
from headvox.tracking.tracker import Tracker

FILINHA = Path(__file__).parents[1].parent / "shared" / "data" / "recordings" / "filinha"


# ----------------------------------------------------------------------------------------- who it is, and who it is not


def test_a_head_that_sets_off_at_once_is_still_the_one_that_stood_there() -> None:
    tracker = Tracker()
    follow(tracker, STANDING * 30)
    x, y, z = STANDING[0]
    tracks = follow(tracker, [None, (x + 0.17, y, z), (x + 0.3, y, z), (x + 0.42, y, z)], 30)
    assert tracks.ids.tolist() == [1]
    assert tracker.ids_given == 1


def test_a_hidden_head_does_not_become_a_taller_one() -> None:
    tracker = Tracker()
    follow(tracker, walk(20))
    follow(tracker, [None] * 6, 20)
    x, y, z = walk(1, 26)[0]
    for k in range(26, 29):
        tracks = tracker.update(heads((x, y, z + 0.3)), at(k))
    assert sorted(tracks.ids.tolist()) == [1, 2]


def test_of_two_who_stood_close_each_is_known_by_height() -> None:
    """Both are missed until their tracks end; then it is the smaller one that is seen first."""
    tracker, tall, small = Tracker(), (1.0, 0.5, 1.72), (1.0, 0.78, 1.6)
    for k in range(30):
        tracker.update(heads(tall, small), at(k))
    follow(tracker, [None] * 15, 30)
    assert follow(tracker, [small] * 5, 45).ids.tolist() == [2]
    for k in range(50, 55):
        tracks = tracker.update(heads(tall, small), at(k))
    assert tracks.ids.tolist() == [1, 2]
    np.testing.assert_allclose(tracks.centres, [tall, small], atol=0.02)


def test_something_far_away_for_a_moment_does_not_lead_a_track_astray() -> None:
    tracker, (x, y, z) = Tracker(), STANDING[0]
    follow(tracker, STANDING * 30)
    follow(tracker, [None] * 5 + [(x + 0.8, y, z)] + [None] * 2, 30)
    tracks = follow(tracker, STANDING * 3, 38)
    assert tracks.ids.tolist() == [1]
    np.testing.assert_allclose(tracks.centres[0], STANDING[0], atol=0.02)
    assert tracker.ids_given == 1


def test_a_head_that_comes_back_before_it_is_given_up_is_the_same_one() -> None:
    """It stood, was missed while it walked off sideways, and is found farther away than its track expects."""
    tracker = Tracker()
    follow(tracker, STANDING * 30)
    x, y, z = STANDING[0]
    tracks = follow(tracker, [None] * 4 + [(x + 0.9, y, z)] * 3, 30)
    assert tracks.ids.tolist() == [1]
    assert tracker.ids_given == 1


def test_what_is_expected_is_where_confirmed_heads_will_be() -> None:
    tracker = Tracker()
    assert len(tracker.expected(0)) == 0
    follow(tracker, walk(1))
    assert len(tracker.expected(at(1).stamp_ns)) == 0
    follow(tracker, walk(21, 1), 1)
    expected = tracker.expected(at(22).stamp_ns)
    np.testing.assert_allclose(expected.centres, [walk(1, 22)[0]], atol=0.02)
    assert 0.1 < expected.reaches_m[0] <= 0.4
    assert len(tracker.expected(at(3).stamp_ns)) == 0  # a late frame is not tracked


def looking(yaw_rad: float, sigma_rad: float) -> Heads:
    """A head whose yaw, as the detector tells it, is so sure."""
    turn = np.array([[0.0, 0.0, np.sin(0.5 * yaw_rad), np.cos(0.5 * yaw_rad)]])
    spread = np.diag([0.05, 0.05, sigma_rad])[None] ** 2
    return replace(heads(STANDING[0]), quaternions=turn, rotation_covariances=spread)


def test_expected_orientations_are_the_same_where_rounding_errors_differ() -> None:
    """A fit that starts from one would make more of them, and so on from frame to frame."""
    expected = []
    for error in (0.0, 1e-13):
        tracker = Tracker()
        for k in range(10):
            tracker.update(looking(0.6 + 0.02 * k + error, 0.1), at(k))
        expected.append(tracker.expected(at(10).stamp_ns).quaternions)
    np.testing.assert_array_equal(*expected)
    assert np.linalg.norm(expected[0]) == pytest.approx(1.0, abs=1e-3)


def test_an_orientation_that_is_not_sure_is_not_expected() -> None:
    """The fit that started from it would look at no other, and confirm it in every frame."""
    for sigma, expected in ((0.05, True), (0.5, False)):
        tracker = Tracker()
        for k in range(4):
            tracker.update(looking(0.3, sigma), at(k))
        assert np.isfinite(tracker.expected(at(4).stamp_ns).quaternions[0, 3]) == expected


def test_an_orientation_that_was_not_seen_for_long_is_not_stated() -> None:
    tracker = Tracker()
    for k in range(10):
        tracks = tracker.update(looking(0.3, 0.1), at(k))
    assert np.degrees(2.0 * np.arcsin(tracks.quaternions[0, 2])) == pytest.approx(np.degrees(0.3), abs=0.1)
    stated = []
    for k in range(10, 40):
        tracks = tracker.update(heads(STANDING[0]), at(k))
        stated.append(bool(np.isfinite(tracks.quaternions[0]).all()))
        assert np.isfinite(tracks.rotation_covariances[0]).all() == stated[-1]
    assert stated[0]
    assert not stated[-1]
    assert sorted(stated, reverse=True) == stated


@pytest.mark.skipif(not FILINHA.is_dir(), reason="no shared/data beside the checkout")
def test_a_camera_pose_that_differs_by_a_rounding_error_gives_the_same_tracks() -> None:
    """As the same recording does that comes from a bag, where poses are quaternions."""
    frames = list(open_source(FILINHA))
    error = np.zeros((4, 4))
    error[:3, :3] = np.random.default_rng(0).uniform(-2e-16, 2e-16, (3, 3))
    followed = []
    for change in (0.0, error):
        detector, tracker, tracks = Detector(), Tracker(), []
        for frame in frames:
            images = [replace(image, T_world_camera=image.T_world_camera + change) for image in frame.depths]
            changed = replace(frame, depths=tuple(images))
            heads = detector.detect_frame(changed, tracker.expected(frame.stamp_ns))
            tracks.append(tracker.update(heads, changed))
        followed.append(tracks)
    assert sum(len(tracks) for tracks in followed[0]) > 100
    for one, other in zip(*followed, strict=True):
        np.testing.assert_array_equal(one.ids, other.ids)
        np.testing.assert_allclose(one.centres, other.centres, atol=1e-9)


# ------------------------------------------------------------------------------------------------------- lost and found


def test_a_head_that_comes_back_is_the_same_one() -> None:
    tracker = Tracker()
    follow(tracker, walk(20))
    tracks = follow(tracker, [None] * 25, 20)
    assert len(tracks) == 0
    tracks = follow(tracker, walk(3, 40), 45)
    assert tracks.ids.tolist() == [1]
    assert tracks.ages_s[0] == pytest.approx(4.7)


def test_who_went_out_is_known_again_by_height() -> None:
    """After 7 seconds; another one, 15 cm smaller, comes in at the same place before."""
    tracker = Tracker()
    follow(tracker, walk(20))
    follow(tracker, [None] * 30, 20)
    x, y, z = walk(20)[-1]
    assert follow(tracker, [(x + 0.5, y, z - 0.15)] * 3, 50).ids.tolist() == [2]
    follow(tracker, [None] * 36, 53)
    assert follow(tracker, [(x + 0.5, y, z)] * 3, 89).ids.tolist() == [1]


@pytest.mark.parametrize("place", [(1.52, 0.57, 1.2), (-1.6, 0.57, 1.6)])
def test_a_head_of_another_height_or_far_away_is_another(place) -> None:
    tracker = Tracker()
    follow(tracker, walk(20))
    follow(tracker, [None] * 25, 20)
    assert follow(tracker, [place] * 3, 45).ids.tolist() == [2]


def test_one_lost_head_is_given_to_one_only() -> None:
    tracker = Tracker()
    follow(tracker, STANDING * 10)
    follow(tracker, [None] * 20, 10)
    for k in range(30, 34):
        tracks = tracker.update(heads((1.1, 0.5, 1.6), (0.6, 0.5, 1.6)), at(k))
    assert sorted(tracks.ids.tolist()) == [1, 2]
