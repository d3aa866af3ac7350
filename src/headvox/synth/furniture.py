"""Furniture, and the things that look like heads to a detector.

Every item is made of a few light triangle solids, and stands on z = 0 around its own origin.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from headvox.data import F32, F64, I32
from headvox.synth.rays import ROOM_ID, Mesh, join
from headvox.synth.solids import Rng, Solid, box, cylinder, ellipsoid, lathe, lump


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


def sample_albedo(rng: Rng) -> float:
    """Draw how much of the light a thing sends back, 0..1."""
    # Most things send enough back; one in six is black or shiny, and is what holes come from.
    return float(rng.uniform(0.02, 0.12) if rng.uniform() < 0.16 else rng.uniform(0.2, 0.9))


def ball(rng: Rng) -> Item:
    """A ball of any size between a tennis ball and a gym ball."""
    radius = float(rng.choice([rng.uniform(0.03, 0.09), rng.uniform(0.09, 0.13), rng.uniform(0.13, 0.38)]))
    return item("ball", (ellipsoid((radius, radius, radius), (0.0, 0.0, radius)), sample_albedo(rng)))


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
    return item("vase", (lathe([(float(r), float(z)) for r, z in profile]), sample_albedo(rng)))


def bottle(rng: Rng) -> Item:
    """A bottle."""
    r, h = float(rng.uniform(0.03, 0.06)), float(rng.uniform(0.2, 0.36))
    return item(
        "bottle",
        (
            lathe([(0.0, 0.0), (r, 0.0), (r, 0.6 * h), (0.4 * r, 0.8 * h), (0.4 * r, h), (0.0, h)]),
            sample_albedo(rng),
        ),
    )


def pole_lamp(rng: Rng) -> Item:
    """A lamp on a pole: a round or a conical shade at the height of a head."""
    height, radius = float(rng.uniform(1.0, 1.9)), float(rng.uniform(0.08, 0.24))
    parts = [(cylinder(0.14, 0.03), sample_albedo(rng)), (cylinder(0.015, height), sample_albedo(rng))]
    if rng.uniform() < 0.5:
        parts.append((ellipsoid((radius, radius, radius), (0.0, 0.0, height)), sample_albedo(rng)))
    else:
        shade = [(radius, 0.0), (radius * float(rng.uniform(0.4, 1.0)), float(rng.uniform(0.18, 0.35)))]
        parts.append((lathe(shade, (0.0, 0.0, height - 0.1)), sample_albedo(rng)))
    return item("pole lamp", *parts)


def table_lamp(rng: Rng) -> Item:
    """A small lamp with a shade."""
    h, r = float(rng.uniform(0.2, 0.4)), float(rng.uniform(0.07, 0.15))
    return item(
        "table lamp",
        (cylinder(0.07, 0.02), sample_albedo(rng)),
        (cylinder(0.012, h), sample_albedo(rng)),
        (lathe([(r, 0.0), (0.6 * r, 1.3 * r)], (0.0, 0.0, h)), sample_albedo(rng)),
    )


def plant(rng: Rng) -> Item:
    """A pot with a crown of leaves, from a table plant to a small tree."""
    size = float(rng.uniform(0.25, 1.0))
    stem, crown = 0.9 * size * float(rng.uniform(0.4, 1.0)), 0.25 * size + 0.06
    parts = [
        (
            lathe([(0.0, 0.0), (0.14 * size, 0.0), (0.2 * size, 0.3 * size), (0.0, 0.3 * size)]),
            sample_albedo(rng),
        ),
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
        (box((0.04, w, h), (0.0, 0.0, lift)), sample_albedo(rng)),
        (box((0.005, 0.94 * w, 0.9 * h), (0.025, 0.0, lift + 0.05 * h)), float(rng.uniform(0.005, 0.06))),
        (box((0.04, 0.06, lift), (-0.03, 0.0, 0.0)), 0.3),
        (box((0.2, 0.26, 0.02)), 0.3),
    )


def laptop(rng: Rng) -> Item:
    """An open laptop."""
    return item(
        "laptop",
        (box((0.24, 0.34, 0.02)), sample_albedo(rng)),
        (box((0.02, 0.34, 0.22), (-0.12, 0.0, 0.02)), 0.04),
    )


def bag(rng: Rng) -> Item:
    """A bag or a rucksack."""
    axes = (float(rng.uniform(0.08, 0.16)), float(rng.uniform(0.1, 0.22)), float(rng.uniform(0.12, 0.25)))
    return item("bag", (lump(rng, axes, (0.0, 0.0, axes[2]), 0.08), sample_albedo(rng)))


def carton(rng: Rng) -> Item:
    """A box."""
    w, d, h = (float(n) for n in rng.uniform(0.12, 0.6, 3))
    return item("box", (box((w, d, h)), sample_albedo(rng)))


def hat(rng: Rng) -> Item:
    """A hat with a brim."""
    r = float(rng.uniform(0.085, 0.11))
    profile = [(0.0, 0.0), (r * float(rng.uniform(1.1, 1.7)), 0.0), (r, 0.02), (0.9 * r, 0.1), (0.0, 0.13)]
    return item("hat", (lathe(profile), sample_albedo(rng)))


def jacket(rng: Rng) -> Item:
    """A jacket that hangs: shoulders, a drooping body, perhaps a hood; its top is at the origin."""
    albedo = sample_albedo(rng)
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
    parts = [(box((w, d, 0.04), (0.0, 0.0, h - 0.04)), sample_albedo(rng))]
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
    albedo = sample_albedo(rng)
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
    width, albedo = float(rng.uniform(0.9, 2.2)), sample_albedo(rng)
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
        parts.append((lump(rng, (0.09, 0.2, 0.2), at, 0.06), sample_albedo(rng)))
    return item("sofa", *parts)


def shelf(rng: Rng) -> Item:
    """A shelf that faces along x, with things in it and on top."""
    w, h, d = float(rng.uniform(0.6, 1.4)), float(rng.uniform(0.8, 2.0)), float(rng.uniform(0.25, 0.4))
    albedo = sample_albedo(rng)
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
        return item("pillar", (cylinder(w / 2, h), sample_albedo(rng)))
    return item("cupboard", (box((d, w, h)), sample_albedo(rng)))


def bust(rng: Rng) -> Item:
    """A dress-maker's torso without a head, on a pole."""
    albedo, lift = sample_albedo(rng), float(rng.uniform(0.9, 1.1))
    return item(
        "bust",
        (cylinder(0.16, 0.03), 0.4),
        (cylinder(0.02, lift), 0.4),
        (ellipsoid((0.11, 0.19, 0.33), (0.0, 0.0, lift + 0.2)), albedo),
        (cylinder(0.05, 0.08, (0.0, 0.0, lift + 0.5)), albedo),
    )


def bed(rng: Rng) -> Item:
    """A low bed or couch, its long side along x."""
    h, albedo = float(rng.uniform(0.3, 0.55)), sample_albedo(rng)
    return item(
        "bed", (box((2.05, 0.95, h)), albedo), (box((0.08, 0.95, h + 0.35), (-1.05, 0.0, 0.0)), albedo)
    )


def pick(rng: Rng, makers: Sequence[Callable[..., Item]]) -> Item:
    """Make one of the things."""
    return makers[int(rng.integers(len(makers)))](rng)
