import threading
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from headvox.ros.transforms import NoTransform, TransformBuffer

S = 1_000_000_000
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


def matrix(translation, quaternion):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    T[:3, 3] = translation
    return T


def random_place(rng):
    return rng.normal(size=3), Rotation.random(random_state=rng).as_quat()


def test_a_chain_of_static_and_moving_frames_adds_up():
    rng = np.random.default_rng(0)
    buffer = TransformBuffer()
    map_odom, odom_base, base_camera, map_tag = (random_place(rng) for _ in range(4))
    buffer.set("map", "odom", 5 * S, *map_odom)
    buffer.set("odom", "base", 5 * S, *odom_base)
    buffer.set("base", "camera", 0, *base_camera, is_static=True)
    buffer.set("map", "tag", 0, *map_tag, is_static=True)
    T_map_camera = matrix(*map_odom) @ matrix(*odom_base) @ matrix(*base_camera)
    np.testing.assert_allclose(buffer.lookup("map", "camera", 5 * S), T_map_camera, atol=1e-12)
    np.testing.assert_allclose(buffer.lookup("camera", "map", 5 * S), np.linalg.inv(T_map_camera), atol=1e-12)
    T_tag_camera = np.linalg.inv(matrix(*map_tag)) @ T_map_camera
    np.testing.assert_allclose(buffer.lookup("/tag", "/camera", 5 * S), T_tag_camera, atol=1e-12)
    np.testing.assert_allclose(buffer.lookup("base", "camera", 77 * S), matrix(*base_camera), atol=1e-12)
    np.testing.assert_array_equal(buffer.lookup("camera", "camera", 1), np.eye(4))


@pytest.mark.parametrize("seed", range(20))
def test_between_two_stamps_it_is_linear_and_along_the_arc(seed):
    rng = np.random.default_rng(seed)
    buffer = TransformBuffer()
    stamps = np.sort(rng.choice(1000, 8, replace=False)) * 7_000_001
    places = [random_place(rng) for _ in stamps]
    if seed == 0:
        places = [(t, LEVEL * (1 if k % 2 else -1)) for k, (t, _) in enumerate(places)]  # q and -q: no turn
    for k in rng.permutation(8):  # they come in any order
        buffer.set("world", "head", int(stamps[k]), *places[k])
    slerp = Slerp(stamps, Rotation.from_quat([q for _, q in places]))
    for stamp in rng.integers(stamps[0], stamps[-1] + 1, 50):
        T = buffer.lookup("world", "head", int(stamp))
        np.testing.assert_allclose(T[:3, :3], slerp(stamp).as_matrix(), atol=1e-6)
        for axis in range(3):
            wanted = np.interp(stamp, stamps, [t[axis] for t, _ in places])
            assert T[axis, 3] == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize(
    ("target", "source", "stamp", "what", "hopeless"),
    [
        ("world", "nowhere", S, "Frame 'nowhere' is not in", True),
        ("nowhere", "camera", S, "Frame 'nowhere' is not in", True),
        ("world", "", S, "Frame '' is not in", True),
        ("world", "island", S, "not connected", True),
        ("world", "camera", S + 1, "older than the reading", False),
        ("world", "camera", 3 * S, "older than the reading", True),
        ("world", "camera", 0, "newer than the reading", True),
        ("world", "loop_a", S, "loop", True),
    ],
)
def test_what_is_not_known_is_never_identity(target, source, stamp, what, hopeless):
    buffer = TransformBuffer()
    buffer.set("world", "camera", S // 2, np.zeros(3), LEVEL)
    buffer.set("world", "camera", S, np.zeros(3), LEVEL)
    buffer.set("sea", "island", S, np.zeros(3), LEVEL)
    buffer.set("loop_a", "loop_b", S, np.zeros(3), LEVEL)
    buffer.set("loop_b", "loop_a", S, np.zeros(3), LEVEL)
    with pytest.raises(NoTransform) as refused:
        buffer.lookup(target, source, stamp)
    assert what in refused.value.what
    assert refused.value.hopeless is hopeless


@pytest.mark.parametrize(
    ("parent", "child", "translation", "quaternion"),
    [
        ("world", "camera", [np.nan, 0, 0], LEVEL),
        ("world", "camera", [0, np.inf, 0], LEVEL),
        ("world", "camera", [0, 0, 0], np.zeros(4)),
        ("world", "camera", [0, 0, 0], np.full(4, np.nan)),
        ("world", "camera", [0, 0, 0], [0, 0, 0, 1.1]),
        ("world", "world", [0, 0, 0], LEVEL),
        ("", "camera", [0, 0, 0], LEVEL),
        ("world", "/", [0, 0, 0], LEVEL),
    ],
)
def test_what_is_no_transform_is_refused_and_counted(parent, child, translation, quaternion):
    buffer = TransformBuffer()
    buffer.set(parent, child, S, np.array(translation, float), np.array(quaternion, float))
    assert buffer.refused == 1
    with pytest.raises(NoTransform):
        buffer.lookup("world", "camera", S)


def test_it_keeps_only_the_last_seconds():
    buffer = TransformBuffer(keep_s=2.0)
    for k in range(100_000):
        buffer.set("world", "camera", k * S // 1000, np.zeros(3), LEVEL)
    buffer.lookup("world", "camera", 99 * S)
    with pytest.raises(NoTransform):
        buffer.lookup("world", "camera", 90 * S)
    assert len(buffer._edges["camera"].stamps) <= 4001


def test_the_latest_static_place_and_the_latest_parent_count():
    buffer = TransformBuffer()
    for x in (1.0, 2.0):
        buffer.set("world", "camera", 0, np.array([x, 0, 0]), LEVEL, is_static=True)
    assert buffer.lookup("world", "camera", 5 * S)[0, 3] == 2.0
    buffer.set("robot", "camera", S, np.array([3.0, 0, 0]), LEVEL)
    with pytest.raises(NoTransform):
        buffer.lookup("world", "camera", S)
    assert buffer.lookup("robot", "camera", S)[0, 3] == 3.0


def test_a_jump_is_where_it_is_said_to_be():
    buffer = TransformBuffer()
    for k in range(10):
        buffer.set("world", "camera", k * S // 10, np.array([0.0 if k < 5 else 9.0, 0, 0]), LEVEL)
    assert buffer.lookup("world", "camera", 4 * S // 10)[0, 3] == 0.0
    assert buffer.lookup("world", "camera", 5 * S // 10)[0, 3] == 9.0


def test_forgetting_what_moves_keeps_what_is_static():
    buffer = TransformBuffer()
    buffer.set("world", "base", 50 * S, np.zeros(3), LEVEL)
    buffer.set("base", "camera", 0, np.ones(3), LEVEL, is_static=True)
    buffer.forget_moving()
    with pytest.raises(NoTransform):
        buffer.lookup("world", "camera", 50 * S)
    buffer.set("world", "base", S, np.zeros(3), LEVEL)
    assert buffer.lookup("world", "camera", S)[0, 3] == 1.0


def test_waiting_ends_when_it_comes_when_time_is_up_and_when_told():
    buffer = TransformBuffer()
    buffer.set("world", "camera", 0, np.zeros(3), LEVEL)
    threading.Timer(0.1, buffer.set, ("world", "camera", S, np.ones(3), LEVEL)).start()
    assert buffer.wait_for("world", "camera", S, 10.0)[0, 3] == 1.0
    for wanted, stop in ((0.1, lambda: False), (0.0, lambda: True)):
        begun = time.monotonic()
        with pytest.raises(NoTransform):
            buffer.wait_for("world", "camera", S + 1, 0.1, stop)
        assert wanted <= time.monotonic() - begun < wanted + 2.0
    begun = time.monotonic()
    with pytest.raises(NoTransform):
        buffer.wait_for("world", "nowhere", S, 10.0)  # hopeless: at once
    assert time.monotonic() - begun < 5.0
