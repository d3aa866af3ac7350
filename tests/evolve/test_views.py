"""What a cascade is fitted to and checked with: views, and what is seen in them."""

from __future__ import annotations

import numpy as np

from headvox.data import DepthImage, Intrinsics
from headvox.evolve import views
from headvox.evolve.spoil import spoil
from headvox.frames import inverse, transform
from headvox.synth.scene import TrueHead


def test_a_view_is_kept_on_disk_and_is_the_same_when_it_is_made_again(tmp_path, real_view):
    assert real_view.kind == "crowd"
    for _ in range(2):
        view = views.keep_view(tmp_path, 3, 9)
        assert view.number == 9
        for name in ("centres", "visible", "clear", "posture"):
            np.testing.assert_array_equal(getattr(view.heads, name), getattr(real_view.heads, name))
        assert len(view.frame.depths) == len(real_view.frame.depths) > 0
        for mine, made in zip(view.frame.depths, real_view.frame.depths, strict=True):
            np.testing.assert_array_equal(mine.depth, made.depth)
            np.testing.assert_array_equal(mine.T_world_camera, made.T_world_camera)
            assert mine.intrinsics == made.intrinsics
    assert [path.name for path in tmp_path.iterdir()] == ["000009.npz"]


def test_every_kind_of_view_can_be_made():
    first = {kind: views.KINDS.index(kind) for kind in views.KINDS}
    made = {kind: views.make_view(1, number) for kind, number in first.items()}
    assert not made["nobody"].heads.clear.any()  # a dummy may stand there
    assert made["bodies"].frame.clouds[0].T_world_sensor is None
    assert made["bodies"].heads.clear.all()
    shell, centre = made["shell"].frame.clouds[0].points, made["shell"].heads.centres[0]
    assert len(shell) == views.SHELL_POINTS
    assert np.abs((shell.min(axis=0) + shell.max(axis=0)) / 2 - centre).max() < 0.05
    assert made["ordinary"].frame.depths


def test_a_camera_whose_image_is_cut_off_before_a_head_does_not_see_it() -> None:
    camera = Intrinsics(4, 4, 4.0, 4.0, 1.5, 1.5, 0.001)
    images = [
        DepthImage(name, np.full((4, 4), 3000, np.uint16), camera, np.eye(4)) for name in ("near", "far")
    ]
    seen_by, upright = {"near": 0.9, "far": 0.5}, np.array([0.0, 0.0, 0.0, 1.0])
    truth = [
        TrueHead(k, np.array([0.0, 0.0, z]), upright, "standing", seen_by, False, False)
        for k, z in enumerate((2.0, 3.0, 4.5))
    ]
    heads = views._heads_of(truth, images, {"near": 2.5, "far": 4.0})
    assert heads.visible.tolist() == [0.9, 0.5, 0.0]
    assert heads.clear.tolist() == [True, True, False]


def test_a_spoilt_view_is_the_same_view_from_a_worse_sensor(real_view):
    lost, tilted = [], []
    for seed in range(12):
        spoilt = spoil(real_view, np.random.default_rng(seed))
        same = spoil(real_view, np.random.default_rng(seed))
        lost.append(0)
        for was, now, again_ in zip(
            real_view.frame.depths, spoilt.frame.depths, same.frame.depths, strict=True
        ):
            np.testing.assert_array_equal(now.depth, again_.depth)
            kept = now.depth > 0
            np.testing.assert_array_equal(now.depth[kept], was.depth[kept])
            lost[-1] += int((was.depth > 0).sum() - kept.sum())
            np.testing.assert_allclose(
                transform(inverse(now.T_world_camera), spoilt.heads.centres),
                transform(inverse(was.T_world_camera), real_view.heads.centres),
                atol=1e-9,
            )
            tilted.append(np.linalg.norm(now.T_world_camera[2, :3] - was.T_world_camera[2, :3]))
            np.testing.assert_allclose(now.T_world_camera[2, 3], was.T_world_camera[2, 3], atol=0.21)
    assert min(lost) == 0 < max(lost)
    assert 0.0 < min(tilted) < 0.07 < max(tilted) < 0.25  # radians
