"""The whole flow from a frame to heads, equal to its naive twin."""

from dataclasses import replace

import naive
import numpy as np
import pytest
import scenes
from busts import NARROW, camera_and_cloud, camera_frame, everything, two_busts

from headvox import Cloud, Frame, Heads, pipeline
from headvox.data import Expected
from headvox.fuse import Region
from headvox.masks.read import load_cascade
from headvox.visibility import not_seen


def same_heads(heads: Heads, wanted: naive.Found):
    assert heads.scores.tolist() == wanted.scores
    np.testing.assert_allclose(heads.centres, wanted.centres, atol=1e-9)
    np.testing.assert_allclose(heads.radii, wanted.radii, atol=1e-9)


REGION = Region((0.0, 0.0, 0.0), 0.45, -0.25, 0.35)


@pytest.mark.parametrize("cascade", ["stages", "fourth", "votes"])
def test_clouds_equal_the_naive_twin(make, cascades, cascade):
    rng = np.random.default_rng(1)
    T = scenes.pose(rng)
    cloud = np.concatenate(
        [scenes.bust(rng, (0.1, 0.1, 0.15), 150), scenes.bust(rng, (-0.2, -0.2, 0.1), 150)]
    )
    in_sensor = ((cloud - T[:3, 3]) @ T[:3, :3]).astype(np.float32)
    world, turned = np.ascontiguousarray(cloud[::2]), np.ascontiguousarray(in_sensor[1::2])
    frame = Frame(0, clouds=(Cloud("world", world), Cloud("turned", turned, T)))
    least = 0.0 if cascade == "votes" else -1.0
    detector = make(cascade, min_score=least, **NARROW)
    wanted = naive.detect(frame, load_cascade(cascades[cascade]), REGION, least)
    same_heads(detector.detect_frame(frame), wanted)
    assert detector.candidates == wanted.candidates
    assert len(wanted.scores) > 1


@pytest.mark.parametrize("count", [1, 2])
def test_depth_images_equal_the_naive_twin(make, cascades, count):
    """Through all stages, those that ask what the cameras saw too."""
    frame = camera_frame(count, count)
    for least in (None, -2.0)[count - 1 :]:
        wanted = naive.detect(frame, load_cascade(cascades["stages"]), REGION, least)
        detector = make(min_score=least, **NARROW)
        same_heads(detector.detect_frame(frame), wanted)
        assert detector.candidates == wanted.candidates
    assert len(wanted.scores) > 1


def test_clouds_and_depth_images_in_one_frame(make, cascades):
    cloud = scenes.bust(np.random.default_rng(0), (-0.2, -0.2, 0.1), 100)
    frame = replace(camera_frame(1), clouds=(Cloud("c", cloud),))
    wanted = naive.detect(frame, load_cascade(cascades["stages"]), REGION)
    same_heads(make(**NARROW).detect_frame(frame), wanted)
    assert len(wanted.scores) > 0


def test_cameras_have_a_say_only_where_they_look(make, cascades, monkeypatch):
    asked = []

    def noting(states):
        asked.append(not_seen(states))
        return asked[-1]

    monkeypatch.setattr(pipeline, "not_seen", noting)
    frame = camera_and_cloud()
    wanted = naive.detect(frame, load_cascade(cascades["stages"]), REGION, -2.0)
    same_heads(make(min_score=-2.0, **NARROW).detect_frame(frame), wanted)
    assert len(wanted.scores) > 1
    (unseen,) = asked
    assert unseen.any()
    assert not unseen.all()


def test_where_no_camera_looks_a_cloud_counts_as_without_any(make):
    """But for the threshold: one holds for all heads of a frame."""
    cloud, image = (Cloud("c", two_busts()),), camera_frame(1).depths[0]
    blind = replace(image, depth=np.zeros_like(image.depth))
    detector = make(min_score=-2.0)
    alone = detector.detect_frame(Frame(0, clouds=cloud))
    both = detector.detect_frame(Frame(0, clouds=cloud, depths=(blind,)))
    assert len(alone) > 1
    assert both.scores.tolist() == (alone.scores - 0.25).tolist()  # 0.5 is the least score without, 0.25 with
    finder = make()
    assert len(finder.detect_frame(Frame(0, clouds=cloud))) == (alone.scores >= 0.5).sum() > 0
    assert len(finder.detect_frame(Frame(0, clouds=cloud, depths=(blind,)))) == (alone.scores >= 0.5).sum()


def test_without_refinement_a_head_is_at_its_voxel(make):
    heads = make(refine="none", min_score=-1.0).detect(two_busts())
    assert len(heads) > 1
    steps = heads.centres / 0.05 - 0.5
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)


def expecting(*centres, reach=0.2) -> Expected:
    return Expected(
        np.array(centres).reshape(-1, 3), np.full((len(centres), 4), np.nan), np.full(len(centres), reach)
    )


@pytest.mark.parametrize("frame", [Frame(0, clouds=(Cloud("c", two_busts()),)), camera_frame(0, 2)])
def test_where_a_head_is_expected_a_weaker_one_lives_but_not_a_much_weaker_one(make, frame):
    everyone = make(min_score=-2.0).detect_frame(frame)
    best = everyone.centres[0]
    above = float(everyone.scores[0]) + 0.5
    detector = make(min_score=above, score_slack=0.6)
    assert len(detector.detect_frame(frame)) == 0
    heads = detector.detect_frame(frame, expecting(best))
    assert (heads.scores[0], heads.sure[0]) == (everyone.scores[0], False)
    np.testing.assert_array_equal(heads.centres[0], best)
    assert (np.linalg.norm(heads.centres - best, axis=1) < 0.4).all()
    assert len(detector.detect_frame(frame, expecting(best + np.array((0, 0, 1.5))))) == 0
    assert len(detector.detect_frame(frame, expecting())) == 0
    assert len(make(min_score=above, score_slack=0.4).detect_frame(frame, expecting(best))) == 0


def test_expecting_a_head_takes_nothing_from_the_others(make):
    """What is found without expecting anything is found with it, surely and bit for bit."""
    frame = camera_frame(1, 2)
    detector = make(min_score=-1.0)
    bare = detector.detect_frame(frame)
    expected = detector.detect_frame(frame, expecting((0.1, -0.15, 0.1), (0.9, 0.9, 0.0), reach=0.1))
    assert len(bare) > 0
    assert bare.sure.all()
    sure = expected.sure
    assert everything(bare) == tuple(
        a[sure].tobytes() for a in (expected.centres, expected.quaternions, expected.radii, expected.scores)
    )


def test_heads_come_best_first_and_apart(make):
    heads = make(min_score=-2.0).detect(two_busts())
    assert len(heads) > 1
    assert (np.diff(heads.scores) <= 0).all()
    for i in range(len(heads)):
        others = np.delete(heads.centres, i, axis=0)
        assert np.linalg.norm(others - heads.centres[i], axis=1).min() >= 0.18
    assert [head.score for head in heads] == heads.scores.tolist()
    assert np.isnan(heads.quaternions).all()


def test_votes_give_a_yaw(make):
    heads = make("votes", min_score=0.0).detect(two_busts())
    assert len(heads) > 0
    np.testing.assert_allclose(np.linalg.norm(heads.quaternions, axis=1), 1.0)
    yaws = 2 * np.degrees(np.arctan2(heads.quaternions[:, 2], heads.quaternions[:, 3]))
    assert set(np.round(yaws)) <= {0.0, 45.0, 90.0, 120.0}


def test_min_score_drops_the_worse(make):
    everyone = make(min_score=-2.0).detect(two_busts())
    least = float(np.sort(everyone.scores)[len(everyone) // 2])
    some = make(min_score=least).detect(two_busts())
    assert some.scores.tolist() == [s for s in everyone.scores.tolist() if s >= least]
