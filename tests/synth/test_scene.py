import hashlib
from dataclasses import replace

import numpy as np
import pytest

from headvox.frames import inverse, transform
from headvox.synth import mannequin, presets
from headvox.synth.actors import place_person
from headvox.synth.camera import IDEAL, Lidar, kinect
from headvox.synth.floorplan import FloorPlan
from headvox.synth.furniture import item
from headvox.synth.motion import RATE_HZ, Moment, between, live
from headvox.synth.mounts import Camera, PlacedLidar, camera_pose, lens
from headvox.synth.people import HAIR
from headvox.synth.poses import Pose
from headvox.synth.room import sample_room
from headvox.synth.scene import POSTURES, sample_scene, training_view
from headvox.synth.solids import box


def ideal(scene):
    scene.cameras = [replace(camera, sensor=IDEAL) for camera in scene.cameras]
    return scene


def digest(frame, heads):
    made = hashlib.sha256()
    for depth in frame.depths:
        made.update(depth.depth.tobytes())
        made.update(depth.T_world_camera.tobytes())
    made.update(
        repr([(h.id, h.centre.tolist(), h.quaternion.tolist(), h.visible, h.ignore) for h in heads]).encode()
    )
    return made.hexdigest()


def test_true_heads_project_to_their_pixels_and_lie_just_behind_the_surface():
    checked = 0
    for seed in range(40):
        frame, heads = ideal(sample_scene(np.random.default_rng(seed), mannequin, moving=False)).frame(0)
        for depth in frame.depths:
            lens_ = depth.intrinsics
            for head in heads:
                if head.posture == "mannequin" or head.truncated or head.visible[depth.name] < 0.9:
                    continue
                x, y, z = transform(inverse(depth.T_world_camera), head.centre[None])[0]
                u, v = round(lens_.fx * x / z + lens_.cx), round(lens_.fy * y / z + lens_.cy)
                behind = z - depth.depth[v, u] * lens_.depth_scale
                assert 0.04 < behind < 0.16, (seed, head)
                checked += 1
    assert checked > 10


def test_the_same_seed_gives_the_same_view_and_another_seed_another():
    first = [digest(*training_view(seed, mannequin)) for seed in (1, 2, 3)]
    assert first == [digest(*training_view(seed, mannequin)) for seed in (1, 2, 3)]
    assert len(set(first)) == 3


def test_scenes_cover_sensors_postures_and_empty_rooms():
    scenes = [sample_scene(np.random.default_rng(seed), mannequin, moving=False) for seed in range(80)]
    assert 0.12 < np.mean([not scene.actors for scene in scenes]) < 0.4
    cameras = [camera for scene in scenes for camera in scene.cameras]
    assert {(c.intrinsics.width, c.intrinsics.height) for c in cameras} == {
        (640, 480),
        (848, 480),
        (424, 240),
    }
    assert {c.sensor.name for c in cameras} == {"kinect", "d435i"}
    heights = np.array([camera.T_world_camera[2, 3] for camera in cameras])
    assert heights.min() > 0.29
    assert heights.max() < 2.61
    postures = [actor.moments[0].pose.posture for scene in scenes for actor in scene.actors]
    assert set(postures) <= set(POSTURES)
    assert 0.65 < np.mean([posture in ("standing", "walking", "sitting") for posture in postures]) < 0.95


def test_most_heads_of_training_views_are_seen():
    heads = [h for seed in range(12) for h in training_view(seed, mannequin)[1] if h.posture != "mannequin"]
    assert np.mean([not head.ignore for head in heads]) > 0.5


def staged(sensor=IDEAL, hair_albedo=None, wall_at=None, yaw=0.0):
    """One standing mannequin 2.5 m in front of a camera; a wall between them at ``wall_at``."""
    rng = np.random.default_rng(4)
    scene = sample_scene(rng, mannequin, postures=["standing"], moving=False)
    actor = scene.actors[0]
    person = actor.person if hair_albedo is None else replace(actor.person, hair_albedo=hair_albedo)
    moment = Moment(Pose("standing"), (2.5, 0.0), 0.0)  # seen from behind
    scene.actors = [replace(actor, person=person, moments=[moment])]
    scene.room.items = [item("floor", (box((9.0, 9.0, 0.1), (0.0, 0.0, -0.1)), 0.5))]
    scene.room.dummies = []
    if wall_at is not None:
        scene.room.items.append(item("wall", (box((0.1, 4.0, 3.0), (wall_at, 0.0, 0.0)), 0.5)))
    scene.cameras = [Camera("front", lens("kinect"), camera_pose((0.0, 0.0, 1.5), yaw, 0.0), sensor)]
    return scene


def test_a_head_in_plain_sight_is_visible_and_one_behind_a_wall_is_ignored():
    (head,) = staged().frame(0)[1]
    assert head.visible["front"] > 0.9
    assert not head.ignore
    assert not head.truncated
    (hidden,) = staged(wall_at=1.5).frame(0)[1]
    assert hidden.visible["front"] == 0.0
    assert hidden.ignore


def test_a_head_cut_by_the_border_is_truncated_and_one_out_of_the_image_is_ignored():
    half_width = np.arctan2(320.0, lens("kinect").fx)
    (cut,) = staged(yaw=half_width).frame(0)[1]
    assert cut.truncated
    assert 0.2 < cut.visible["front"] < 0.8
    (outside,) = staged(yaw=half_width + 0.2).frame(0)[1]
    assert outside.visible["front"] == 0.0
    assert outside.ignore


def test_dark_hair_loses_more_returns_than_fair_hair():
    def lost(hair_albedo):
        scene = staged(replace(kinect(), weak=0.15, edge_holes=0.0), hair_albedo)
        body = scene.actors[0].body(mannequin, 0)
        view = scene.views(0)[0]
        depth = scene.frame(0)[0].depths[0].depth
        albedo = np.float32(0.03 + 0.6 * hair_albedo)
        hair = (view.ids == 2 * scene.actors[0].id) & (view.albedo == albedo)
        assert (body.materials == HAIR).any()
        assert hair.sum() > 300
        return (depth[hair] == 0).mean()

    assert lost(0.02) > 0.2
    assert lost(0.8) < 0.05


def test_a_lidar_sees_heads_too():
    scene = staged()
    pose = np.eye(4)
    pose[2, 3] = 1.5
    scene.lidars = [PlacedLidar(Lidar(rings=64, columns=1024, lost=0.0), pose)]
    frame, (head,) = scene.frame(0)
    assert frame.clouds[0].points.shape == (64 * 1024, 3)
    assert head.visible["lidar"] > 0.8
    near = (
        np.linalg.norm(frame.clouds[0].points + pose[:3, 3].astype(np.float32) - head.centre, axis=1) < 0.16
    )
    assert near.sum() > 20


def test_people_neither_stand_in_furniture_nor_in_each_other():
    for seed in range(8):
        rng = np.random.default_rng(seed)
        room = sample_room(rng, clutter=0.6)
        before = room.plan.copy()
        plan = before.copy()
        for posture in ("standing", "bending", "crouching", "walking"):
            actor = place_person(rng, mannequin, room, 1, posture)
            if actor is not None:
                ground = actor.body(mannequin, 0).vertices[:, :2]
                assert before.conflict(ground) < 0.03
                assert plan.conflict(ground) < 0.03
                plan.take(ground, by_person=True)


def test_who_sits_has_a_seat_right_below():
    rng = np.random.default_rng(0)
    found = 0
    for _ in range(12):
        room = sample_room(rng, clutter=0.0)
        walls = len(room.items)
        actor = place_person(rng, mannequin, room, 1, "sitting")
        if actor is None or len(room.items) == walls:
            continue
        assert room.items[walls].name in ("chair", "sofa")
        hips = np.array(actor.moments[0].xy)
        seat = room.items[walls].vertices
        assert np.linalg.norm(seat[:8, :2].mean(axis=0) - hips) < 0.45
        found += 1
    assert found > 6


def test_walkers_walk_keep_apart_and_stay_on_the_free_floor():
    scene = presets.crowd(1, mannequin, duration_s=8.0)
    paths = np.array([[moment.xy for moment in actor.moments] for actor in scene.actors])
    speed = np.linalg.norm(np.diff(paths, axis=1), axis=2) * RATE_HZ
    assert speed.max() < 1.5
    assert (speed[:3].sum(axis=1) / RATE_HZ > 1.0).all()
    apart = np.linalg.norm(paths[:, None] - paths[None], axis=-1)
    assert apart[~np.eye(len(paths), dtype=bool)].min() > 0.4
    for path in paths[:3]:
        i, j = np.floor((path - scene.room.plan.origin) / 0.05).astype(int).T
        assert scene.room.plan.taken[i, j].mean() < 0.02


def test_heads_move_smoothly():
    scene = presets.two_cameras(0, mannequin, duration_s=3.0)
    stamps = [round(k * 1e9 / RATE_HZ) for k in range(80)]
    centres = np.array([scene.actors[0].body(mannequin, stamp).T_world_head[:3, 3] for stamp in stamps])
    assert np.linalg.norm(np.diff(centres, axis=0), axis=1).max() < 0.08


def test_the_paper_s_rig_and_turn():
    rig = presets.two_cameras(0, mannequin, duration_s=1.0).cameras
    positions = np.array([camera.T_world_camera[:3, 3] for camera in rig])
    assert np.linalg.norm(positions[0] - positions[1]) == pytest.approx(4.0)
    np.testing.assert_allclose(positions[:, 2], 1.65)
    moments = presets.turn(0, mannequin, duration_s=2.0).actors[0].moments
    assert moments[30].heading_rad - moments[0].heading_rad == pytest.approx(np.radians(12.0))


def test_frames_do_not_depend_on_the_order_they_are_asked_in():
    forward, backward = (presets.two_cameras(2, mannequin, duration_s=1.0) for _ in range(2))
    stamps = [0, 100_000_000, 200_000_000]
    first = [digest(*forward.frame(stamp)) for stamp in stamps]
    last = [digest(*backward.frame(stamp)) for stamp in reversed(stamps)]
    assert first == last[::-1]


def test_poses_blend_from_one_end_to_the_other():
    rng = np.random.default_rng(0)
    sitting, standing = (mannequin.sample_pose(rng, name) for name in ("sitting", "standing"))
    assert between(sitting, standing, 0.0) == replace(sitting)
    assert between(sitting, standing, 1.0).arms == standing.arms
    assert between(sitting, standing, 0.6).posture == "standing"


def test_an_unknown_act_is_an_error():
    from headvox.errors import HeadvoxError

    scene = staged()
    with pytest.raises(HeadvoxError, match="'dance'"):
        live(np.random.default_rng(0), mannequin, scene.room.plan, scene.actors[0].moments, ["dance"], 3)


def test_the_floor_plan_counts_outside_as_taken():
    plan = FloorPlan(4.0, 4.0)
    assert plan.conflict(np.array([[0.0, 0.0], [3.0, 0.0]])) == 0.5
    plan.take(np.array([[0.0, 0.0]]))
    assert plan.conflict(np.array([[0.01, 0.01]])) == 1.0


def test_the_real_people_fit_the_same_scene():
    frame, heads = training_view(7)
    assert digest(frame, heads) == digest(*training_view(7))
