"""What a cascade is fitted to and checked with: views, and what is seen in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from headvox.data import DepthImage, Frame, Intrinsics
from headvox.evolve import views
from headvox.evolve.spoil import cut_off, spoil
from headvox.frames import inverse, transform
from headvox.synth.scene import TrueHead


def test_a_view_is_kept_on_disk_and_is_the_same_when_it_is_made_again(tmp_path, real_view):
    assert real_view.kind == "crowd"
    for _ in range(2):
        view = views.keep_view(tmp_path, 3, 9)
        assert view.number == 9
        for name in ("centres", "visible", "clear", "posture"):
            np.testing.assert_array_equal(getattr(view.heads, name), getattr(real_view.heads, name))
        assert view.heads.hair == real_view.heads.hair
        assert len(view.heads.hair) == len(view.heads.centres) > 0
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


def looking_level(centres: list[list[float]], visible: float = 0.8) -> views.View:
    """Heads before a camera of 40 by 30 pixels, each pixel of another depth."""
    camera = Intrinsics(40, 30, 40.0, 40.0, 19.5, 14.5, 0.001)
    depth = np.arange(1, 1201, dtype=np.uint16).reshape(30, 40)
    places, count = np.array(centres).reshape(-1, 3), len(centres)
    heads = views.Heads(places, np.full(count, visible), np.ones(count, bool), np.zeros(count, np.int64))
    return views.View(7, Frame(0, depths=(DepthImage("a", depth, camera, np.eye(4)),)), heads)


@pytest.mark.parametrize(
    ("centre", "side"), [([-0.3, 0, 1], 0), ([0.3, 0, 1], 1), ([0, -0.2, 1], 2), ([0, 0.2, 1], 3)]
)
def test_the_side_that_is_nearest_to_a_head_is_moved_as_far_as_it(centre, side):
    whole = looking_level([centre])
    (was,) = whole.frame.depths
    shares = []
    for seed in range(30):
        cut = cut_off(whole, np.random.default_rng(seed))
        (now,) = cut.frame.depths
        left, top = was.intrinsics.cx - now.intrinsics.cx, was.intrinsics.cy - now.intrinsics.cy
        lost = [left, 40 - now.intrinsics.width - left, top, 30 - now.intrinsics.height - top]
        assert [k for k in range(4) if lost[k]] in ([side], [])
        height, width = now.depth.shape
        assert (width, height) == (now.intrinsics.width, now.intrinsics.height)
        rows, columns = int(top) + np.arange(height), int(left) + np.arange(width)
        np.testing.assert_array_equal(now.depth, was.depth[np.ix_(rows, columns)])
        share = cut.heads.visible[0] / 0.8
        assert cut.heads.clear[0] == (share == 1.0)
        shares.append(share)
    assert 0.1 < min(shares) < 0.5 < 0.9 < max(shares) <= 1.0


def test_what_one_image_cuts_off_another_may_show():
    one = looking_level([[0.3, 0.0, 1.0]])
    (left,) = one.frame.depths
    moved = np.eye(4)
    moved[0, 3] = 0.3  # another camera, which has the head in its middle, and so another side to move
    both = replace(one, frame=Frame(0, depths=(left, replace(left, name="b", T_world_camera=moved))))
    cut = cut_off(both, np.random.default_rng(0))
    alone = cut_off(one, np.random.default_rng(0))
    assert alone.heads.visible[0] <= cut.heads.visible[0] <= 0.8


def test_a_view_of_nobody_is_cut_anywhere():
    cuts = {
        cut_off(looking_level([]), np.random.default_rng(k)).frame.depths[0].depth.shape for k in range(30)
    }
    assert len(cuts) > 10
    assert all(height == 30 or width == 40 for height, width in cuts)
    assert min(height * width for height, width in cuts) >= 0.6 * 1200
