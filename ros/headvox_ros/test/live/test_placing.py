"""Transforms that come late, never, or jump: a running node waits, says so, and is right again afterwards."""

from __future__ import annotations

import time

import numpy as np
from robot import NS, centres_of, cloud_of

from headvox.frames import inverse, transform, unproject


def test_a_transform_that_is_missing_then_comes(settled, frames, clock):
    image = frames[0].depths[0]
    robot, T = settled, image.T_world_camera
    cloud = transform(inverse(T), unproject(image.depth, image.intrinsics, T))
    stamp = clock.next()
    status = robot.expect_count(
        "without_transform", lambda: robot.publish("/lidar/points", cloud_of(cloud, "arm", stamp))
    )
    assert "arm" in status["last_problem"]
    assert not robot.answers(stamp)
    robot.place("arm", T, stamp := clock.next(), static=False)
    robot.spin(0.2)
    robot.publish("/lidar/points", cloud_of(cloud, "arm", stamp))
    assert robot.wait(lambda: robot.answers(stamp))[0].poses


def test_a_transform_that_is_late_is_waited_for_and_one_that_stopped_is_not(settled, frames, clock):
    image = frames[0].depths[0]
    robot, T = settled, image.T_world_camera
    cloud = transform(inverse(T), unproject(image.depth, image.intrinsics, T))
    robot.place("hand", T, clock.next(), static=False)
    robot.spin(0.2)
    stamp = clock.next()
    robot.publish("/lidar/points", cloud_of(cloud, "hand", stamp))
    time.sleep(0.03)
    robot.place("hand", T, stamp, static=False)
    assert robot.wait(lambda: robot.answers(stamp))
    clock.now += 3 * NS
    robot.spin(0.2)
    stale = clock.next()
    robot.expect_count(
        "without_transform", lambda: robot.publish("/lidar/points", cloud_of(cloud, "hand", stale))
    )
    assert not robot.answers(stale)


def test_a_transform_that_jumps_moves_the_heads_from_then_on(settled, frames, clock):
    image = frames[0].depths[0]
    robot, T = settled, image.T_world_camera
    cloud = transform(inverse(T), unproject(image.depth, image.intrinsics, T))
    before, after = clock.next(), clock.next()
    moved = T.copy()
    moved[:3, 3] += (0.8, 0.4, 0.0)
    robot.place("base", T, before, static=False)
    robot.place("base", moved, after, static=False)
    robot.spin(0.2)
    for stamp in (before, after):
        robot.publish("/lidar/points", cloud_of(cloud, "base", stamp))
        robot.wait(lambda stamp=stamp: robot.answers(stamp))
    first, second = (centres_of(robot.answers(stamp)[0]) for stamp in (before, after))
    assert len(first) > 0
    assert np.linalg.norm(first[0] + (0.8, 0.4, 0.0) - second, axis=1).min() < 0.05
