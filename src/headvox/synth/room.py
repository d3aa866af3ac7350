"""Rooms: walls, furniture, and the things that look like heads to a detector.

Every item is made of a few light triangle solids, stands on z = 0 around its own origin, and is placed by a
turn about z and a shift. What blocks the way of people is kept on a floor plan of small cells.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from headvox.data import F32, F64
from headvox.synth.rays import I32, ROOM_ID, Mesh, join

Rng = np.random.Generator
Solid = tuple[F64, I32]

CELL_M = 0.05


# ---------------------------------------------------------------- solids


def box(size: tuple[float, float, float], at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Solid:
    """A box of ``size`` metres whose bottom face has its middle ``at``."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return corners * size + at, np.array(faces, np.int32)


def lathe(
    profile: Sequence[tuple[float, float]], at: tuple[float, float, float] = (0.0, 0.0, 0.0), sides: int = 14
) -> Solid:
    """A solid of revolution about z: ``profile`` lists (radius, height) in metres from bottom to top."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    vertices = np.array([[r * c, r * s, z] for r, z in profile for c, s in ring]) + at
    faces = []
    for k in range(len(profile) - 1):
        for i in range(sides):
            j = (i + 1) % sides
            a, b, c, d = k * sides + i, k * sides + j, (k + 1) * sides + j, (k + 1) * sides + i
            faces += [(a, b, c), (a, c, d)]
    return vertices, np.array(faces, np.int32)


def cylinder(radius: float, height: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Solid:
    """An upright closed cylinder whose bottom has its middle ``at``."""
    return lathe([(0.0, 0.0), (radius, 0.0), (radius, height), (0.0, height)], at)


def ellipsoid(
    half_axes: tuple[float, float, float], at: tuple[float, float, float], sides: int = 16
) -> Solid:
    """An ellipsoid with its middle ``at``."""
    angle = np.linspace(-np.pi / 2.0, np.pi / 2.0, sides // 2 + 2)
    vertices, faces = lathe([(float(np.cos(a)), float(np.sin(a))) for a in angle], sides=sides)
    return vertices * half_axes + at, faces


def lump(
    rng: Rng, half_axes: tuple[float, float, float], at: tuple[float, float, float], roughness: float = 0.15
) -> Solid:
    """An ellipsoid with dents and bulges: bags, leaves, cloth."""
    vertices, faces = ellipsoid((1.0, 1.0, 1.0), (0.0, 0.0, 0.0), sides=20)
    bulge = np.zeros(len(vertices))
    for scale in (2.0, 3.5, 6.0):
        bulge += np.sin(vertices @ rng.normal(0.0, scale, 3) + rng.uniform(0.0, 6.3)) / scale**0.5
    return vertices * (1.0 + roughness * bulge)[:, None] * half_axes + at, faces


# ---------------------------------------------------------------- items


@dataclass(frozen=True, slots=True)
class Item:
    """A thing in a room. ``vertices`` (V, 3) metres, ``faces`` (F, 3), ``albedo`` (F,)."""

    name: str
    vertices: F64
    faces: I32
    albedo: F32

    def placed(self, x: float, y: float, yaw_rad: float = 0.0, z: float = 0.0) -> Item:
        """The item turned about z, then shifted."""
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        turned = self.vertices @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return replace(self, vertices=turned + np.array([x, y, z]))

    def top(self) -> float:
        """Height of its highest point [m]."""
        return float(self.vertices[:, 2].max())

    def mesh(self, number: int = ROOM_ID) -> Mesh:
        """Its triangles under one id."""
        return Mesh(self.vertices, self.faces, self.albedo, np.full(len(self.faces), number, np.int32))


def item(name: str, *parts: tuple[Solid, float]) -> Item:
    """Join solids, each with its albedo."""
    meshes = [
        Mesh(v, f, np.full(len(f), albedo, np.float32), np.zeros(len(f), np.int32))
        for (v, f), albedo in parts
    ]
    mesh = join(meshes)
    return Item(name, mesh.vertices, mesh.faces, mesh.albedo)


def together(name: str, *items: Item) -> Item:
    """One item out of several."""
    mesh = join([one.mesh() for one in items])
    return Item(name, mesh.vertices, mesh.faces, mesh.albedo)


def _albedo(rng: Rng) -> float:
    # Most things send enough back; one in six is black or shiny, and is what holes come from.
    return float(rng.uniform(0.02, 0.12) if rng.uniform() < 0.16 else rng.uniform(0.2, 0.9))


def ball(rng: Rng) -> Item:
    """A ball of any size between a tennis ball and a gym ball."""
    radius = float(rng.choice([rng.uniform(0.03, 0.09), rng.uniform(0.09, 0.13), rng.uniform(0.13, 0.38)]))
    return item("ball", (ellipsoid((radius, radius, radius), (0.0, 0.0, radius)), _albedo(rng)))


def vase(rng: Rng) -> Item:
    """A vase or a jar with a neck."""
    h, belly, neck = rng.uniform(0.18, 0.5), rng.uniform(0.06, 0.14), rng.uniform(0.02, 0.06)
    profile = [
        (0.0, 0.0),
        (belly * 0.7, 0.0),
        (belly, 0.35 * h),
        (belly * 0.8, 0.6 * h),
        (neck, 0.8 * h),
        (neck * 1.3, h),
    ]
    return item("vase", (lathe([(float(r), float(z)) for r, z in profile]), _albedo(rng)))


def bottle(rng: Rng) -> Item:
    """A bottle."""
    r, h = float(rng.uniform(0.03, 0.06)), float(rng.uniform(0.2, 0.36))
    return item(
        "bottle",
        (
            lathe([(0.0, 0.0), (r, 0.0), (r, 0.6 * h), (0.4 * r, 0.8 * h), (0.4 * r, h), (0.0, h)]),
            _albedo(rng),
        ),
    )


def pole_lamp(rng: Rng) -> Item:
    """A lamp on a pole: a round or a conical shade at the height of a head."""
    height, radius = float(rng.uniform(1.0, 1.9)), float(rng.uniform(0.08, 0.24))
    parts = [(cylinder(0.14, 0.03), _albedo(rng)), (cylinder(0.015, height), _albedo(rng))]
    if rng.uniform() < 0.5:
        parts.append((ellipsoid((radius, radius, radius), (0.0, 0.0, height)), _albedo(rng)))
    else:
        shade = [(radius, 0.0), (radius * float(rng.uniform(0.4, 1.0)), float(rng.uniform(0.18, 0.35)))]
        parts.append((lathe(shade, (0.0, 0.0, height - 0.1)), _albedo(rng)))
    return item("pole lamp", *parts)


def table_lamp(rng: Rng) -> Item:
    """A small lamp with a shade."""
    h, r = float(rng.uniform(0.2, 0.4)), float(rng.uniform(0.07, 0.15))
    return item(
        "table lamp",
        (cylinder(0.07, 0.02), _albedo(rng)),
        (cylinder(0.012, h), _albedo(rng)),
        (lathe([(r, 0.0), (0.6 * r, 1.3 * r)], (0.0, 0.0, h)), _albedo(rng)),
    )


def plant(rng: Rng) -> Item:
    """A pot with a crown of leaves, from a table plant to a small tree."""
    size = float(rng.uniform(0.25, 1.0))
    stem, crown = 0.9 * size * float(rng.uniform(0.4, 1.0)), 0.25 * size + 0.06
    parts = [
        (lathe([(0.0, 0.0), (0.14 * size, 0.0), (0.2 * size, 0.3 * size), (0.0, 0.3 * size)]), _albedo(rng)),
        (cylinder(0.015, stem + 0.25 * size), 0.3),
    ]
    for _ in range(int(rng.integers(1, 6))):
        x, y, z = (float(n) for n in rng.normal(0.0, 0.4 * crown, 3))
        axes = (float(rng.uniform(0.4, 1.0)) * crown, float(rng.uniform(0.4, 1.0)) * crown, 0.8 * crown)
        parts.append(
            (lump(rng, axes, (x, y, stem + 0.4 * size + crown + z), 0.25), float(rng.uniform(0.3, 0.9)))
        )
    return item("plant", *parts)


def monitor(rng: Rng) -> Item:
    """A screen on a foot: its glass hardly answers."""
    w = float(rng.uniform(0.35, 0.7))
    h, lift = 0.6 * w, float(rng.uniform(0.08, 0.2))
    return item(
        "monitor",
        (box((0.04, w, h), (0.0, 0.0, lift)), _albedo(rng)),
        (box((0.005, 0.94 * w, 0.9 * h), (0.025, 0.0, lift + 0.05 * h)), float(rng.uniform(0.005, 0.06))),
        (box((0.04, 0.06, lift), (-0.03, 0.0, 0.0)), 0.3),
        (box((0.2, 0.26, 0.02)), 0.3),
    )


def laptop(rng: Rng) -> Item:
    """An open laptop."""
    return item(
        "laptop", (box((0.24, 0.34, 0.02)), _albedo(rng)), (box((0.02, 0.34, 0.22), (-0.12, 0.0, 0.02)), 0.04)
    )


def bag(rng: Rng) -> Item:
    """A bag or a rucksack."""
    axes = (float(rng.uniform(0.08, 0.16)), float(rng.uniform(0.1, 0.22)), float(rng.uniform(0.12, 0.25)))
    return item("bag", (lump(rng, axes, (0.0, 0.0, axes[2]), 0.08), _albedo(rng)))


def carton(rng: Rng) -> Item:
    """A box."""
    w, d, h = (float(n) for n in rng.uniform(0.12, 0.6, 3))
    return item("box", (box((w, d, h)), _albedo(rng)))


def hat(rng: Rng) -> Item:
    """A hat with a brim."""
    r = float(rng.uniform(0.085, 0.11))
    profile = [(0.0, 0.0), (r * float(rng.uniform(1.1, 1.7)), 0.0), (r, 0.02), (0.9 * r, 0.1), (0.0, 0.13)]
    return item("hat", (lathe(profile), _albedo(rng)))


def jacket(rng: Rng) -> Item:
    """A jacket that hangs: shoulders, a drooping body, perhaps a hood; its top is at the origin."""
    albedo = _albedo(rng)
    parts = [
        (lump(rng, (0.09, float(rng.uniform(0.16, 0.24)), 0.12), (0.0, 0.0, -0.16), 0.08), albedo),
        (lump(rng, (0.1, float(rng.uniform(0.14, 0.22)), 0.38), (0.0, 0.0, -0.5), 0.1), albedo),
    ]
    if rng.uniform() < 0.4:
        parts.append((lump(rng, (0.09, 0.1, 0.11), (0.03, 0.0, -0.05), 0.1), albedo))
    return item("jacket", *parts)


def dummy_head(rng: Rng) -> Item:
    """A mannequin head on its neck; the head's centre is 0.235 m above its foot, the face looks along x."""
    albedo = float(rng.uniform(0.3, 0.9))
    return item(
        "mannequin head",
        (lathe([(0.0, 0.0), (0.09, 0.0), (0.06, 0.05), (0.055, 0.16)]), albedo),
        (ellipsoid((0.095, 0.075, 0.115), (0.0, 0.0, DUMMY_CENTRE_M)), albedo),
        (ellipsoid((0.03, 0.015, 0.03), (0.09, 0.0, DUMMY_CENTRE_M - 0.01), 8), albedo),
    )


DUMMY_CENTRE_M = 0.235


def table(rng: Rng, height_m: float | None = None) -> Item:
    """A table: a top on legs, or on panels."""
    w, d = float(rng.uniform(0.5, 0.9)), float(rng.uniform(0.8, 1.8))
    h = float(rng.uniform(0.38, 0.5) if rng.uniform() < 0.2 else rng.uniform(0.65, 0.78))
    h = h if height_m is None else height_m
    parts = [(box((w, d, 0.04), (0.0, 0.0, h - 0.04)), _albedo(rng))]
    if rng.uniform() < 0.6:
        parts += [
            (box((0.05, 0.05, h - 0.04), (sx * (w / 2 - 0.05), sy * (d / 2 - 0.05), 0.0)), 0.4)
            for sx in (-1, 1)
            for sy in (-1, 1)
        ]
    else:
        parts += [(box((0.9 * w, 0.04, h - 0.04), (0.0, s * (d / 2 - 0.08), 0.0)), 0.5) for s in (-1, 1)]
    return item("table", *parts)


def chair(rng: Rng, seat_m: float | None = None, back: bool | None = None) -> Item:
    """A chair that faces along x, its seat at ``seat_m``; some have arm rests, a round head rest or slats."""
    seat = float(rng.uniform(0.42, 0.5)) if seat_m is None else seat_m
    albedo = _albedo(rng)
    parts = [(box((0.44, 0.44, 0.05), (0.0, 0.0, seat - 0.05)), albedo)]
    if rng.uniform() < 0.5 and seat > 0.3:
        parts += [(cylinder(0.03, seat - 0.05), 0.3), (cylinder(0.28, 0.05), 0.3)]
    else:
        parts += [
            (box((0.04, 0.04, seat - 0.05), (sx * 0.19, sy * 0.19, 0.0)), 0.4)
            for sx in (-1, 1)
            for sy in (-1, 1)
        ]
    if back if back is not None else rng.uniform() < 0.85:
        h = float(rng.uniform(0.3, 0.6))
        style = rng.uniform()
        if style < 0.5:
            parts.append((box((0.05, 0.42, h), (-0.24, 0.0, seat + 0.08)), albedo))
        elif style < 0.75:
            parts.append((lump(rng, (0.05, 0.22, h / 2), (-0.26, 0.0, seat + 0.1 + h / 2), 0.03), albedo))
        else:
            parts += [(box((0.03, 0.04, h), (-0.23, y, seat)), albedo) for y in (-0.2, -0.1, 0.0, 0.1, 0.2)]
            parts.append((box((0.03, 0.44, 0.05), (-0.23, 0.0, seat + h)), albedo))
        if rng.uniform() < 0.2:
            parts.append((ellipsoid((0.05, 0.13, 0.09), (-0.27, 0.0, seat + h + 0.16)), albedo))
    return item("chair", *parts)


def sofa(rng: Rng, seat_m: float | None = None) -> Item:
    """A sofa for one to three that faces along x."""
    width, albedo = float(rng.uniform(0.9, 2.2)), _albedo(rng)
    seat = float(rng.uniform(0.38, 0.46)) if seat_m is None else seat_m
    back = seat + float(rng.uniform(0.3, 0.5))
    parts = [
        (box((0.8, width, seat)), albedo),
        (box((0.2, width, back), (-0.4, 0.0, 0.0)), albedo),
        (box((0.8, 0.15, seat + 0.2), (0.0, width / 2, 0.0)), albedo),
        (box((0.8, 0.15, seat + 0.2), (0.0, -width / 2, 0.0)), albedo),
    ]
    for _ in range(int(rng.integers(0, 3))):
        at = (-0.2, float(rng.uniform(-0.35, 0.35)) * width, seat + 0.15)
        parts.append((lump(rng, (0.09, 0.2, 0.2), at, 0.06), _albedo(rng)))
    return item("sofa", *parts)


def shelf(rng: Rng) -> Item:
    """A shelf that faces along x, with things in it and on top."""
    w, h, d = float(rng.uniform(0.6, 1.4)), float(rng.uniform(0.8, 2.0)), float(rng.uniform(0.25, 0.4))
    albedo = _albedo(rng)
    shell = [
        (box((d, 0.03, h), (0.0, -w / 2, 0.0)), albedo),
        (box((d, 0.03, h), (0.0, w / 2, 0.0)), albedo),
        (box((0.02, w, h), (-d / 2, 0.0, 0.0)), albedo),
    ]
    levels = np.linspace(0.05, h, int(rng.integers(3, 6)))
    shell += [(box((d, w, 0.03), (0.0, 0.0, float(z) - 0.03)), albedo) for z in levels]
    things = []
    for z in levels:
        for _ in range(int(rng.integers(0, 4))):
            thing = pick(rng, [ball, bottle, vase, carton, bag])
            at = float(rng.uniform(-0.4, 0.4)) * w
            if z == levels[-1] or thing.top() < levels[1] - levels[0]:
                things.append(thing.placed(0.0, at, float(rng.uniform(0.0, 6.3)), float(z)))
    return together("shelf", item("shelf", *shell), *things)


def coat_stand(rng: Rng) -> Item:
    """A pole with jackets on its hooks and, often, a hat on top: the best likeness of a person in a room."""
    height = float(rng.uniform(1.45, 1.85))
    things = [item("stand", (cylinder(0.2, 0.03), 0.4), (cylinder(0.02, height), 0.4))]
    for _ in range(int(rng.integers(0, 3))):
        angle = float(rng.uniform(0.0, 6.3))
        things.append(jacket(rng).placed(0.1 * np.cos(angle), 0.1 * np.sin(angle), angle, height - 0.1))
    if rng.uniform() < 0.7:
        things.append(hat(rng).placed(0.0, 0.0, 0.0, height - 0.05))
    return together("coat stand", *things)


def pillar(rng: Rng) -> Item:
    """A pillar, or a narrow cupboard."""
    w, d, h = float(rng.uniform(0.2, 0.7)), float(rng.uniform(0.2, 0.6)), float(rng.uniform(1.1, 2.6))
    if rng.uniform() < 0.3:
        return item("pillar", (cylinder(w / 2, h), _albedo(rng)))
    return item("cupboard", (box((d, w, h)), _albedo(rng)))


def bust(rng: Rng) -> Item:
    """A dress-maker's torso without a head, on a pole."""
    albedo, lift = _albedo(rng), float(rng.uniform(0.9, 1.1))
    return item(
        "bust",
        (cylinder(0.16, 0.03), 0.4),
        (cylinder(0.02, lift), 0.4),
        (ellipsoid((0.11, 0.19, 0.33), (0.0, 0.0, lift + 0.2)), albedo),
        (cylinder(0.05, 0.08, (0.0, 0.0, lift + 0.5)), albedo),
    )


def bed(rng: Rng) -> Item:
    """A low bed or couch, its long side along x."""
    h, albedo = float(rng.uniform(0.3, 0.55)), _albedo(rng)
    return item(
        "bed", (box((2.05, 0.95, h)), albedo), (box((0.08, 0.95, h + 0.35), (-1.05, 0.0, 0.0)), albedo)
    )


def pick(rng: Rng, makers: Sequence[Callable[..., Item]]) -> Item:
    """Make one of the things."""
    return makers[int(rng.integers(len(makers)))](rng)


# ---------------------------------------------------------------- the floor plan


class FloorPlan:
    """Which 5 cm cells of a room's floor are ``taken`` by things, and which by ``people``, who may walk away.

    Points outside the room count as taken.
    """

    def __init__(self, x_m: float, y_m: float) -> None:
        """A room of ``x_m`` by ``y_m`` metres around the origin, empty."""
        self.origin = np.array([-x_m / 2.0, -y_m / 2.0])
        self.taken: npt.NDArray[np.bool_] = np.zeros((int(x_m / CELL_M), int(y_m / CELL_M)), np.bool_)
        self.people = self.taken.copy()

    def cells(self, xy: F64) -> npt.NDArray[np.int64]:
        """The cells (K, 2) under those of the points (N, 2) that are inside the room."""
        cells = np.floor((xy - self.origin) / CELL_M).astype(np.int64)
        return np.asarray(cells[((cells >= 0) & (cells < self.taken.shape)).all(axis=1)])

    def conflict(self, xy: F64) -> float:
        """Share (0..1) of the points (N, 2) that are over taken cells or outside."""
        i, j = self.cells(xy).T
        free = ~(self.taken[i, j] | self.people[i, j])
        return 1.0 - float(free.sum()) / max(len(xy), 1)

    def take(self, xy: F64, by_person: bool = False) -> None:
        """Mark the cells under the points (N, 2)."""
        i, j = self.cells(xy).T
        (self.people if by_person else self.taken)[i, j] = True

    def middle(self, cells: npt.NDArray[np.int64]) -> F64:
        """Floor points (N, 2) in the middle of cells (N, 2)."""
        return np.asarray(self.origin + (cells + 0.5) * CELL_M)

    def copy(self) -> FloorPlan:
        """A plan of its own."""
        other = FloorPlan(1.0, 1.0)
        other.origin, other.taken, other.people = self.origin.copy(), self.taken.copy(), self.people.copy()
        return other


def rectangle(low: F64, high: F64) -> F64:
    """Points (N, 2) that fill a rectangle closely enough for the floor plan."""
    x = np.linspace(low[0], high[0], int((high[0] - low[0]) / CELL_M * 1.5) + 2)
    y = np.linspace(low[1], high[1], int((high[1] - low[1]) / CELL_M * 1.5) + 2)
    return np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)


def footprint(thing: Item, x: float, y: float, yaw_rad: float) -> F64:
    """Floor points (N, 2) under the item's own rectangle once it is placed."""
    points = rectangle(thing.vertices[:, :2].min(axis=0), thing.vertices[:, :2].max(axis=0))
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.asarray(points @ np.array([[c, s], [-s, c]]) + np.array([x, y]))


# ---------------------------------------------------------------- rooms


@dataclass(frozen=True, slots=True)
class Dummy:
    """A head that is nobody's: ``centre`` (3,) metres in the world; it counts neither way."""

    item: Item
    centre: F64
    yaw_rad: float


@dataclass(slots=True)
class Room:
    """A room around the world's origin, floor at z = 0."""

    x_m: float
    y_m: float
    items: list[Item]
    dummies: list[Dummy]
    plan: FloorPlan

    def add(self, thing: Item, x: float, y: float, yaw_rad: float = 0.0, z: float = 0.0) -> Item:
        """Put a thing into the room and its footprint on the plan."""
        placed = thing.placed(x, y, yaw_rad, z)
        self.items.append(placed)
        self.plan.take(footprint(thing, x, y, yaw_rad))
        return placed

    def try_add(self, rng: Rng, thing: Item, *, at_wall: bool = False) -> Item | None:
        """Try some places for a thing; None when there is no room for it."""
        for _ in range(8):
            x, y, yaw = _at_wall(rng, self, thing) if at_wall else _anywhere(rng, self)
            if self.plan.conflict(footprint(thing, x, y, yaw)) == 0.0:
                return self.add(thing, x, y, yaw)
        return None

    def mesh(self) -> Mesh:
        """All triangles but the dummies'."""
        return join([thing.mesh() for thing in self.items])


def _anywhere(rng: Rng, room: Room) -> tuple[float, float, float]:
    x, y = float(rng.uniform(-0.5, 0.5)) * room.x_m, float(rng.uniform(-0.5, 0.5)) * room.y_m
    yaw = (
        float(rng.integers(4)) * np.pi / 2.0 if rng.uniform() < 0.5 else float(rng.uniform(0.0, 2.0 * np.pi))
    )
    return x, y, yaw


def _at_wall(rng: Rng, room: Room, thing: Item) -> tuple[float, float, float]:
    gap = -float(thing.vertices[:, 0].min()) + 0.02
    side, along = int(rng.integers(4)), float(rng.uniform(-0.45, 0.45))
    if side == 0:
        return -room.x_m / 2.0 + gap, along * room.y_m, 0.0
    if side == 1:
        return room.x_m / 2.0 - gap, along * room.y_m, np.pi
    if side == 2:
        return along * room.x_m, -room.y_m / 2.0 + gap, np.pi / 2.0
    return along * room.x_m, room.y_m / 2.0 - gap, -np.pi / 2.0


def shell(rng: Rng, x_m: float, y_m: float) -> list[Item]:
    """Floor, walls with doors and windows, and sometimes a ceiling."""
    height = float(rng.uniform(2.4, 3.4))
    parts = [(box((x_m + 0.2, y_m + 0.2, 0.1), (0.0, 0.0, -0.1)), float(rng.uniform(0.15, 0.8)))]
    if rng.uniform() < 0.7:
        parts.append((box((x_m, y_m, 0.1), (0.0, 0.0, height)), float(rng.uniform(0.5, 0.9))))
    albedo = float(rng.uniform(0.25, 0.9))
    things = []
    for side in range(4):
        if rng.uniform() < 0.12:
            continue  # open to a hall
        length, away = (y_m, x_m / 2.0) if side % 2 == 0 else (x_m, y_m / 2.0)
        wall = _wall(rng, length, height, albedo).placed(-away, 0.0)
        things.append(wall.placed(0.0, 0.0, side * np.pi / 2.0))
    return [item("floor", *parts), *things]


def _wall(rng: Rng, length: float, height: float, albedo: float) -> Item:
    """A wall along y at x = 0 that is seen from +x, with a door frame or a window or a board or a screen."""
    parts = []
    kind = rng.uniform()
    if kind < 0.35:  # a doorway
        middle, half = float(rng.uniform(-0.3, 0.3)) * length, 0.45
        left, right = length / 2.0 + middle - half, length / 2.0 - middle - half
        parts += [
            (box((0.1, left, height), (-0.05, -length / 2.0 + left / 2.0, 0.0)), albedo),
            (box((0.1, right, height), (-0.05, length / 2.0 - right / 2.0, 0.0)), albedo),
            (box((0.1, 2 * half, height - 2.05), (-0.05, middle, 2.05)), albedo),
        ]
        frame = float(rng.uniform(0.3, 0.9))
        parts += [(box((0.14, 0.07, 2.05), (-0.05, middle + s * half, 0.0)), frame) for s in (-1, 1)]
        parts.append((box((0.14, 0.97, 0.07), (-0.05, middle, 2.02)), frame))
        if rng.uniform() < 0.5:
            parts.append((box((0.8, 0.04, 2.0), (0.4, middle + half, 0.0)), frame))
    else:
        parts.append((box((0.1, length, height), (-0.05, 0.0, 0.0)), albedo))
        middle, width = float(rng.uniform(-0.25, 0.25)) * length, float(rng.uniform(0.6, 0.4 * length))
        if kind < 0.55:  # a window: glass answers nothing
            parts.append((box((0.01, width, 1.2), (0.005, middle, 0.9)), 0.004))
            bars = np.linspace(-width / 2.0, width / 2.0, 3)
            parts += [(box((0.05, 0.06, 1.2), (0.02, middle + float(b), 0.9)), 0.7) for b in bars]
        elif kind < 0.7:  # a screen or a board
            parts.append((box((0.06, width, 0.8), (0.03, middle, 1.0)), _albedo(rng)))
            parts.append(
                (box((0.01, 0.95 * width, 0.74), (0.065, middle, 1.03)), float(rng.uniform(0.01, 0.3)))
            )
        elif kind < 0.8:  # curtains
            parts += [
                (cylinder(float(rng.uniform(0.04, 0.08)), height - 0.1, (0.06, middle + 0.1 * k, 0.0)), 0.6)
                for k in range(int(width / 0.1))
            ]
    wall = item("wall", *parts)
    if rng.uniform() < 0.4:
        hooks = item("hooks", (box((0.02, 0.8, 0.05), (0.01, 0.0, 1.6)), 0.5))
        hung = [hooks]
        for y in (-0.3, 0.0, 0.3):
            what = rng.uniform()
            if what < 0.45:
                hung.append(jacket(rng).placed(0.12, y, 0.0, 1.6))
            elif what < 0.75:
                hung.append(hat(rng).placed(0.12, y, 0.0, 1.55))
        wall = together(
            "wall", wall, together("hooks", *hung).placed(0.0, float(rng.uniform(-0.35, 0.35)) * length)
        )
    return wall


ON_TABLES: tuple[Callable[..., Item], ...] = (
    ball, vase, bottle, bottle, table_lamp, plant, monitor, monitor, laptop, bag, carton, hat,
)  # fmt: skip
ON_FLOOR: tuple[Callable[..., Item], ...] = (
    ball, pole_lamp, pole_lamp, plant, bag, carton, coat_stand, bust, pillar, chair, chair,
)  # fmt: skip
AT_WALLS: tuple[Callable[..., Item], ...] = (shelf, sofa, pillar, table, bed, carton)


def sample_room(rng: Rng, clutter: float | None = None, size_m: tuple[float, float] | None = None) -> Room:
    """A room of 4-9 m. ``clutter`` 0..1 says how full it is; sampled when not given."""
    x_m, y_m = (float(rng.uniform(4.0, 9.0)), float(rng.uniform(4.0, 9.0))) if size_m is None else size_m
    fullness = float(rng.uniform(0.0, 1.0)) if clutter is None else clutter
    room = Room(x_m, y_m, shell(rng, x_m, y_m), [], FloorPlan(x_m, y_m))
    scale = x_m * y_m / 36.0
    for _ in range(int(rng.poisson(3.0 * fullness * scale))):
        room.try_add(rng, pick(rng, AT_WALLS), at_wall=True)
    for _ in range(int(rng.poisson(1.5 * fullness * scale))):
        add_table(rng, room)
    for _ in range(int(rng.poisson(4.0 * fullness * scale))):
        room.try_add(rng, pick(rng, ON_FLOOR))
    return room


def add_table(rng: Rng, room: Room) -> None:
    """A table with things on it and chairs around it, if there is space."""
    plain = table(rng)
    top, (half_x, half_y) = plain.top(), plain.vertices[:, :2].max(axis=0) - 0.1
    placed = room.try_add(rng, plain)
    if placed is None:
        return
    middle = placed.vertices[:, :2].mean(axis=0)
    edge = placed.vertices[4, :2] - placed.vertices[0, :2]  # along the table's own x
    yaw = float(np.arctan2(edge[1], edge[0]))
    across, along = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    for _ in range(int(rng.integers(0, 5))):
        at = middle + across * rng.uniform(-half_x, half_x) + along * rng.uniform(-half_y, half_y)
        thing = pick(rng, ON_TABLES)
        room.items.append(thing.placed(float(at[0]), float(at[1]), float(rng.uniform(0.0, 6.3)), top))
    if rng.uniform() < 0.15:
        _put_dummy(rng, room, middle, top)
    for side in (-1.0, 1.0):
        for _ in range(int(rng.integers(0, 3))):
            at = middle + across * side * (half_x + 0.45) + along * rng.uniform(-half_y, half_y)
            turn = yaw + (np.pi if side > 0.0 else 0.0) + float(rng.normal(0.0, 0.3))
            seat = chair(rng)
            if room.plan.conflict(footprint(seat, float(at[0]), float(at[1]), turn)) == 0.0:
                room.add(_loaded(rng, seat), float(at[0]), float(at[1]), turn)


def _loaded(rng: Rng, seat: Item) -> Item:
    """The chair, perhaps with a bag or a ball on it or a jacket over its back."""
    what = rng.uniform()
    seat_m = float(seat.vertices[:8, 2].max())
    if what < 0.15:
        return together("chair", seat, bag(rng).placed(0.0, 0.0, float(rng.uniform(0.0, 6.3)), seat_m))
    if what < 0.2:
        return together("chair", seat, ball(rng).placed(0.0, 0.0, 0.0, seat_m))
    if what < 0.3:
        return together("chair", seat, jacket(rng).placed(-0.26, 0.0, 0.0, seat.top() + 0.05))
    return seat


def _put_dummy(rng: Rng, room: Room, xy: F64, z: float) -> None:
    yaw = float(rng.uniform(0.0, 2.0 * np.pi))
    thing = dummy_head(rng).placed(float(xy[0]), float(xy[1]), yaw, z)
    room.dummies.append(Dummy(thing, np.array([xy[0], xy[1], z + DUMMY_CENTRE_M]), yaw))


def add_dummy(rng: Rng, room: Room) -> None:
    """A mannequin head on a stand, if there is space."""
    height = float(rng.uniform(0.7, 1.5))
    stand = room.try_add(rng, item("stand", (cylinder(0.18, 0.03), 0.4), (cylinder(0.03, height), 0.4)))
    if stand is not None:
        _put_dummy(rng, room, stand.vertices[:, :2].mean(axis=0), height)
