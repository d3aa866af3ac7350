"""The same heads whatever the threads, the frames before, and the place of the cloud."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
import scenes
from busts import camera_frame, everything, two_busts

from headvox import DepthImage, Frame, HeadvoxError, Intrinsics

# ---------------------------------------------------------------------------------------------------------- determinism


@pytest.mark.parametrize("cascade", ["stages", "votes", "default"])
def test_threads_second_runs_and_other_frames_change_nothing(make, cascade):
    """Bytes are equal; a big frame before, a small one, a bad one and another kind leave nothing behind."""
    rng = np.random.default_rng(3)
    cloud = two_busts()
    settings = {"min_score": -2.0 if cascade == "stages" else 0.0}
    wanted = everything(make(cascade, **settings).detect(cloud))
    for threads in (1, 2, 3):
        detector = make(cascade, threads=threads, **settings)
        assert everything(detector.detect(cloud)) == wanted
        assert everything(detector.detect(cloud)) == wanted
        detector.detect(rng.uniform(-1, 1, (20_000, 3)).astype(np.float32))
        assert everything(detector.detect(cloud)) == wanted
        detector.detect(cloud[:1])
        with pytest.raises(HeadvoxError):
            detector.detect(np.full((3, 3), np.nan, np.float32))
        with pytest.raises(HeadvoxError):
            detector.detect(cloud + np.float32(90))
        detector.detect_frame(camera_frame(2, 2))
        assert everything(detector.detect(cloud)) == wanted


@pytest.mark.parametrize("threads", [1, 2])
def test_depth_frames_leave_nothing_behind(make, threads):
    wanted = [everything(make(min_score=-2.0).detect_frame(camera_frame(k, 2))) for k in range(3)]
    detector = make(min_score=-2.0, threads=threads)
    for k in (0, 2, 1, 1, 0):
        assert everything(detector.detect_frame(camera_frame(k, 2))) == wanted[k]
        detector.detect_frame(camera_frame(k, 1))
        detector.detect(two_busts(k))


@pytest.mark.parametrize("threads", [1, 2])
def test_permuted_points_make_the_same_bytes(make, threads):
    cloud = two_busts()
    for cascade in ("stages", "votes"):
        detector = make(cascade, min_score=-1.0, threads=threads)
        wanted = everything(detector.detect(cloud))
        for seed in range(3):
            shuffled = np.random.default_rng(seed).permutation(cloud)
            assert everything(detector.detect(shuffled)) == wanted


def test_many_heads_outgrow_the_memory_for_candidates(make):
    """More candidates than there was room for, in each thread, and then few again."""
    rng = np.random.default_rng(4)
    few, many = two_busts(), (rng.uniform(-3, 3, (20_000, 3)) * [1, 1, 0.05]).astype(np.float32)
    one, two = make(max_range_m=3.0, min_score=0.0), make(max_range_m=3.0, min_score=0.0, threads=2)
    wanted = everything(one.detect(few))
    assert everything(one.detect(many)) == everything(two.detect(many))
    assert two.candidates > 2 * 4096
    assert everything(one.detect(few)) == everything(two.detect(few)) == wanted


@pytest.mark.parametrize("cascade", ["stages", "fourth", "votes", "default"])
def test_heads_on_both_sides_of_where_the_volume_is_cut(make, cascade):
    """Busts a voxel apart in x, so that some lie on every seam, where their neighbours belong to another slab."""
    rng = np.random.default_rng(5)
    places = [(0.05 * k - 1.4, 0.4 * (k % 7) - 1.2, 0.1) for k in range(56)]
    cloud = np.concatenate([scenes.bust(rng, place, 400) for place in places])
    settings = {"max_range_m": 2.0, "min_score": 0.0}
    wanted = make(cascade, **settings).detect(cloud)
    assert len(wanted) > 20
    for threads in (2, 3):
        detector = make(cascade, threads=threads, **settings)
        assert everything(detector.detect(cloud)) == everything(wanted)
        seams = detector._memory.slabs.seams
        assert 0 < len(seams) < threads
        at = detector._memory.lattice.centres(detector._memory.first + np.stack([seams] * 3, axis=1))[:, 0]
        assert (np.abs(wanted.centres[:, 0] - at[:, None]).min(axis=1) < 0.1).all()


def test_a_frame_that_fails_midway_leaves_nothing_behind(make, monkeypatch):
    detector = make(min_score=-1.0)
    wanted = everything(detector.detect(two_busts(0)))

    def fail(*_):
        raise KeyboardInterrupt

    for stage in ("_gate", "_vote", "_suppress", "_judge", "_refine"):
        with monkeypatch.context() as patch:
            patch.setattr(detector, stage, fail)
            with pytest.raises(KeyboardInterrupt):
                detector.detect(two_busts(1))
        assert everything(detector.detect(two_busts(0))) == wanted


def test_a_moving_camera_is_followed_even_when_its_matrix_is_changed_in_place(make):
    frame = camera_frame()
    image = frame.depths[0]
    T = image.T_world_camera.copy()
    detector = make(min_score=-2.0)
    moving = Frame(0, depths=(replace(image, T_world_camera=T),))
    detector.detect_frame(moving)
    T[:3, 3] += (0.1, 0.05, -0.1)
    there = Frame(0, depths=(replace(image, T_world_camera=T.copy()),))
    assert everything(detector.detect_frame(moving)) == everything(make(min_score=-2.0).detect_frame(there))


def test_two_cameras_of_one_name_are_two_cameras(make):
    frame = camera_frame(1, 2)
    same = Frame(0, depths=tuple(replace(image, name="camera") for image in frame.depths))
    for threads in (1, 2):
        detector = make(min_score=-2.0, threads=threads)
        wanted = everything(detector.detect_frame(frame))
        assert everything(detector.detect_frame(same)) == wanted
        assert everything(detector.detect_frame(same)) == wanted


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda detector: pickle.loads(pickle.dumps(detector))])
@pytest.mark.parametrize("threads", [1, 2])
def test_a_copy_has_the_settings_and_nothing_else_of_the_detector(make, monkeypatch, threads, copied):
    detector = make(min_score=-2.0, threads=threads)
    monkeypatch.setattr(detector, "_note", print)
    wanted = everything(detector.detect(two_busts()))
    another = copied(detector)
    detector.close()
    assert (another.config, another._note) == (detector.config, print)
    assert len(another.candidates_of_last_frame()[0]) == 0
    assert everything(another.detect(two_busts())) == wanted
    another.close()


# ------------------------------------------------------------------------------------------------- where the cloud lies


@pytest.mark.parametrize("steps", [(1, 0, 0), (-2, 3, 1), (4, -4, -2)])
def test_moving_the_cloud_by_whole_voxels_moves_the_heads(make, steps):
    """The grid is cropped to what is occupied: that may not change what is found."""
    cloud = np.round(two_busts() / np.float32(0.0125)) * np.float32(0.0125) + np.float32(0.005)
    shift = np.array(steps) * 0.05
    detector = make(max_range_m=1.5, min_height_m=-1.0, max_height_m=1.0, min_score=-2.0)
    here, there = detector.detect(cloud), detector.detect((cloud + shift).astype(np.float32))
    assert len(here) > 1
    # Equal scores may change their order with rounding of nothing but the centres: they are integers in 1/1024.
    assert there.scores.tolist() == here.scores.tolist()
    np.testing.assert_allclose(there.centres, here.centres + shift, atol=1e-9)


@pytest.mark.parametrize("cascade", ["stages", "votes", "default"])
def test_single_points_far_away_change_nothing(make, cascade):
    """They widen the box that the grid is cropped to, up to the whole of it."""
    cloud = two_busts()
    far = np.array(
        [[-1.9, 0, 0], [1.9, 0, 0], [0, -1.9, 0], [0, 1.9, 0], [0, 0, -1.95], [0, 0, 1.95]], np.float32
    )
    settings = {"max_range_m": 2.0, "min_height_m": -2.0, "max_height_m": 2.0}
    settings["min_score"] = -2.0 if cascade == "stages" else 0.0
    detector = make(cascade, **settings)
    alone = detector.detect(cloud)
    widened = detector.detect(np.concatenate([cloud, far]))
    near = np.linalg.norm(widened.centres, axis=1) < 1.0
    assert widened.scores[near].tolist() == alone.scores.tolist()
    np.testing.assert_array_equal(widened.centres[near], alone.centres)


def test_a_wider_region_finds_the_same_heads(make):
    near = make(min_score=-2.0).detect(two_busts())
    wide = make(max_range_m=2.0, min_height_m=-1.0, max_height_m=1.5, min_score=-2.0).detect(two_busts())
    assert wide.scores.tolist() == near.scores.tolist()
    np.testing.assert_allclose(wide.centres, near.centres, atol=1e-9)


def test_a_world_far_from_its_origin(make):
    """Sensor coordinates are small; the world's may be as large as the earth's."""
    T = np.eye(4)
    here = make(min_score=-2.0).detect(two_busts(), T)
    T[:3, 3] = (4_000_000.0, -5_000_000.0, 0.0)
    there = make(min_score=-2.0, centre=(4_000_000.0, -5_000_000.0, 0.0)).detect(two_busts(), T)
    assert there.scores.tolist() == here.scores.tolist()
    np.testing.assert_allclose(there.centres - T[:3, 3], here.centres, atol=1e-6)


def test_the_region_is_about_the_sensors_unless_told(make):
    T = np.eye(4)
    T[:3, 3] = (3.0, -2.0, 0.1)
    heads = make(centre=None, min_score=-2.0).detect(two_busts(), T)
    assert len(heads) > 1
    with pytest.raises(HeadvoxError, match=r"within 0.7 m of \(0.00, 0.00, 0.00\)"):
        make(min_score=-2.0).detect(two_busts(), T)


def test_depth_and_its_cloud_find_the_same_voxels(make):
    """Occupancy alone, as a cloud knows no empty space, and values that round alike on both ways."""
    T = scenes.looking_along_x(-0.75, 0.0, 0.125)
    image = camera_frame().depths[0]
    camera = Intrinsics(48, 40, 32.0, 32.0, 24.0, 20.0, 1 / 1024)
    image = DepthImage("d", image.depth, camera, T)
    v, u = np.nonzero(image.depth)
    z = image.depth[v, u].astype(np.float64) / 1024
    points = np.column_stack([(u - 24) / 32 * z, (v - 20) / 32 * z, z]).astype(np.float32)
    detector = make("votes", refine="none", voxel_m=0.0625, min_score=-2.0)
    by_depth, by_cloud = detector.detect_depth(image), detector.detect(points, T)
    assert len(by_depth) > 0
    assert everything(by_depth) == everything(by_cloud)
