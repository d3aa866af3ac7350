"""Rooms: walls, and what stands in them, placed by a turn about z and a shift."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from headvox.data import F64
from headvox.synth.floorplan import FloorPlan, footprint
from headvox.synth.furniture import (
    DUMMY_CENTRE_M,
    Item,
    bag,
    ball,
    bed,
    bottle,
    bust,
    carton,
    chair,
    coat_stand,
    dummy_head,
    hat,
    item,
    jacket,
    laptop,
    monitor,
    pick,
    pillar,
    plant,
    pole_lamp,
    sample_albedo,
    shelf,
    sofa,
    table,
    table_lamp,
    together,
    vase,
)
from headvox.synth.rays import Mesh, join
from headvox.synth.solids import Rng, box, cylinder


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
            parts.append((box((0.06, width, 0.8), (0.03, middle, 1.0)), sample_albedo(rng)))
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
