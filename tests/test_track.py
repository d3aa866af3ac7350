"""Who is who over time: births, deaths, occlusion, time stamps, identities."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import scenes

from headvox.config import TrackerConfig
from headvox.data import Cloud, DepthImage, Frame, Heads, Intrinsics, State, Tracks
from headvox.errors import HeadvoxError
from headvox.pipeline import Detector
from headvox.sources import open_source
from headvox.tracking.noise import measurement_noise
from headvox.tracking.tracker import FIRST_TRUST, Tracker

FILINHA = Path(__file__).parents[1].parent / "shared" / "data" / "recordings" / "filinha"
MS = 1_000_000
RATE_MS = 100


def heads(*centres, sure=True, score=5.0) -> Heads:
    n = len(centres)
    return Heads(
        np.array(centres, np.float64).reshape(n, 3),
        np.full((n, 4), np.nan),
        np.full(n, 0.1),
        np.full(n, score),
        sure=np.full(n, sure),
    )


def at(step: float) -> Frame:
    return Frame(round(step * RATE_MS) * MS)


def follow(tracker: Tracker, path, first: int = 0) -> Tracks:
    """Feed a head at each of ``path``, None where it is not seen; return the last tracks."""
    for k, centre in enumerate(path, first):
        tracks = tracker.update(heads() if centre is None else heads(centre), at(k))
    return tracks


STANDING = [(1.0, 0.5, 1.6)]


def walk(steps: int, first: int = 0, speed=(0.8, 0.3)) -> list[tuple[float, float, float]]:
    return [(speed[0] * 0.1 * k, speed[1] * 0.1 * k, 1.6) for k in range(first, first + steps)]


# ------------------------------------------------------------------------------------------------------ births and ids


@pytest.mark.parametrize(
    ("score", "seen", "after"),
    [
        (5.0, "11", 2),
        (5.0, "101", 3),
        (4.0, "101", None),
        (4.0, "10101", 5),
        (2.4, "11101", None),
        (1.6, "11111", 5),
    ],
)
def test_a_head_gets_an_id_when_it_was_seen_often_enough_and_scores_enough(score, seen, after) -> None:
    tracker = Tracker()
    for k, there in enumerate(seen, 1):
        tracks = tracker.update(heads(*STANDING, score=score) if there == "1" else heads(), at(k))
        if there == "0":
            assert len(tracks) == 0  # what is not sure is stated only where it is seen
        else:
            named = after is not None and k >= after
            state = State.CONFIRMED if named else State.TENTATIVE
            assert (tracks.ids.tolist(), tracks.states.tolist()) == ([int(named)], [state])


def test_a_flicker_gets_no_id_and_goes() -> None:
    tracker = Tracker()
    assert len(follow(tracker, STANDING)) == 1
    assert len(follow(tracker, [None] * 6, 1)) == 0
    assert tracker.ids_given == 0


def test_one_sighting_is_enough_when_one_is_asked_for() -> None:
    tracks = Tracker(TrackerConfig(confirm_hits=1, confirm_frames=1)).update(heads(*STANDING), at(0))
    assert tracks.ids.tolist() == [1]


def test_ids_belong_to_the_tracker() -> None:
    one, two = Tracker(), Tracker()
    assert follow(one, STANDING * 3).ids.tolist() == [1]
    assert follow(two, STANDING * 3).ids.tolist() == [1]
    for k in range(3, 7):
        tracks = one.update(heads(*STANDING, (-1.0, 0.0, 1.2)), at(k))
    assert tracks.ids.tolist() == [1, 2]
    assert two.ids_given == 1


def test_two_who_cross_keep_their_ids() -> None:
    tracker = Tracker()
    for k in range(60):
        left, right = (-2.4 + 0.08 * k, 0.12, 1.6), (2.4 - 0.08 * k, -0.12, 1.65)
        tracks = tracker.update(heads(left, right), at(k))
    assert tracks.ids.tolist() == [1, 2]
    for k, place in enumerate((left, right)):
        np.testing.assert_allclose(tracks.centres[k], place, atol=0.02)
    assert tracker.ids_given == 2


# ------------------------------------------------------------------------------------------------- motion and its state


def test_a_walking_head_has_its_velocity_and_no_lag() -> None:
    tracks = follow(Tracker(), walk(40))
    np.testing.assert_allclose(tracks.velocities[0], [0.8, 0.3, 0.0], atol=0.02)
    np.testing.assert_allclose(tracks.centres[0], walk(40)[-1], atol=0.005)
    assert tracks.ages_s[0] == pytest.approx(3.9)
    assert tracks.unseen_s[0] == 0.0


@pytest.mark.parametrize("stated_m", [0.006, 0.018])
def test_a_still_head_is_smoothed_whatever_its_detector_states(stated_m) -> None:
    rng = np.random.default_rng(0)
    tracker, centres = Tracker(), []
    for k in range(300):
        place = np.array([1.0, 0.5, 1.6]) + rng.normal(0.0, 0.018, 3)
        seen = replace(heads(tuple(place)), centre_covariances=stated_m**2 * np.eye(3)[None])
        centres.append(tracker.update(seen, Frame(k * 33 * MS)).centres[0])
    assert np.linalg.norm(np.std(centres[60:], axis=0)) < 0.005
    seconds = np.std(np.reshape(centres[60:], (8, 30, 3)), axis=1)
    assert np.sqrt((seconds**2).sum(axis=1).mean()) < 0.002
    assert np.linalg.norm(np.mean(centres[60:], axis=0) - [1.0, 0.5, 1.6]) < 0.005


def test_who_sets_off_is_followed_at_once() -> None:
    """After four seconds at rest, by 1.2 m/s² up to a metre a second; no frame behind when it walks."""
    time_s = np.arange(240) / 30.0
    since_s = np.maximum(time_s - 4.0, 0.0)
    way = np.where(since_s < 1 / 1.2, 0.6 * since_s**2, since_s - 0.5 / 1.2)
    rng, behind = np.random.default_rng(1), np.empty((20, 240))
    for errors in behind:
        tracker = Tracker()
        for k, x in enumerate(way):
            place = np.array([x, 0.0, 1.6])
            seen = tracker.update(heads(tuple(place + rng.normal(0.0, 0.01, 3))), Frame(k * 33_333_333))
            errors[k] = x - seen.centres[0, 0]
    assert behind.mean(axis=0).max() < 0.04
    assert abs(behind[:, time_s > 5.5].mean()) < 0.2 / 30.0


def test_coasting_goes_on_along_the_path_and_is_told() -> None:
    tracker = Tracker()
    follow(tracker, walk(30))
    tracks = follow(tracker, [None] * 4, 30)
    assert State(tracks.states[0]) == State.COASTING
    assert tracks.unseen_s[0] == pytest.approx(0.4)
    np.testing.assert_allclose(tracks.centres[0], walk(1, 33)[0], atol=0.08)
    tracks = follow(tracker, walk(1, 34), 34)
    assert (tracks.ids.tolist(), tracks.states.tolist()) == ([1], [State.CONFIRMED])


def test_covariance_grows_without_sight_and_shrinks_with_it() -> None:
    tracker = Tracker()
    follow(tracker, walk(30))
    widths = [np.trace(follow(tracker, [None], 30 + k).covariances[0, :3, :3]) for k in range(5)]
    assert (np.diff(widths) > 0).all()
    assert np.trace(follow(tracker, walk(1, 35), 35).covariances[0, :3, :3]) < widths[0]


def test_predict_is_for_a_planner_and_changes_nothing() -> None:
    tracker = Tracker()
    follow(tracker, walk(30))
    ahead = tracker.predict(at(31).stamp_ns)
    np.testing.assert_allclose(ahead.centres[0], walk(1, 31)[0], atol=0.04)
    assert ahead.stamp_ns == at(31).stamp_ns
    again = tracker.predict(at(29).stamp_ns)
    np.testing.assert_allclose(again.centres[0], walk(1, 29)[0], atol=0.01)
    assert State(again.states[0]) == State.CONFIRMED
    with pytest.raises(HeadvoxError, match="last frame's"):
        tracker.predict(at(28).stamp_ns)
    assert len(Tracker().predict(5)) == 0


# ----------------------------------------------------------------------------------------------------------- the clock


def test_irregular_stamps_are_real_time() -> None:
    rng = np.random.default_rng(2)
    tracker, step = Tracker(), 0.0
    for _ in range(60):
        step += rng.uniform(0.2, 2.0)
        tracks = tracker.update(heads((0.08 * step, 0.0, 1.6)), at(step))
    np.testing.assert_allclose(tracks.velocities[0], [0.8, 0.0, 0.0], atol=0.03)
    assert not tracker.untracked


def test_repeated_and_late_frames_are_counted_and_change_nothing() -> None:
    tracker = Tracker()
    follow(tracker, STANDING * 10)
    before = tracker.predict(at(9).stamp_ns)
    for frame in (at(9), at(9), at(7)):
        tracks = tracker.update(heads((1.3, 0.5, 1.6)), frame)
        assert (tracks.ids.tolist(), tracks.states.tolist()) == ([0], [State.TENTATIVE])
        assert tracks.stamp_ns == frame.stamp_ns
        np.testing.assert_array_equal(tracks.centres, [[1.3, 0.5, 1.6]])
    assert dict(tracker.untracked) == {"repeated": 2, "late": 1}
    assert_same(tracker.predict(at(9).stamp_ns), before)


def test_a_recording_that_begins_again_resets_but_never_repeats_an_id() -> None:
    tracker = Tracker()
    follow(tracker, STANDING * 30)
    tracks = follow(tracker, STANDING * 3)
    assert tracks.ids.tolist() == [2]
    assert tracks.ages_s[0] == pytest.approx(0.2)
    assert dict(tracker.untracked) == {"resets": 1}


def test_after_a_long_gap_nobody_is_left() -> None:
    tracker = Tracker()
    follow(tracker, STANDING * 5)
    tracks = tracker.update(heads(*STANDING), at(5 + 10 * TrackerConfig().remember_s + 1))
    assert tracks.states.tolist() == [State.TENTATIVE]


def test_slow_frames_are_tracked_too() -> None:
    """Two frames a second: one miss is longer than most limits, and ends nobody."""
    tracker = Tracker()
    for k in range(20):
        seen = heads() if k in (8, 13) else heads((0.2 * k, 0.0, 1.6))
        tracks = tracker.update(seen, at(5 * k))
    assert tracks.ids.tolist() == [1]


# ------------------------------------------------------------------------------------------ what the sensors saw there

CAMERA = Intrinsics(80, 60, 60.0, 60.0, 39.5, 29.5)
LOOKING = scenes.looking_along_x(0.0, 0.0, 1.6)
PLACE = (2.0, 0.0, 1.6)


def image(depth_m: float, camera: Intrinsics = CAMERA, T: np.ndarray = LOOKING) -> DepthImage:
    depth = np.full((camera.height, camera.width), round(1000 * depth_m), np.uint16)
    return DepthImage("front", depth, camera, T)


def lives(*images: DepthImage, clouds=(), place=PLACE, score=5.0, seen=200) -> float:
    """Return how many seconds a standing head that was ``seen`` 50 times a second is followed after that."""
    tracker = Tracker()
    for k in range(seen):
        tracker.update(heads(place, score=score), Frame(k * 20 * MS, depths=images, clouds=clouds))
    for k in range(seen, seen + 400):
        tracks = tracker.update(heads(), Frame(k * 20 * MS, depths=images, clouds=clouds))
        if len(tracks) == 0:
            return (k - seen + 1) * 0.02
    return np.inf


def test_what_is_seen_of_a_place_decides_how_long_a_track_lives() -> None:
    config = TrackerConfig()
    close = 0.021  # a frame, and rounding
    assert lives(image(4.0)) == pytest.approx(config.empty_s, abs=close)
    assert lives(image(1.9)) == pytest.approx(config.present_s, abs=close)  # something is there, but no head
    assert lives(image(1.0)) == pytest.approx(config.hidden_s, abs=close)
    assert lives(image(0.0)) == pytest.approx(config.missed_s, abs=close)  # hair without returns is not empty
    turned = scenes.looking_along_x(3.0, 0.0, 1.6)  # the place is behind the camera
    assert lives(image(4.0, T=turned)) == pytest.approx(config.out_of_view_s, abs=close)
    beyond = (config.sight_m + 1.0, 0.0, 1.6)
    assert lives(image(2.0), place=beyond) == pytest.approx(config.out_of_view_s, abs=close)


def test_where_something_is_a_track_lasts_as_long_as_it_was_seen_before_and_scored() -> None:
    """Half a second, and what every track begins with; a thing that scores half as much as heads do gains half."""
    first_s = FIRST_TRUST * TrackerConfig().present_s
    assert lives(image(1.9), seen=26) == pytest.approx(first_s + 0.5, abs=0.041)
    assert lives(image(1.9), seen=26, score=2.0) == pytest.approx(first_s + 0.25, abs=0.041)


def test_who_is_not_where_expected_is_not_stated_but_known_again() -> None:
    """One walks, is missed, and turns off to the side; the camera sees that nobody is straight ahead."""
    tracker = Tracker()
    for k in range(15):
        y = 0.06 * k - 0.8
        tracker.update(heads((1.5, y, 1.6)), Frame(k * RATE_MS * MS, depths=(image(4.0),)))
    stated = [
        len(tracker.update(heads(), Frame(k * RATE_MS * MS, depths=(image(4.0),)))) for k in range(15, 20)
    ]
    assert stated[-2:] == [0, 0]
    for k in range(20, 22):
        tracks = tracker.update(heads((2.0, y + 0.1, 1.6)), Frame(k * RATE_MS * MS, depths=(image(4.0),)))
    assert (tracks.ids.tolist(), tracks.states.tolist()) == ([1], [State.CONFIRMED])


def test_a_weak_thing_that_is_seen_now_and_then_is_hardly_prolonged() -> None:
    """A plant in the sample scores 1.6 to 3.0 in a third of the frames; a head that scores 5 is stated in most."""
    shares = {}
    for scores in ((1.6, 3.0), (5.0, 5.0)):
        rng, tracker, without = np.random.default_rng(4), Tracker(), 0
        for k in range(1000):
            seen = heads(PLACE, score=rng.uniform(*scores)) if rng.random() < 0.35 else heads()
            tracks = tracker.update(seen, Frame(k * 33 * MS, depths=(image(1.9),)))
            without += int(len(tracks) > len(seen))
            assert scores[0] == 5.0 or len(tracks) <= len(seen) or tracks.unseen_s[0] < 0.5
        shares[scores] = without / 1000
    assert shares[1.6, 3.0] < 0.25
    assert shares[5.0, 5.0] > 0.4


def test_of_two_cameras_the_one_that_sees_the_place_empty_decides() -> None:
    config = TrackerConfig()
    turned = scenes.looking_along_x(3.0, 0.0, 1.6)
    assert lives(image(1.0), image(4.0)) == pytest.approx(config.empty_s, abs=0.021)
    assert lives(image(4.0, T=turned), image(1.0)) == pytest.approx(config.hidden_s, abs=0.021)


def test_clouds_tell_only_how_far_their_sensor_is() -> None:
    config, points = TrackerConfig(), np.zeros((1, 3), np.float32)
    near, far = np.eye(4), scenes.looking_along_x(20.0, 0.0, 0.0)
    for T, limit in ((None, config.missed_s), (near, config.missed_s), (far, config.out_of_view_s)):
        assert lives(clouds=(Cloud("lidar", points, T),)) == pytest.approx(limit, abs=0.021)


# ----------------------------------------------------------------------------------------------------- weak heads


def test_weak_heads_bear_nobody_and_keep_nobody_for_long() -> None:
    tracker = Tracker()
    for k in range(10):
        assert len(tracker.update(heads(*STANDING, sure=False), at(k))) == 0
    follow(tracker, STANDING * 20, 10)
    steps = 0
    while len(tracker.update(heads(*STANDING, sure=False), at(30 + steps))):
        steps += 1
    assert steps * 0.1 == pytest.approx(TrackerConfig().weak_s, abs=0.11)


def test_weak_heads_between_sure_ones_hold_a_track() -> None:
    tracker = Tracker()
    follow(tracker, walk(10))
    for k in range(10, 60):
        tracks = tracker.update(heads(*walk(1, k), sure=k % 2 == 0), at(k))
        assert (tracks.ids.tolist(), tracks.states.tolist()) == ([1], [State.CONFIRMED])


def test_what_is_mostly_not_seen_in_plain_view_does_not_stay() -> None:
    """A thing that looks like a head in one frame of four, and scores a little too low in the others."""
    shares = {}
    for every, between in ((4, heads()), (4, heads(PLACE, sure=False)), (2, heads(PLACE, sure=False))):
        tracker, named = Tracker(), 0
        for k in range(300):
            seen = heads(PLACE) if k < 3 or k % every == 0 else between
            tracks = tracker.update(seen, Frame(k * 33 * MS, depths=(image(1.9),)))
            named += int((tracks.ids > 0).any())
        shares[every, len(between)] = named / 300
    assert shares[4, 0] < 0.15
    assert shares[4, 1] < 0.30
    assert shares[2, 1] > 0.95


def test_a_hidden_head_loses_no_trust() -> None:
    tracker = Tracker()
    for k in range(200):
        hidden = k % 20 >= 5
        frame = Frame(k * RATE_MS * MS, depths=(image(1.0 if hidden else 1.9),))
        tracks = tracker.update(heads() if hidden else heads(PLACE), frame)
        assert k < 2 or tracks.ids.tolist() == [1]


def test_a_place_that_is_hardly_known_is_not_seen_to_be_empty_soon() -> None:
    """Seen for a moment while walking: where it is half a second later nobody knows well."""
    tracker, config = Tracker(), TrackerConfig()
    for k in range(20):
        tracks = tracker.update(
            heads((1.5, 0.1 * k - 1.0, 1.6)), Frame(k * RATE_MS * MS, depths=(image(4.0),))
        )
    assert tracks.ids.tolist() == [1]
    k = 19
    while len(tracks):
        k += 1
        tracks = tracker.update(heads(), Frame(k * RATE_MS * MS, depths=(image(4.0),)))
    assert config.empty_s + 0.05 < (k - 19) * 0.1 <= config.missed_s + 0.05


# --------------------------------------------------------------------------------------- who it is, and who it is not


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


def test_expected_orientations_are_the_same_where_rounding_errors_differ() -> None:
    """A fit that starts from one would make more of them, and so on from frame to frame."""
    expected = []
    for error in (0.0, 1e-13):
        tracker = Tracker()
        for k in range(10):
            yaw = 0.3 + 0.01 * k + error
            head = replace(heads(STANDING[0]), quaternions=np.array([[0, 0, np.sin(yaw), np.cos(yaw)]]))
            tracker.update(head, at(k))
        expected.append(tracker.expected(at(10).stamp_ns).quaternions)
    np.testing.assert_array_equal(*expected)
    assert np.linalg.norm(expected[0]) == pytest.approx(1.0, abs=1e-3)


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


# ------------------------------------------------------------------------------------------------------ lost and found


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


# ------------------------------------------------------------------------------------------------------------ the rest


def test_noise_is_the_detectors_or_grows_with_distance() -> None:
    camera = image(3.0)
    known = replace(heads((1.0, 0.0, 1.6)), centre_covariances=np.eye(3)[None] * 1e-4)
    assert measurement_noise(known, Frame(0))[0][0, 0, 0] == 1e-4
    near, far = (
        measurement_noise(heads((x, 0.0, 1.6)), Frame(0, depths=(camera,)))[0][0] for x in (1.0, 3.0)
    )
    assert np.sqrt(near[0, 0]) == pytest.approx(0.005)
    assert np.sqrt(far[1, 1]) == pytest.approx(0.021)
    assert np.isfinite(measurement_noise(heads((1.0, 0.0, 1.6)), Frame(0))[0]).all()


def assert_same(a: Tracks, b: Tracks) -> None:
    for field in fields(Tracks):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name))


def test_the_same_heads_make_the_same_tracks() -> None:
    def run() -> Tracks:
        rng, tracker = np.random.default_rng(3), Tracker()
        for k in range(80):
            places = [(x, 0.02 * k * (-1) ** j, 1.6) for j, x in enumerate((-1.0, 0.0, 1.0, 2.0))]
            seen = [tuple(np.array(p) + rng.normal(0, 0.01, 3)) for p in places if rng.random() < 0.8]
            tracks = tracker.update(heads(*seen), at(k))
        return tracks

    assert_same(run(), run())


def test_nothing_that_is_handed_out_changes_later() -> None:
    tracker = Tracker()
    tracks = follow(tracker, walk(10))
    kept = {field.name: np.copy(getattr(tracks, field.name)) for field in fields(Tracks)}
    follow(tracker, walk(10, 10), 10)
    for name, value in kept.items():
        np.testing.assert_array_equal(getattr(tracks, name), value)
