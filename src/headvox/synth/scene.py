"""People in a room in front of depth cameras: frames, and where every head really is.

>>> frame, heads = training_view(seed=7)            # doctest: +SKIP
>>> scene = sample_scene(np.random.default_rng(1))  # doctest: +SKIP
>>> frame, heads = scene.frame(stamp_ns=0)          # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from headvox.data import F32, F64, U16, Cloud, DepthImage, Frame, Intrinsics
from headvox.frames import inverse, transform
from headvox.synth.actors import Actor, animated, place_person
from headvox.synth.camera import Sensor, measure, sweep
from headvox.synth.makers import People, real_people
from headvox.synth.motion import sample_act
from headvox.synth.mounts import Camera, PlacedLidar, sample_camera_pose, sample_device
from headvox.synth.rays import NEAR_M, Mesh, View, join, look, spin
from headvox.synth.room import Dummy, Room, add_dummy, sample_room

Rng = np.random.Generator

HEAD_REACH_M = 0.155  # faces within this of the head's centre, and not below the chin, are the head's
CHIN_M = 0.11
GLOSS = np.array([0.05, 0.5, 0.0, 0.1, 0.8], np.float32)  # of skin, hair, cloth, hats, glasses
LEAST_VISIBLE = 0.15
POSTURES = ("standing", "walking", "sitting", "bending", "crouching", "lying", "arms_raised")
POSTURE_SHARES = (0.30, 0.24, 0.26, 0.06, 0.05, 0.03, 0.06)
DUMMY_IDS_FROM = 1001


@dataclass(frozen=True, slots=True)
class TrueHead:
    """Where a head is.

    ``centre`` (3,) metres and ``quaternion`` (4,) x y z w, both world from head. ``visible`` says for each
    sensor which share (0..1) of the rays that would hit the head alone come back from it: not hidden, not cut
    off by the border, not lost by the sensor. ``truncated``: cut by the border where it is seen best.
    ``ignore``: hardly seen by any sensor, or nobody's head. ``hair``: a hat, or else the style of the hair.
    """

    id: int
    centre: F64
    quaternion: F64
    posture: str
    visible: dict[str, float]
    ignore: bool
    truncated: bool
    hair: str = ""


@dataclass(frozen=True, slots=True)
class _Thing:
    """Something with a head: its triangles, with ids (head, head + 1), and the truth."""

    id: int
    mesh: Mesh
    head: Mesh
    T_world_head: F64
    posture: str
    hair: str
    ignore: bool


@dataclass(slots=True)
class Scene:
    """A room, people, sensors. A frame depends on ``seed`` and its stamp alone: ask in any order."""

    seed: int
    people: People
    room: Room
    actors: list[Actor]
    cameras: list[Camera]
    lidars: list[PlacedLidar] = field(default_factory=list)
    _room_mesh: Mesh | None = None

    def frame(self, stamp_ns: int) -> tuple[Frame, list[TrueHead]]:
        """What every sensor delivers at a time, and the truth of every head in the room."""
        things = [self._person(actor, stamp_ns) for actor in self.actors]
        things += [_dummy(dummy, DUMMY_IDS_FROM + k) for k, dummy in enumerate(self.room.dummies)]
        mesh = join([self._still(), *(thing.mesh for thing in things)])
        seen: list[dict[int, tuple[float, bool]]] = []
        depths, clouds = [], []
        for k, camera in enumerate(self.cameras):
            view = look(mesh, camera.intrinsics, camera.T_world_camera)
            depth = measure(view, camera.intrinsics, camera.sensor, self._rng(k), self._rng(k, stamp_ns))
            depths.append(DepthImage(camera.name, depth, camera.intrinsics, camera.T_world_camera))
            seen.append({thing.id: _seen_by_camera(thing, camera, view, depth) for thing in things})
        for k, placed in enumerate(self.lidars, start=len(self.cameras)):
            cloud, view = sweep(mesh, placed.lidar, placed.T_world_sensor, self._rng(k, stamp_ns))
            clouds.append(cloud)
            seen.append({thing.id: _seen_by_lidar(thing, placed, view, cloud) for thing in things})
        names = [camera.name for camera in self.cameras] + [placed.lidar.name for placed in self.lidars]
        heads = [_truth(thing, names, [one[thing.id] for one in seen]) for thing in things]
        return Frame(stamp_ns, tuple(clouds), tuple(depths)), heads

    def views(self, stamp_ns: int) -> list[View]:
        """What the cameras would see without any imperfection."""
        mesh = join(self.meshes(stamp_ns))
        return [look(mesh, camera.intrinsics, camera.T_world_camera) for camera in self.cameras]

    def meshes(self, stamp_ns: int) -> list[Mesh]:
        """The triangles at a time: of the room, of each person, of each dummy. Only people's vertices ever move."""
        people = [self._person(actor, stamp_ns).mesh for actor in self.actors]
        dummies = [_dummy(dummy, DUMMY_IDS_FROM + k).mesh for k, dummy in enumerate(self.room.dummies)]
        return [self._still(), *people, *dummies]

    def __getstate__(self) -> dict[str, Any]:
        """Let a scene go to other processes: a module of people goes by its name."""
        state = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        if isinstance(self.people, ModuleType):
            state["people"] = self.people.__name__
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Come back from :meth:`__getstate__`."""
        for name, value in state.items():
            setattr(
                self, name, import_module(value) if name == "people" and isinstance(value, str) else value
            )

    def _still(self) -> Mesh:
        if self._room_mesh is None:
            self._room_mesh = self.room.mesh()
        return self._room_mesh

    def _rng(self, sensor: int, stamp_ns: int | None = None) -> Rng:
        return np.random.default_rng(
            [self.seed, sensor] if stamp_ns is None else [self.seed, sensor, 1 + stamp_ns]
        )

    def _person(self, actor: Actor, stamp_ns: int) -> _Thing:
        body = actor.body(self.people, stamp_ns)
        albedo = np.array([0.6, 0.03 + 0.6 * body.hair_albedo, actor.cloth, actor.cloth, 0.06], np.float32)[
            body.materials
        ]
        gloss = GLOSS[body.materials]
        return _thing(
            actor.id,
            body.vertices,
            body.faces,
            albedo,
            gloss,
            body.T_world_head,
            (body.posture, body.hair),
            False,
        )


def _dummy(dummy: Dummy, number: int) -> _Thing:
    T_world_head = np.eye(4)
    T_world_head[:3, :3] = Rotation.from_euler("z", dummy.yaw_rad).as_matrix()
    T_world_head[:3, 3] = dummy.centre
    thing = dummy.item
    gloss = np.zeros(len(thing.faces), np.float32)
    return _thing(
        number, thing.vertices, thing.faces, thing.albedo, gloss, T_world_head, ("mannequin", ""), True
    )


def _thing(
    number: int,
    vertices: F64,
    faces: Any,
    albedo: F32,
    gloss: F32,
    T_world_head: F64,
    labels: tuple[str, str],
    ignore: bool,
) -> _Thing:
    middle = transform(inverse(T_world_head), vertices)[faces].mean(axis=1)
    is_head = ((middle**2).sum(axis=1) < HEAD_REACH_M**2) & (middle[:, 2] > -CHIN_M)
    ids = np.where(is_head, 2 * number, 2 * number + 1).astype(np.int32)
    mesh = Mesh(vertices, faces, albedo, ids, gloss)
    head = Mesh(vertices, faces[is_head], albedo[is_head], ids[is_head], gloss[is_head])
    return _Thing(number, mesh, head, T_world_head, *labels, ignore)


def _seen_by_camera(thing: _Thing, camera: Camera, view: View, depth: U16) -> tuple[float, bool]:
    """Visible share of a head, and whether the image's border cuts it."""
    window, shift = _window(thing, camera)
    if window is None:
        return 0.0, False
    alone = look(thing.head, window, camera.T_world_camera)
    hit = alone.ids >= 0
    everything = int(hit.sum())
    if everything == 0:
        return 0.0, False
    v, u = np.nonzero(hit)
    u, v = u + shift[0], v + shift[1]
    inside = (u >= 0) & (v >= 0) & (u < depth.shape[1]) & (v < depth.shape[0])
    u, v = u[inside], v[inside]
    own = view.ids[v, u] == 2 * thing.id
    measured = depth[v, u] * camera.intrinsics.depth_scale
    true = view.distance_m[v, u]
    close = np.abs(measured - true) < 0.04 + 0.01 * true**2  # a flying pixel is nobody's
    return float((own & close & (measured > 0.0)).sum()) / everything, bool(len(u) < everything)


def _window(thing: _Thing, camera: Camera) -> tuple[Intrinsics | None, tuple[int, int]]:
    """The part of an endless image that holds the whole head, and where it starts in the real one."""
    lens = camera.intrinsics
    points = transform(inverse(camera.T_world_camera), thing.head.vertices[np.unique(thing.head.faces)])
    if len(points) == 0 or points[:, 2].min() < 5.0 * NEAR_M:
        return None, (0, 0)
    u = points[:, 0] / points[:, 2] * lens.fx + lens.cx
    v = points[:, 1] / points[:, 2] * lens.fy + lens.cy
    left, right, top, bottom = int(u.min()) - 1, int(u.max()) + 2, int(v.min()) - 1, int(v.max()) + 2
    if right < 0 or bottom < 0 or left >= lens.width or top >= lens.height:
        return None, (0, 0)
    width, height = min(right - left + 1, 2000), min(bottom - top + 1, 2000)
    return Intrinsics(width, height, lens.fx, lens.fy, lens.cx - left, lens.cy - top), (left, top)


def _seen_by_lidar(thing: _Thing, placed: PlacedLidar, view: View, cloud: Cloud) -> tuple[float, bool]:
    lidar = placed.lidar
    alone, _ = spin(thing.head, lidar.elevations(), lidar.columns, placed.T_world_sensor)
    everything = int((alone.ids >= 0).sum())
    own = (view.ids.reshape(-1) == 2 * thing.id) & np.isfinite(cloud.points[:, 0])
    return float(own.sum()) / max(everything, 1), False


def _truth(thing: _Thing, names: list[str], seen: list[tuple[float, bool]]) -> TrueHead:
    best = max(range(len(seen)), key=lambda k: seen[k][0])
    return TrueHead(
        id=thing.id,
        centre=thing.T_world_head[:3, 3].copy(),
        quaternion=np.asarray(Rotation.from_matrix(thing.T_world_head[:3, :3]).as_quat()),
        posture=thing.posture,
        visible={name: round(share, 4) for name, (share, _) in zip(names, seen, strict=True)},
        ignore=thing.ignore or seen[best][0] < LEAST_VISIBLE,
        truncated=seen[best][1],
        hair=thing.hair,
    )


def sample_scene(
    rng: Rng,
    people: People | None = None,
    postures: Sequence[str] | None = None,
    cameras: int | None = None,
    moving: bool = True,
    duration_s: float = 10.0,
    device: tuple[Intrinsics, Sensor] | None = None,
) -> Scene:
    """A random room with people and cameras.

    ``postures`` has one entry a person (0-5 random ones by default); when ``moving``, those "walking" walk
    about and all look around. ``cameras`` is 1-4, mostly 1 by default; each is another sort of camera unless
    ``device`` says which.
    """
    people = real_people() if people is None else people
    room = sample_room(rng)
    if postures is None:
        count = 0 if rng.uniform() < 0.25 else int(rng.choice([1, 2, 3, 4, 5], p=[0.3, 0.27, 0.2, 0.13, 0.1]))
        postures = [str(name) for name in rng.choice(POSTURES, count, p=POSTURE_SHARES)]
    actors: list[Actor] = []
    is_group = rng.uniform() < 0.4
    for posture in postures:
        beside = actors[-1].moments[0].xy if is_group and actors else None
        actor = place_person(rng, people, room, len(actors) + 1, posture, beside=beside)
        if actor is not None:
            actors.append(actor)
    if rng.uniform() < 0.1:
        add_dummy(rng, room)
    targets = np.array([_head_centre(people, actor) for actor in actors]).reshape(-1, 3)
    count = int(rng.choice([1, 2, 3, 4], p=[0.8, 0.12, 0.05, 0.03])) if cameras is None else cameras
    rig = []
    for k in range(count):
        intrinsics, sensor = sample_device(rng) if device is None else device
        rig.append(
            Camera(f"camera_{k}", intrinsics, sample_camera_pose(rng, room, targets, intrinsics), sensor)
        )
    if moving:
        acts = [sample_act(rng, actor.moments[0].pose.posture) for actor in actors]
        actors = animated(rng, people, room.plan, actors, acts, duration_s)
    return Scene(int(rng.integers(2**31)), people, room, actors, rig)


def _head_centre(people: People, actor: Actor) -> F64:
    return np.asarray(actor.body(people, 0).T_world_head[:3, 3])


def training_view(seed: int, people: People | None = None) -> tuple[Frame, list[TrueHead]]:
    """One random still view with its truth: any sensor, room, people; the same for the same seed.

    A quarter of the views shows nobody.
    """
    scene = sample_scene(np.random.default_rng([seed, 0x4EAD]), people, moving=False)
    return scene.frame(0)
