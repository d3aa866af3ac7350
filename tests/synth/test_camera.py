from dataclasses import replace

import numpy as np
import pytest

from headvox.data import Intrinsics
from headvox.frames import unproject
from headvox.synth.camera import IDEAL, Lidar, d435i, kinect, measure, noise_field, sweep
from headvox.synth.furniture import item
from headvox.synth.mounts import camera_pose, lens
from headvox.synth.rays import View, look
from headvox.synth.solids import box

LENS = Intrinsics(320, 240, 215.0, 215.0, 159.5, 119.5)
CLEAN = replace(IDEAL, baseline_m=0.05)


def flat_wall(distance_m, albedo=0.5, shape=(240, 320)):
    """A wall square to the axis, seen everywhere under a right angle."""
    full = np.full(shape, 1.0, np.float32)
    return View(full * distance_m, np.zeros(shape, np.int32), full * albedo, full, 0 * full)


def generators(frame=0):
    return np.random.default_rng(11), np.random.default_rng([11, frame])


@pytest.mark.parametrize("distance_m", [1.0, 2.0, 3.0, 4.0])
def test_depth_noise_follows_its_formula(distance_m):
    sensor = replace(CLEAN, noise_px=0.08, noise_size_px=2.0)
    spread = []
    for frame in range(4):
        depth = measure(flat_wall(distance_m), LENS, sensor, *generators(frame)) * LENS.depth_scale
        spread.append(depth.std())
        assert depth.mean() == pytest.approx(distance_m, abs=0.01 * distance_m**2)
    theory = distance_m**2 * 0.08 / (LENS.fx * sensor.baseline_m)
    assert np.mean(spread) == pytest.approx(theory, rel=0.15)


@pytest.mark.parametrize("distance_m", [1.0, 2.0, 3.0, 4.0])
def test_the_d435i_preset_as_a_whole_keeps_to_the_formula(distance_m):
    sensor, intrinsics = d435i(), lens("d435i")
    spread = []
    for frame in range(2):
        view = flat_wall(distance_m, albedo=0.6, shape=(480, 848))
        depth = measure(view, intrinsics, sensor, *generators(frame))[40:-40, 40:-40] * intrinsics.depth_scale
        assert (depth == 0.0).mean() < 0.005
        spread.append(depth[depth > 0.0].std())
    theory = distance_m**2 * sensor.noise_px / (intrinsics.fx * sensor.baseline_m)
    assert np.mean(spread) == pytest.approx(theory, rel=0.06)


def test_noise_is_shared_by_neighbours_but_not_across_the_image():
    field = noise_field(np.random.default_rng(0), (200, 300), 3.0)
    assert field.std() == pytest.approx(1.0, rel=0.15)
    assert np.corrcoef(field[:, :-1].ravel(), field[:, 1:].ravel())[0, 1] > 0.9
    assert abs(np.corrcoef(field[:, :-40].ravel(), field[:, 40:].ravel())[0, 1]) < 0.15


def test_depth_comes_in_steps_of_disparity():
    sensor = replace(CLEAN, noise_px=0.3, step_px=1.0 / 8.0)
    depth = measure(flat_wall(3.0), LENS, sensor, *generators())
    steps = LENS.fx * sensor.baseline_m / (np.unique(depth) * LENS.depth_scale) * 8.0
    assert len(steps) > 5
    np.testing.assert_allclose(steps, np.rint(steps), atol=0.01)


@pytest.mark.parametrize("baseline_m", [0.05, -0.05])
def test_the_second_imager_casts_a_shadow_of_the_right_width_on_the_right_side(baseline_m):
    view = flat_wall(3.0)
    view.distance_m[80:160, 120:200] = 1.0
    sensor = replace(CLEAN, baseline_m=baseline_m, shadow=True, step_px=1e-4)
    hole = measure(view, LENS, sensor, *generators())[120] == 0
    width = LENS.fx * 0.05 * (1.0 / 1.0 - 1.0 / 3.0)
    assert hole.sum() == pytest.approx(width, abs=2.0)
    beside = np.flatnonzero(hole)
    assert beside.max() == 119 if baseline_m > 0 else beside.min() == 200


def test_flying_pixels_lie_between_and_only_at_edges():
    view = flat_wall(3.0)
    view.distance_m[:, 160:] = 1.0
    depth = measure(view, LENS, replace(CLEAN, flying=0.5, step_px=1e-4), *generators()) * LENS.depth_scale
    between = (depth > 1.05) & (depth < 2.95)
    assert between.any()
    assert not between[:, :150].any()
    assert not between[:, 170:].any()


def test_dark_slanted_and_far_surfaces_lose_returns():
    sensor = replace(d435i(), edge_holes=0.0, salt=0.0, shadow=False)

    def lost(distance_m, albedo, cosine=1.0):
        view = flat_wall(distance_m, albedo)
        return (
            measure(replace(view, cosine=view.cosine * np.float32(cosine)), LENS, sensor, *generators()) == 0
        ).mean()

    assert lost(2.0, 0.6) < 0.01
    assert lost(2.0, 0.6) <= lost(3.0, 0.05) < lost(5.0, 0.05) <= 1.0
    assert lost(4.0, 0.03) > 0.3
    assert lost(5.0, 0.3, cosine=0.05) > lost(5.0, 0.3)


def test_holes_of_a_still_scene_mostly_stay_and_partly_flicker():
    sensor = replace(d435i(), weak=0.1)
    first, second = (measure(flat_wall(4.0, 0.05), LENS, sensor, *generators(k)) == 0 for k in (1, 2))
    assert not np.array_equal(first, second)
    assert np.corrcoef(first.ravel(), second.ravel())[0, 1] > 0.5


def test_salt_border_and_range_are_cut():
    wall = flat_wall(3.0)
    salty = measure(wall, LENS, replace(CLEAN, salt=0.02, step_px=1e-4), *generators()) == 0
    assert 0.005 < salty.mean() < 0.1
    framed = measure(wall, LENS, replace(CLEAN, border_px=(5, 8, 3, 2), step_px=1e-4), *generators())
    assert (framed[3:238, 5:312] > 0).all()
    assert (framed > 0).sum() == 235 * 307
    assert (measure(wall, LENS, replace(CLEAN, far_m=2.9), *generators()) == 0).all()
    assert (measure(wall, LENS, replace(CLEAN, near_m=3.1), *generators()) == 0).all()


def test_the_ideal_camera_is_exact_and_nothing_is_no_return():
    scene = item("box", (box((1.0, 1.0, 1.0), (3.5, 0.0, -0.5)), 0.5)).mesh()
    pose = camera_pose((0.0, 0.0, 0.0), 0.0, 0.0)
    depth = measure(look(scene, LENS, pose), LENS, IDEAL, *generators())
    assert set(np.unique(depth)) == {0, 3000}
    points = unproject(depth, LENS, pose)
    np.testing.assert_allclose(points[:, 0], 3.0, atol=1e-9)
    assert np.abs(points[:, 1:]).max() == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("kind", [d435i, kinect])
def test_a_sampled_sensor_is_drawn_anew_and_measures_the_same_twice(kind):
    sensors = [kind(np.random.default_rng(seed)) for seed in range(20)]
    assert len({sensor.weak for sensor in sensors}) == 20
    wall = flat_wall(2.5, shape=(120, 160))
    for sensor in sensors:
        once, again = (measure(wall, LENS, sensor, *generators()) for _ in range(2))
        np.testing.assert_array_equal(once, again)
        assert once.dtype == np.uint16


def test_a_lidar_gives_a_cloud_in_its_own_frame_with_lost_beams_as_nan():
    shell = item("room", (box((8.0, 6.0, 3.0), (0.0, 0.0, -1.0)), 0.5)).mesh()
    cloud, view = sweep(shell, Lidar(rings=8, columns=90), np.eye(4), np.random.default_rng(0))
    assert cloud.points.shape == (8 * 90, 3)
    assert cloud.points.dtype == np.float32
    kept = np.isfinite(cloud.points[:, 0])
    assert 0.8 < kept.mean() < 1.0
    error = np.linalg.norm(cloud.points[kept], axis=1) - view.distance_m.ravel()[kept]
    assert error.std() == pytest.approx(0.015, rel=0.3)


def test_an_unknown_lens_is_named_an_error():
    from headvox.errors import HeadvoxError

    with pytest.raises(HeadvoxError, match="d435i-vga"):
        lens("zed")


def test_a_highlight_blinds_only_what_faces_the_camera():
    sensor = replace(CLEAN, name="weak", weak=0.02, noise_px=0.01)
    lens = Intrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)

    def lost(gloss, cosine):
        wall = flat_wall(1.5)
        wall = replace(wall, gloss=wall.gloss + np.float32(gloss), cosine=wall.cosine * np.float32(cosine))
        return np.mean(measure(wall, lens, sensor, np.random.default_rng(0), np.random.default_rng(1)) == 0)

    assert lost(0.0, 1.0) == 0.0
    assert lost(0.5, 1.0) > 0.5
    assert lost(0.5, np.cos(np.radians(25))) < 0.01
    assert lost(0.5, np.cos(np.radians(45))) == 0.0


def test_glossy_hair_returns_less_than_matt_hair_of_the_same_albedo():
    sensor = replace(CLEAN, name="weak", weak=0.1, noise_px=0.01)
    lens = Intrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)
    matt = replace(flat_wall(4.0, albedo=0.09), cosine=np.full((240, 320), 0.8, np.float32))
    glossy = replace(matt, gloss=np.full((240, 320), 0.6, np.float32))
    holes = [
        np.mean(measure(wall, lens, sensor, np.random.default_rng(0), np.random.default_rng(1)) == 0)
        for wall in (matt, glossy)
    ]
    assert holes[1] > holes[0] + 0.2
