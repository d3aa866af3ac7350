"""Scenes to run and to measure on: the same seed gives the same scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from headvox.data import F64, Intrinsics
from headvox.errors import HeadvoxError
from headvox.synth.actors import Actor, animated, place_person
from headvox.synth.camera import IDEAL, Lidar, Sensor, d435i
from headvox.synth.floorplan import FloorPlan, rectangle
from headvox.synth.makers import People, real_people
from headvox.synth.motion import RATE_HZ, turning
from headvox.synth.mounts import Camera, PlacedLidar, camera_pose, lens
from headvox.synth.room import sample_room
from headvox.synth.scene import POSTURE_SHARES, POSTURES, Scene, sample_scene

Rng = np.random.Generator

RIG_APART_M = 4.0
RIG_HEIGHT_M = 1.65
PAPER_TURN_RAD_S = float(np.radians(12.0))
TRIES = 30


def walk(
    seed: int = 0,
    people: People | None = None,
    duration_s: float = 10.0,
    mode: str = "d435i",
    sensor: Sensor | None = None,
) -> Scene:
    """One person walks about in front of one D435i, or of another camera (see :func:`.mounts.lens`)."""
    return _staged(seed, people, ("walking",), ("walk",), _front_camera(mode, sensor), duration_s)


def turn(
    seed: int = 0,
    people: People | None = None,
    duration_s: float = 30.0,
    mode: str = "d435i",
    sensor: Sensor | None = None,
) -> Scene:
    """One person turns on the spot by 12 degrees a second, the paper's pace, in front of one camera."""
    scene = _staged(seed, people, ("standing",), ("stay",), _front_camera(mode, sensor), 0.0, (0.6, 0.4))
    actor = scene.actors[0]
    moments = turning(actor.moments[0], round(duration_s * RATE_HZ), PAPER_TURN_RAD_S)
    scene.actors = [replace(actor, moments=moments)]
    return scene


def crowd(
    seed: int = 0,
    people: People | None = None,
    duration_s: float = 10.0,
    mode: str = "d435i",
    sensor: Sensor | None = None,
) -> Scene:
    """Six people in front of one camera: three walk, one sits, one turns, one stands."""
    postures = ("walking", "walking", "walking", "sitting", "standing", "standing")
    acts = ("walk", "walk", "walk", "rise", "turn", "stay")
    rig = _front_camera(mode, sensor)
    return _staged(seed, people, postures, acts, rig, duration_s, (2.2, 1.6), clutter=0.15)


def two_cameras(
    seed: int = 0,
    people: People | None = None,
    duration_s: float = 10.0,
    postures: Sequence[str] = ("walking",),
    acts: Sequence[str] = ("walk",),
    mode: str = "d435i",
    sensor: Sensor | None = None,
) -> Scene:
    """The paper's rig: two D435i 4 m apart, 1.65 m high, each facing the middle, and people between them."""
    intrinsics, sensor = lens(mode), sensor or d435i()
    half = RIG_APART_M / 2.0
    rig = [
        _camera("left", intrinsics, sensor, (-half, 0.0, RIG_HEIGHT_M), 0.0),
        _camera("right", intrinsics, sensor, (half, 0.0, RIG_HEIGHT_M), np.pi),
    ]
    return _staged(seed, people, postures, acts, rig, duration_s, (1.1, 1.3))


def _camera(
    name: str, intrinsics: Intrinsics, sensor: Sensor, xyz: tuple[float, float, float], yaw_rad: float
) -> Camera:
    return Camera(name, intrinsics, camera_pose(xyz, yaw_rad, 0.12), sensor)


def _front_camera(mode: str, sensor: Sensor | None) -> list[Camera]:
    return [_camera("front", lens(mode), sensor or d435i(), (-2.6, 0.0, 1.3), 0.0)]


def room(
    seed: int = 0,
    people: People | None = None,
    duration_s: float = 10.0,
    count: int = 3,
    cameras: int = 1,
    device: tuple[Intrinsics, Sensor] | None = None,
) -> Scene:
    """``count`` people in a random room with things that look like heads, and cameras wherever.

    Somebody is seen at the start, if there is anybody; ``device`` None gives each camera its own sort.
    """

    def furnished(rng: Rng) -> Scene:
        postures = [str(name) for name in rng.choice(POSTURES, count, p=POSTURE_SHARES)]
        return sample_scene(rng, people, postures, cameras, True, duration_s, device)

    return _peopled(seed, count, furnished)


def lidar(
    seed: int = 0, people: People | None = None, duration_s: float = 10.0, count: int = 3, rings: int = 32
) -> Scene:
    """The same as :func:`room`, seen by one spinning LiDAR."""

    def furnished(rng: Rng) -> Scene:
        postures = [str(name) for name in rng.choice(POSTURES, count, p=POSTURE_SHARES)]
        scene = sample_scene(rng, people, postures, 1, True, duration_s, (lens("kinect"), IDEAL))
        T_world_sensor = np.eye(4)
        T_world_sensor[:3, 3] = scene.cameras[0].T_world_camera[:3, 3]
        T_world_sensor[:3, :3] = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)).as_matrix()
        return replace(scene, cameras=[], lidars=[PlacedLidar(Lidar(rings=rings), T_world_sensor)])

    return _peopled(seed, count, furnished)


def _peopled(seed: int, count: int, furnished: Callable[[Rng], Scene]) -> Scene:
    """The first scene with all of ``count`` people in it, somebody of whom is seen at the start."""
    for attempt in range(TRIES):
        scene = furnished(np.random.default_rng([seed, attempt, 0x40031]))
        if len(scene.actors) == count and (count == 0 or _shows_somebody(scene)):
            return scene
    raise HeadvoxError(
        f"Expected space for {count} people, got none in {TRIES} rooms.", "Take fewer people or another seed."
    )


def _shows_somebody(scene: Scene) -> bool:
    return any(not head.ignore for head in scene.frame(0)[1])


def _staged(
    seed: int,
    people: People | None,
    postures: Sequence[str],
    acts: Sequence[str],
    cameras: list[Camera],
    duration_s: float,
    reach_m: tuple[float, float] = (1.5, 1.2),
    clutter: float = 0.35,
) -> Scene:
    """People within ``reach_m`` of the middle of a 6.5 m by 5 m room, all of whom are seen at the start."""
    people = real_people() if people is None else people
    for attempt in range(TRIES):
        rng = np.random.default_rng([seed, attempt, 0x5CE2E])
        room = sample_room(rng, clutter=clutter, size_m=(6.5, 5.0))
        stands = np.concatenate([_stand(camera.T_world_camera) for camera in cameras])
        if room.plan.conflict(stands) > 0.0:
            continue
        room.plan.take(stands)
        actors: list[Actor] = []
        for posture in postures:
            actor = place_person(rng, people, room, len(actors) + 1, posture, reach_m)
            actors += [actor] if actor is not None else []
        if len(actors) < len(postures):
            continue
        lively = animated(rng, people, _within(room.plan, reach_m), actors, acts, duration_s)
        if any(act == "walk" and not _gets_about(actor) for act, actor in zip(acts, lively, strict=True)):
            continue
        scene = Scene(int(rng.integers(2**31)), people, room, lively, cameras)
        _, heads = scene.frame(0)
        if all(not head.ignore for head in heads if head.posture != "mannequin"):
            return scene
    raise HeadvoxError(
        f"Expected space for {len(postures)} people that the cameras see, got none in {TRIES} rooms.",
        "Take fewer people or another seed.",
    )


def _gets_about(actor: Actor) -> bool:
    """Whether a walker is not hemmed in: at least 0.3 m for every second."""
    path = np.array([moment.xy for moment in actor.moments])
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    return length >= 0.3 * len(path) / RATE_HZ - 0.1


def _stand(T_world_camera: F64) -> F64:
    x, y = T_world_camera[:2, 3]
    return rectangle(np.array([x - 0.25, y - 0.25]), np.array([x + 0.25, y + 0.25]))


def _within(plan: FloorPlan, reach_m: tuple[float, float]) -> FloorPlan:
    """The plan with everything taken that is farther than ``reach_m``, and a step, from the middle."""
    cells = np.argwhere(~plan.taken)
    inner = plan.copy()
    middle = plan.middle(cells)
    inner.take(middle[(np.abs(middle) > np.array(reach_m) + 0.5).any(axis=1)])
    return inner


PRESETS: dict[str, Callable[..., Scene]] = {
    "walk": walk,
    "turn": turn,
    "crowd": crowd,
    "two_cameras": two_cameras,
    "room": room,
    "lidar": lidar,
}
