"""One person in a furnished room, seen from a chosen distance and side: what a pose fit is measured on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from headvox.data import F64, Frame
from headvox.errors import HeadvoxError
from headvox.synth.actors import place_person
from headvox.synth.camera import d435i
from headvox.synth.floorplan import rectangle
from headvox.synth.makers import People, real_people
from headvox.synth.mounts import Camera, camera_pose, lens
from headvox.synth.people import Person
from headvox.synth.room import sample_room
from headvox.synth.scene import Scene, TrueHead

TRIES = 60
ROOM_M = (9.0, 9.0)
LEAST_VISIBLE = 0.25  # less is hidden by furniture, not by the sensor
POSTURES = ("standing", "walking", "sitting")


@dataclass(frozen=True, slots=True)
class Portrait:
    """One frame of one person: the truth, who it is, and the scene that it is the first frame of."""

    frame: Frame
    head: TrueHead
    person: Person
    scene: Scene


def portrait(
    seed: tuple[int, ...],
    distance_m: float,
    bearing_rad: float,
    cameras: int = 1,
    posture: str | None = None,
    people: People | None = None,
) -> Portrait:
    """Return a person seen by D435i cameras that are ``distance_m`` from the head; the same for the same seed.

    ``bearing_rad`` says where the first camera stands: 0 before the face, pi behind. Further cameras stand evenly
    around: the second is opposite the first.

    Raises:
        HeadvoxError: no room had space for it.
    """
    people = real_people() if people is None else people
    for attempt in range(TRIES):
        rng = np.random.default_rng([*seed, attempt])
        room = sample_room(rng, clutter=0.3, size_m=ROOM_M)
        kind = str(rng.choice(POSTURES)) if posture is None else posture
        actor = place_person(rng, people, room, 1, kind, (0.5, 0.5))
        if actor is None:
            continue
        T_world_head = actor.body(people, 0).T_world_head
        poses = [
            _towards(rng, T_world_head, distance_m, bearing_rad + 2.0 * np.pi * k / cameras)
            for k in range(cameras)
        ]
        if any(room.plan.conflict(_stand(T)) > 0.0 for T in poses):
            continue
        rig = [Camera(f"camera_{k}", lens("d435i"), T, d435i()) for k, T in enumerate(poses)]
        scene = Scene(int(rng.integers(2**31)), people, room, [actor], rig)
        frame, heads = scene.frame(0)
        if min(heads[0].visible.values()) >= LEAST_VISIBLE and not heads[0].truncated:
            return Portrait(frame, heads[0], actor.person, scene)
    raise HeadvoxError(f"No room in {TRIES} had space for such a view.", "Take another seed or distance.")


def _towards(rng: np.random.Generator, T_world_head: F64, distance_m: float, bearing_rad: float) -> F64:
    """Return T_world_camera of a camera at a bearing from where the face points, looking about at the head."""
    facing = float(np.arctan2(T_world_head[1, 0], T_world_head[0, 0]))
    azimuth = facing + bearing_rad
    climb = float(np.clip(rng.normal(0.0, 0.2), -0.4, 0.4))  # radians above the head
    flat, up = distance_m * np.cos(climb), distance_m * np.sin(climb)
    x, y, z = T_world_head[:3, 3]
    place = (x + flat * np.cos(azimuth), y + flat * np.sin(azimuth), max(z + up, 0.3))
    yaw = azimuth + np.pi + rng.normal(0.0, 0.12)
    return camera_pose(place, float(yaw), float(climb + rng.normal(0.0, 0.1)))


def _stand(T_world_camera: F64) -> F64:
    x, y = T_world_camera[:2, 3]
    return rectangle(np.array([x - 0.15, y - 0.15]), np.array([x + 0.15, y + 0.15]))
