"""MuJoCo's renderer and our ray caster see the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from headvox.errors import HeadvoxError
from headvox.synth.camera import IDEAL
from headvox.synth.presets import two_cameras
from headvox.synth.simulator import Simulator

STAMPS = (0, 1_000_000_000)


@pytest.fixture(scope="module")
def scene():
    return two_cameras(3, duration_s=2.0, mode="d435i-small", sensor=IDEAL)


@pytest.fixture(scope="module")
def simulator(scene):
    try:
        simulator = Simulator(scene)
    except HeadvoxError as error:
        if not error.what.startswith("MuJoCo cannot"):
            raise
        pytest.skip(f"MuJoCo cannot render on this machine: {error}")
    yield simulator
    simulator.close()


def test_distances_are_those_of_our_ray_caster(scene, simulator):
    """Edges may fall to either side of a ray; everything else agrees to the precision of float32."""
    for stamp in STAMPS:
        for ours, theirs in zip(scene.views(stamp), simulator.distances(stamp), strict=True):
            assert np.mean(np.isfinite(ours.distance_m) == np.isfinite(theirs)) > 0.999
            for who in (ours.ids == 0, ours.ids > 0):  # the room, the person
                assert who.sum() > 500
                apart = np.abs(ours.distance_m[who] - theirs[who])
                assert np.median(apart) < 1e-6
                assert np.mean(apart < 1e-4) > 0.995


def test_the_person_walks(simulator):
    first, later = (simulator.distances(stamp) for stamp in STAMPS)
    for before, after in zip(first, later, strict=True):
        assert np.mean(~np.isclose(before, after, atol=0.01)) > 0.01


def test_a_frame_is_what_the_scene_would_deliver_without_noise(scene, simulator):
    theirs = simulator.frame(STAMPS[1])
    ours, _ = scene.frame(STAMPS[1])
    assert [image.name for image in theirs.depths] == [image.name for image in ours.depths]
    for one, other in zip(theirs.depths, ours.depths, strict=True):
        assert one.depth.dtype == np.uint16
        apart = np.abs(one.depth.astype(int) - other.depth)
        assert np.mean(apart <= 1) > 0.995  # a millimetre, by rounding


def test_cameras_that_are_not_alike_are_refused(scene):
    first, second = scene.cameras
    other = replace(second, intrinsics=replace(second.intrinsics, width=320))
    with pytest.raises(HeadvoxError, match="alike"):
        Simulator(replace(scene, cameras=[first, other]))
    with pytest.raises(HeadvoxError, match="centred"):
        Simulator(replace(scene, cameras=[other]))
