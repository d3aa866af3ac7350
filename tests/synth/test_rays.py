import numpy as np
import pytest
from scipy import ndimage

from headvox.data import Intrinsics
from headvox.frames import inverse, transform
from headvox.synth.furniture import item
from headvox.synth.mounts import camera_pose
from headvox.synth.rays import Mesh, join, look, spin
from headvox.synth.solids import box, ellipsoid

LENS = Intrinsics(64, 48, 50.0, 50.0, 31.5, 23.5)


def naive_hits(mesh, origin, rays):
    """Möller-Trumbore, every ray against every triangle: nearest distance in units of the ray's length."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    best = np.full(len(rays), np.inf)
    for k, ray in enumerate(rays):
        p = np.cross(ray, c - a)
        det = ((b - a) * p).sum(1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = ((origin - a) * p).sum(1) / det
            q = np.cross(origin - a, b - a)
            v = (q @ ray) / det
            t = ((c - a) * q).sum(1) / det
            hit = (np.abs(det) > 1e-12) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0.02)
        if hit.any():
            best[k] = t[hit].min()
    return best


@pytest.fixture(scope="module")
def clutter():
    thing = item("thing", (box((0.4, 0.5, 0.6)), 0.5), (ellipsoid((0.2, 0.3, 0.2), (0.0, 0.0, 0.9)), 0.3))
    things = [thing.placed(1.9 * np.cos(k), 1.9 * np.sin(k), 2.3 * k) for k in range(6)]
    room = item("room", (box((7.0, 7.0, 3.0), (0.0, 0.0, -0.1)), 0.5))  # the camera stands inside a box
    return join([room.mesh(0), *(thing.mesh(k + 1) for k, thing in enumerate(things))])


def test_a_camera_hits_what_the_naive_ray_caster_hits(clutter):
    pose = camera_pose((0.3, -0.2, 1.1), 2.3, 0.3, 0.05)
    view = look(clutter, LENS, pose)
    v, u = np.mgrid[: LENS.height, : LENS.width]
    optical = np.stack([(u - LENS.cx) / LENS.fx, (v - LENS.cy) / LENS.fy, np.ones(u.shape)], -1).reshape(
        -1, 3
    )
    expected = naive_hits(clutter, pose[:3, 3], optical @ pose[:3, :3].T)
    np.testing.assert_allclose(view.distance_m.ravel(), expected, rtol=1e-5)
    assert len(np.unique(view.ids)) > 2


def test_a_lidar_hits_what_the_naive_ray_caster_hits(clutter):
    pose = camera_pose((0.3, -0.2, 1.1), 0.0, 0.0) @ inverse(camera_pose((0.0, 0.0, 0.0), 0.0, 0.0))
    view, rays = spin(clutter, np.linspace(-0.5, 0.4, 12), 120, pose)
    expected = naive_hits(clutter, pose[:3, 3], rays.reshape(-1, 3) @ pose[:3, :3].T)
    np.testing.assert_allclose(view.distance_m.ravel(), expected, rtol=1e-5)


def test_neighbouring_triangles_leave_no_cracks():
    ball = item("ball", (ellipsoid((0.5, 0.5, 0.5), (2.0, 0.0, 0.0), 40), 0.5)).mesh(1)
    seen = (
        look(
            ball, Intrinsics(400, 400, 500.0, 500.0, 199.5, 199.5), camera_pose((0.0, 0.0, 0.0), 0.0, 0.0)
        ).ids
        == 1
    )
    assert seen.sum() > 40_000
    np.testing.assert_array_equal(seen, ndimage.binary_fill_holes(seen))


def test_incidence_and_albedo_come_from_the_face_that_is_hit():
    wall = item("wall", (box((0.1, 4.0, 4.0), (2.05, 0.0, -2.0)), 0.37)).mesh(5)
    view = look(wall, LENS, camera_pose((0.0, 0.0, 0.0), 0.0, 0.0))
    centre = view.distance_m[23:25, 31:33]
    np.testing.assert_allclose(centre, 2.0, atol=1e-6)
    np.testing.assert_allclose(view.albedo[view.ids == 5], 0.37, atol=1e-6)
    off_axis = np.arctan2(31.5 - 11, 50.0)
    assert view.cosine[23, 11] == pytest.approx(np.cos(off_axis), abs=1e-3)


def test_an_empty_scene_is_seen_as_nothing():
    view = look(join([]), LENS, np.eye(4))
    assert np.isinf(view.distance_m).all()
    assert (view.ids == -1).all()


def test_join_keeps_order_and_shifts_faces():
    one = Mesh(np.eye(3), np.array([[0, 1, 2]], np.int32), np.ones(1, np.float32), np.zeros(1, np.int32))
    both = join([one, one])
    np.testing.assert_array_equal(both.faces, [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(transform(np.eye(4), both.vertices), np.vstack([np.eye(3), np.eye(3)]))
