"""Tracks over time: births and ids, motion, the clock."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as StillWaiting
from dataclasses import fields, replace

import numpy as np
import pytest
import scenes
from scipy.spatial.transform import Rotation
from walks import MS, PLACE, STANDING, at, follow, heads, image, walk

from headvox.config import TrackerConfig
from headvox.data import DepthImage, Frame, Heads, State, Tracks
from headvox.errors import HeadvoxError
from headvox.tracking.noise import measurement_noise
from headvox.tracking.tracker import Tracker

# ------------------------------------------------------------------------------------------------------- births and ids


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


def test_a_planner_in_another_thread_waits_for_the_frame_that_is_taken(monkeypatch) -> None:
    tracker, asked = Tracker(), []
    follow(tracker, walk(30))
    correct, stamp_ns = tracker._correct, at(31).stamp_ns

    def correct_while_others_ask(*args) -> None:
        for ask in (tracker.predict, tracker.expected):
            asked.append(planner.submit(ask, stamp_ns))
            with pytest.raises(StillWaiting):
                asked[-1].result(timeout=0.05)
        correct(*args)

    with ThreadPoolExecutor(2) as planner, monkeypatch.context() as patch:
        patch.setattr(tracker, "_correct", correct_while_others_ask)
        follow(tracker, walk(1, 30), 30)
        predicted, expected = (answer.result() for answer in asked)
    np.testing.assert_array_equal(predicted.centres, tracker.predict(stamp_ns).centres)
    np.testing.assert_array_equal(expected.centres, tracker.expected(stamp_ns).centres)


# ------------------------------------------------------------------------------------------------------------ the clock


def test_irregular_stamps_are_real_time() -> None:
    rng = np.random.default_rng(2)
    tracker, step = Tracker(), 0.0
    for _ in range(60):
        step += rng.uniform(0.2, 2.0)
        tracks = tracker.update(heads((0.08 * step, 0.0, 1.6)), at(step))
    np.testing.assert_allclose(tracks.velocities[0], [0.8, 0.0, 0.0], atol=0.03)
    assert not tracker.untracked


@pytest.mark.parametrize("stamp_ns", [np.nan, np.inf, 1.5, 2**62, -(2**63), 10**400, "1", None])
def test_a_stamp_that_is_no_whole_nanoseconds_is_refused_by_all(stamp_ns) -> None:
    tracker = Tracker()
    for _ in range(2):
        for call in (lambda: tracker.update(heads(), Frame(stamp_ns)), lambda: tracker.predict(stamp_ns),
                     lambda: tracker.expected(stamp_ns)):  # fmt: skip
            with pytest.raises(HeadvoxError, match="stamp_ns: expected whole nanoseconds, less than 2"):
                call()
        follow(tracker, walk(3))


def test_stamps_may_be_any_kind_of_whole_number() -> None:
    for kind in (int, float, np.int64, np.uint64):
        tracker = Tracker()
        for k in (1, 2, 3, 1):
            tracks = tracker.update(heads(*STANDING), Frame(kind(k * 10**8)))
        assert (tracks.stamp_ns, type(tracks.stamp_ns), tracker.untracked) == (10**8, int, {"late": 1})
        assert tracker.predict(kind(4 * 10**8)).ids.tolist() == [1]


def test_stamps_at_both_ends_of_time() -> None:
    tracker = Tracker()
    tracker.update(heads(*STANDING), Frame(1 - 2**62))
    assert len(tracker.update(heads(), Frame(2**62 - 1))) == 0
    follow(tracker, STANDING * 3)
    assert len(tracker.predict(2**62 - 1)) == 1


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


# ------------------------------------------------------------------------------------------------------------- the rest


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


def turning(k: int) -> Heads:
    """Return the head of somebody who walks, and turns ever faster."""
    turn = Rotation.from_euler("z", 0.002 * k**2).as_quat()
    place = (PLACE[0], 0.01 * k, PLACE[2])
    return replace(heads(place), quaternions=turn[None], rotation_covariances=1e-3 * np.eye(3)[None])


def lost_and_found(tracker: Tracker, *missed: DepthImage, new: TrackerConfig | None = None) -> list[Tracks]:
    """Show a head for 3 s, for 5 s only ``missed``, then the head; ``new`` is the configuration from 2 s on."""
    tracks = []
    for k in range(85):
        if k == 20 and new is not None:
            tracker.config = new
        hidden = 30 <= k < 80
        frame = Frame(at(k).stamp_ns, depths=missed if hidden else ())
        tracks.append(tracker.update(heads() if hidden else turning(k), frame))
    return tracks


def joined(run: list[Tracks]) -> Tracks:
    """Return the tracks of all frames of a run, one after the other."""
    names = [field.name for field in fields(Tracks) if field.name != "stamp_ns"]
    rows = {name: np.concatenate([getattr(tracks, name) for tracks in run]) for name in names}
    return Tracks(stamp_ns=run[-1].stamp_ns, **rows)


@pytest.mark.parametrize(
    ("name", "value", "missed"),
    [
        ("empty_s", 2.0, [image(4.0)]),
        ("missed_s", 2.0, [image(0.0)]),
        ("hidden_s", 1.0, [image(1.0)]),
        ("out_of_view_s", 2.0, [image(4.0, T=scenes.looking_along_x(5.0, 0.0, 1.6))]),
        ("remember_s", 1.0, []),
        ("speed_change_m_s", 0.1, []),
        ("turn_change_deg_s", 20.0, []),
        ("strong_score", 8.0, []),
        ("confirm_hits", 4, []),
    ],
)
def test_a_configuration_that_is_assigned_counts_as_one_that_was_there_first(name, value, missed) -> None:
    config, assigned = TrackerConfig(**{name: value}), Tracker()
    assigned.config = config
    assert assigned.config is config
    every = joined(lost_and_found(Tracker(config), *missed))
    assert_same(joined(lost_and_found(assigned, *missed)), every)
    with pytest.raises(AssertionError):  # the setting does something here
        assert_same(joined(lost_and_found(Tracker(), *missed)), every)


def test_a_configuration_may_be_assigned_meanwhile_and_the_tracks_stay() -> None:
    tracker = Tracker()
    tracks = lost_and_found(tracker, image(4.0), new=TrackerConfig(empty_s=2.0, present_s=10.0))
    usual = lost_and_found(Tracker(), image(4.0))
    assert_same(tracks[19], usual[19])
    assert tracks[20].ids.tolist() == [1]
    followed, usually = ([len(one) > 0 for one in run[30:80]] for run in (tracks, usual))
    assert sum(followed) > 2 * sum(usually)


def test_only_a_configuration_may_be_assigned() -> None:
    tracker = Tracker()
    with pytest.raises(HeadvoxError, match="Expected a TrackerConfig, got "):
        tracker.config = {"empty_s": 1.0}
    assert tracker.config == TrackerConfig()


def test_nothing_that_is_handed_out_changes_later() -> None:
    tracker = Tracker()
    tracks = follow(tracker, walk(10))
    kept = {field.name: np.copy(getattr(tracks, field.name)) for field in fields(Tracks)}
    follow(tracker, walk(10, 10), 10)
    for name, value in kept.items():
        np.testing.assert_array_equal(getattr(tracks, name), value)
