import numpy as np
import pytest
import scenes
from scipy.spatial.transform import Rotation

from headvox.errors import HeadvoxError
from headvox.frames import as_rigid, inverse, placed, transform


@pytest.mark.parametrize("seed", range(5))
def test_inverse_undoes_a_transform(seed):
    rng = np.random.default_rng(seed)
    T = as_rigid(scenes.pose(rng, 10.0).tolist(), "T")
    points = rng.normal(size=(20, 3))
    np.testing.assert_allclose(transform(inverse(T), transform(T, points)), points, atol=1e-12)
    np.testing.assert_allclose(inverse(T) @ T, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(transform(T, points), (np.c_[points, np.ones(20)] @ T.T)[:, :3], atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_a_place_and_a_quaternion_are_a_transform(seed):
    rng = np.random.default_rng(seed)
    where, quaternion = rng.normal(size=3), 3.0 * rng.normal(size=4)
    T = as_rigid(placed(where, quaternion), "T")
    np.testing.assert_allclose(T[:3, :3], Rotation.from_quat(quaternion).as_matrix(), atol=1e-15)
    assert T[:3, 3].tolist() == where.tolist()
    assert placed((1, 2, 3), (0, 0, 0, -1)).tolist() == [
        [1, 0, 0, 1],
        [0, 1, 0, 2],
        [0, 0, 1, 3],
        [0, 0, 0, 1],
    ]


def changed(row, column, value):
    T = np.eye(4)
    T[row, column] = value
    return T


@pytest.mark.parametrize(
    ("matrix", "told"),
    [
        (np.eye(3), r"expected a 4x4 matrix, got shape \(3, 3\)"),
        ("north", "expected a 4x4 matrix"),
        (np.eye(4) + 1j, "expected a 4x4 matrix of real numbers"),
        (np.ma.array(np.eye(4), mask=np.eye(4)), "expected a 4x4 matrix of real numbers"),
        ([[1, 2], [3]], "expected a 4x4 matrix of real numbers"),
        (None, "expected a 4x4 matrix"),
        (changed(0, 3, np.nan), "NaN or infinite"),
        (changed(0, 0, np.inf), "NaN or infinite"),
        (changed(3, 0, 1.0), "the last row is"),
        (changed(0, 0, 2.0), "not a rotation"),
        (changed(0, 0, -1.0), "not a rotation"),
        (changed(0, 1, 0.1), "not a rotation"),
        (changed(0, 0, 0.0), "not a rotation"),
        (np.zeros((4, 4)), "the last row is"),
    ],
)
def test_what_is_no_rigid_transform(matrix, told):
    with pytest.raises(HeadvoxError, match=f"^T_world_camera: .*{told}"):
        as_rigid(matrix, "T_world_camera")


def test_extrinsics_typed_by_hand_are_good_enough():
    c, s = round(np.cos(0.3), 4), round(np.sin(0.3), 4)
    T = np.array([[c, -s, 0, 1], [s, c, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    np.testing.assert_array_equal(as_rigid(T, "T"), T)
