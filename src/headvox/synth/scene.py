"""People in a room in front of depth cameras: frames, and where every head really is.

>>> frame, heads = training_view(seed=7)            # doctest: +SKIP
>>> scene = sample_scene(np.random.default_rng(1))  # doctest: +SKIP
>>> frame, heads = scene.frame(stamp_ns=0)          # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import Any, Protocol, cast

import numpy as np
from scipy.spatial.transform import Rotation

from headvox.data import F32, F64, U16, Cloud, DepthImage, Frame, Intrinsics
from headvox.errors import HeadvoxError
from headvox.frames import inverse, transform
from headvox.synth.camera import IDEAL, Lidar, Sensor, d435i, kinect, measure, sweep
from headvox.synth.motion import RATE_HZ, Moment, live, sample_act
from headvox.synth.people import PosedBody
from headvox.synth.poses import Pose
from headvox.synth.rays import NEAR_M, Mesh, View, join, look, spin
from headvox.synth.room import (
    ON_TABLES,
    Dummy,
    FloorPlan,
    Item,
    Room,
    add_dummy,
    bed,
    chair,
    footprint,
    pick,
    sample_room,
    sofa,
    table,
)

Rng = np.random.Generator

HEAD_REACH_M = 0.155  # faces within this of the head's centre, and not below the chin, are the head's
CHIN_M = 0.11
LEAST_VISIBLE = 0.15
UPRIGHT = ("standing", "walking", "sitting")
POSTURES = (*UPRIGHT, "bending", "crouching", "lying", "arms_raised")
POSTURE_SHARES = (0.30, 0.24, 0.26, 0.06, 0.05, 0.03, 0.06)
DUMMY_IDS_FROM = 1001


class People(Protocol):
    """What a scene asks of a module that makes people: :mod:`.people`, or the quick :mod:`.mannequin`."""

    def sample_person(self, rng: Rng, child_share: float = ...) -> Any:
        """Draw a person."""
        ...

    def sample_pose(self, rng: Rng, posture: str | None = ...) -> Pose:
        """Draw a pose."""
        ...

    def walking_pose(self, phase_rad: float) -> Pose:
        """Return the pose at a phase of the gait."""
        ...

    def pose_person(
        self, person: Any, pose: Pose, xy: tuple[float, float], heading_rad: float, floor_z: float
    ) -> PosedBody:
        """Return the triangles of a person in a pose."""
        ...


@dataclass(frozen=True, slots=True)
class Camera:
    """A depth camera that stands still."""

    name: str
    intrinsics: Intrinsics
    T_world_camera: F64
    sensor: Sensor = IDEAL


@dataclass(frozen=True, slots=True)
class PlacedLidar:
    """A LiDAR that stands still; x forward, z up in its own frame."""

    lidar: Lidar
    T_world_sensor: F64


@dataclass(frozen=True, slots=True)
class TrueHead:
    """Where a head is.

    ``centre`` (3,) metres and ``quaternion`` (4,) x y z w, both world from head. ``visible`` says for each
    sensor which share (0..1) of the rays that would hit the head alone come back from it: not hidden, not cut
    off by the border, not lost by the sensor. ``truncated``: cut by the border where it is seen best.
    ``ignore``: hardly seen by any sensor, or nobody's head.
    """

    id: int
    centre: F64
    quaternion: F64
    posture: str
    visible: dict[str, float]
    ignore: bool
    truncated: bool


@dataclass(frozen=True, slots=True)
class Actor:
    """A person and their moments, one every 1/30 s (the last one lasts); ``cloth`` is an albedo, 0..1."""

    id: int
    person: Any
    moments: Sequence[Moment]
    cloth: float

    def body(self, people: People, stamp_ns: int) -> PosedBody:
        """Their triangles at a time."""
        step = min(round(stamp_ns * RATE_HZ * 1e-9), len(self.moments) - 1)
        moment = self.moments[step]
        return people.pose_person(self.person, moment.pose, moment.xy, moment.heading_rad, moment.floor_z)


@dataclass(frozen=True, slots=True)
class _Thing:
    """Something with a head: its triangles, with ids (head, head + 1), and the truth."""

    id: int
    mesh: Mesh
    head: Mesh
    T_world_head: F64
    posture: str
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
        things = [self._person(actor, stamp_ns).mesh for actor in self.actors]
        things += [_dummy(dummy, DUMMY_IDS_FROM + k).mesh for k, dummy in enumerate(self.room.dummies)]
        mesh = join([self._still(), *things])
        return [look(mesh, camera.intrinsics, camera.T_world_camera) for camera in self.cameras]

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
        return _thing(actor.id, body.vertices, body.faces, albedo, body.T_world_head, body.posture, False)


def _dummy(dummy: Dummy, number: int) -> _Thing:
    T_world_head = np.eye(4)
    T_world_head[:3, :3] = Rotation.from_euler("z", dummy.yaw_rad).as_matrix()
    T_world_head[:3, 3] = dummy.centre
    thing = dummy.item
    return _thing(number, thing.vertices, thing.faces, thing.albedo, T_world_head, "mannequin", True)


def _thing(
    number: int, vertices: F64, faces: Any, albedo: F32, T_world_head: F64, posture: str, ignore: bool
) -> _Thing:
    middle = transform(inverse(T_world_head), vertices)[faces].mean(axis=1)
    is_head = ((middle**2).sum(axis=1) < HEAD_REACH_M**2) & (middle[:, 2] > -CHIN_M)
    ids = np.where(is_head, 2 * number, 2 * number + 1).astype(np.int32)
    mesh = Mesh(vertices, faces, albedo, ids)
    head = Mesh(vertices, faces[is_head], albedo[is_head], ids[is_head])
    return _Thing(number, mesh, head, T_world_head, posture, ignore)


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
    )


# ---------------------------------------------------------------- cameras


def camera_pose(xyz: Sequence[float], yaw_rad: float, down_rad: float, roll_rad: float = 0.0) -> F64:
    """T_world_camera (4, 4) of a camera that looks along ``yaw_rad``, ``down_rad`` below the horizontal."""
    # from optical axes to x forward, y left, z up
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = Rotation.from_euler("ZYX", (yaw_rad, down_rad, roll_rad)).as_matrix() @ level
    T_world_camera[:3, 3] = xyz
    return T_world_camera


def lens(kind: str, rng: Rng | None = None) -> Intrinsics:
    """Intrinsics of "kinect" and "d435i-vga" (640x480), "d435i" (848x480) or "d435i-small" (424x240)."""
    spread = 0.0 if rng is None else float(rng.uniform(-1.0, 1.0))
    if kind == "kinect":
        f = 547.0 + 23.0 * spread
        return Intrinsics(640, 480, f, f, 319.5 + 4.0 * spread, 239.5 - 3.0 * spread)
    modes = {"d435i": (848, 480, 430.0), "d435i-vga": (640, 480, 387.0), "d435i-small": (424, 240, 215.0)}
    if kind not in modes:
        raise HeadvoxError(f"Expected a lens kinect, {', '.join(modes)}, got {kind!r}.", "Name one of them.")
    width, height, f = modes[kind]
    f *= 1.0 + 0.03 * spread
    return Intrinsics(width, height, f, f, width / 2 - 0.5 + 3.0 * spread, height / 2 - 0.5 - 2.0 * spread)


def sample_device(rng: Rng) -> tuple[Intrinsics, Sensor]:
    """A camera off the shelf, from clean to terrible; behind one in thirty the background is cut away."""
    kind = str(rng.choice(["kinect", "d435i", "d435i-vga", "d435i-small"], p=[0.45, 0.2, 0.2, 0.15]))
    sensor = kinect(rng) if kind == "kinect" else d435i(rng)
    return lens(kind, rng), replace(sensor, cut_out=bool(rng.uniform() < 1.0 / 30.0))


def sample_camera_pose(rng: Rng, room: Room, targets: F64, intrinsics: Intrinsics) -> F64:
    """A place that a robot, a tripod, a shelf or a wall offers; most see some of ``targets`` (N, 3)."""
    tries = 1 if len(targets) == 0 or rng.uniform() < 0.15 else 4
    poses = [_camera_somewhere(rng, room, targets) for _ in range(tries + 2)]
    mesh = room.mesh()
    clear = [pose for pose in poses if _is_clear(mesh, pose)]
    return max((clear or poses)[:tries], key=lambda pose: _in_view(targets, intrinsics, pose))


def _is_clear(mesh: Mesh, T_world_camera: F64) -> bool:
    """Whether the camera is neither in a thing nor right in front of one, seen through a coarse lens."""
    view = look(mesh, Intrinsics(32, 24, 20.0, 20.0, 15.5, 11.5), T_world_camera)
    return bool((view.distance_m < 0.4).mean() < 0.2)


def _in_view(targets: F64, intrinsics: Intrinsics, T_world_camera: F64) -> int:
    """How many points (N, 3) fall well into the image, no farther than most depth cameras see."""
    x, y, z = transform(inverse(T_world_camera), targets).T
    u, v = intrinsics.fx * x / z + intrinsics.cx, intrinsics.fy * y / z + intrinsics.cy
    inside = (u > 0) & (v > 0) & (u < intrinsics.width) & (v < intrinsics.height)
    return int((inside & (z > 0.5) & (z < 5.5)).sum())


def _camera_somewhere(rng: Rng, room: Room, targets: F64) -> F64:
    for attempt in range(40):
        kind = rng.uniform()
        if kind < 0.2:  # a low robot
            height, at_wall = float(rng.uniform(0.3, 0.7)), False
        elif kind < 0.7:  # a robot's head, a tripod, a table
            height, at_wall = float(rng.uniform(0.8, 1.7)), False
        else:  # a shelf, a wall, a corner
            height, at_wall = float(rng.uniform(1.6, 2.6)), True
        half = np.array([room.x_m, room.y_m]) / 2.0 - 0.12
        xy = rng.uniform(-half, half)
        if at_wall:
            side = int(rng.integers(2))
            xy[side] = half[side] * float(rng.choice([-1.0, 1.0]))
        reach = xy + 0.08 * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1], [0, 0]])
        if height < 1.8 and room.plan.conflict(reach) > 0.0 and attempt < 30:
            continue
        aimed = len(targets) > 0 and rng.uniform() < 0.85
        middle = np.array([*(rng.uniform(-0.3, 0.3, 2) * (room.x_m, room.y_m)), 1.0])
        target = targets[int(rng.integers(len(targets)))] if aimed else middle
        away = target[:2] - xy
        distance = float(np.hypot(away[0], away[1]))
        if not 0.7 < distance < 7.0 or (len(targets) and np.hypot(*(targets[:, :2] - xy).T).min() < 0.6):
            continue
        # Cameras are set up for a place, not for a person: heads end up anywhere in the image.
        yaw = float(np.arctan2(away[1], away[0]) + rng.normal(0.0, 0.22))
        down = float(np.arctan2(height - target[2] + 0.2, distance) + rng.normal(0.0, 0.12))
        down = float(np.clip(down, np.radians(-20.0), np.radians(45.0)))
        return camera_pose((xy[0], xy[1], height), yaw, down, float(rng.normal(0.0, 0.02)))
    return camera_pose(
        (-room.x_m / 2 + 0.2, -room.y_m / 2 + 0.2, 2.0), float(np.arctan2(room.y_m, room.x_m)), 0.3
    )


# ---------------------------------------------------------------- people into the room


def real_people() -> People:
    """The module that makes the realistic people."""
    return cast(People, import_module("headvox.synth.people"))


def place_person(
    rng: Rng,
    people: People,
    room: Room,
    number: int,
    posture: str,
    reach_m: tuple[float, float] | None = None,
    beside: tuple[float, float] | None = None,
) -> Actor | None:
    """Put a person with what they sit or lie on where there is space; None when the room is too full.

    ``reach_m`` keeps them within so many metres of the room's middle, along x and y; ``beside`` looks near a
    place first.
    """
    person = people.sample_person(rng)
    reach_m = (0.47 * room.x_m, 0.47 * room.y_m) if reach_m is None else reach_m
    pose = people.sample_pose(rng, posture)
    body = people.pose_person(person, pose, (0.0, 0.0), 0.0, 0.0)
    furniture = _furniture(rng, body)
    lift = 0.0
    if posture == "lying" and furniture:
        lift = 0.98 * float(furniture[0][0].vertices[:8, 2].max())
    ground = body.vertices[:: max(1, len(body.vertices) // 400), :2]
    for attempt in range(25):
        at = rng.uniform(-1.0, 1.0, 2) * reach_m
        if beside is not None and attempt < 12:
            at = np.array(beside) + rng.normal(0.0, 0.5, 2)
        x, y = (float(n) for n in at)
        yaw = float(rng.uniform(-np.pi, np.pi))
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, s], [-s, c]])
        spots = [_shifted(at, turn, x, y) for _, at in furniture]
        places = [
            footprint(thing, px, py, yaw) for (thing, _), (px, py) in zip(furniture, spots, strict=True)
        ]
        if room.plan.conflict(np.concatenate([ground @ turn + (x, y), *places])) > 0.01:
            continue
        for (thing, _), (px, py) in zip(furniture, spots, strict=True):
            room.add(thing, px, py, yaw)
        room.plan.take(ground @ turn + (x, y), by_person=True)
        cloth = float(rng.uniform(0.03, 0.12) if rng.uniform() < 0.12 else rng.uniform(0.15, 0.9))
        return Actor(number, person, [Moment(pose, (x, y), yaw, lift)], cloth)
    return None


def _shifted(at: tuple[float, float], turn: F64, x: float, y: float) -> tuple[float, float]:
    px, py = np.array(at) @ turn
    return float(px) + x, float(py) + y


def _furniture(rng: Rng, body: PosedBody) -> list[tuple[Item, tuple[float, float]]]:
    """What this body sits or lies on, and where it stands from the body's own origin."""
    if body.posture == "lying":
        if rng.uniform() < 0.5:
            return []
        middle = (body.vertices.min(axis=0) + body.vertices.max(axis=0))[:2] / 2.0
        size = np.ptp(body.vertices, axis=0)
        couch = bed(rng)
        if size[1] > size[0]:
            couch = couch.placed(0.0, 0.0, np.pi / 2.0)
        return [(couch, (float(middle[0]), float(middle[1])))]
    if body.posture != "sitting":
        return []
    back, seat, knees = _sitting_measures(body)
    if seat < 0.12:
        return []  # on the floor
    kind = rng.uniform()
    if kind < 0.8:
        under = chair(rng, seat, back=bool(rng.uniform() < 0.8))
        things = [(under, (back + 0.22, 0.0))]
    else:
        things = [(sofa(rng, seat), (back + 0.3, 0.0))]
    if rng.uniform() < 0.35 and knees < 0.74:
        desk = table(rng, max(knees + 0.06, 0.68))
        at = (back + 0.45 - float(desk.vertices[:, 0].min()), 0.0)
        things.append((desk, at))
        for _ in range(int(rng.integers(0, 3))):
            spot = (at[0] + float(rng.uniform(-0.1, 0.25)), float(rng.uniform(-0.4, 0.4)))
            things.append((pick(rng, ON_TABLES).placed(0.0, 0.0, np.pi, desk.top()), spot))
    return things


def _sitting_measures(body: PosedBody) -> tuple[float, float, float]:
    """Of a body that sits at the origin and faces x: where its back ends, heights of seat and knees [m]."""
    trunk = body.vertices[np.abs(body.vertices[:, 1] - np.median(body.vertices[:, 1])) < 0.14]
    back = float(trunk[:, 0].min())
    behind = trunk[trunk[:, 0] < back + 0.25]
    front = body.vertices[body.vertices[:, 0] > body.vertices[:, 0].max() - 0.35]
    return back, float(behind[:, 2].min()), float(np.percentile(front[:, 2], 95))


def sample_scene(
    rng: Rng,
    people: People | None = None,
    postures: Sequence[str] | None = None,
    cameras: int | None = None,
    moving: bool = True,
    duration_s: float = 10.0,
) -> Scene:
    """A random room with people and cameras.

    ``postures`` has one entry a person (0-5 random ones by default); when ``moving``, those "walking" walk
    about and all look around. ``cameras`` is 1-4, mostly 1 by default.
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
        intrinsics, sensor = sample_device(rng)
        rig.append(
            Camera(f"camera_{k}", intrinsics, sample_camera_pose(rng, room, targets, intrinsics), sensor)
        )
    if moving:
        acts = [sample_act(rng, actor.moments[0].pose.posture) for actor in actors]
        actors = animated(rng, people, room.plan, actors, acts, duration_s)
    return Scene(int(rng.integers(2**31)), people, room, actors, rig)


def animated(
    rng: Rng, people: People, plan: FloorPlan, actors: list[Actor], acts: Sequence[str], duration_s: float
) -> list[Actor]:
    """The same people, doing what ``acts`` says (see :func:`.motion.live`)."""
    steps = max(1, round(duration_s * RATE_HZ))
    lives = live(rng, people, plan, [actor.moments[0] for actor in actors], acts, steps)
    return [replace(actor, moments=moments) for actor, moments in zip(actors, lives, strict=True)]


def _head_centre(people: People, actor: Actor) -> F64:
    return np.asarray(actor.body(people, 0).T_world_head[:3, 3])


def training_view(seed: int, people: People | None = None) -> tuple[Frame, list[TrueHead]]:
    """One random still view with its truth: any sensor, room, people; the same for the same seed.

    A quarter of the views shows nobody.
    """
    scene = sample_scene(np.random.default_rng([seed, 0x4EAD]), people, moving=False)
    return scene.frame(0)
