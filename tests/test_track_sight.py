"""How long the tracker follows a head that is not found, by what the sensors saw where it should be."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
from walks import MS, PLACE, RATE_MS, STANDING, at, follow, heads, image, walk

from headvox.config import TrackerConfig
from headvox.data import Cloud, DepthImage, Frame, State
from headvox.tracking.tracker import FIRST_TRUST, Tracker

# ------------------------------------------------------------------------------------------- what the sensors saw there


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


# ----------------------------------------------------------------------------------------------------------- weak heads


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
