"""What people wear: hair, beards, hats, glasses, masks, headphones and the volume of clothes.

Everything is built on the rest body and skinned with it, so that it follows every pose. Things on the head
are grids over azimuth and elevation about the head's centre: azimuth 0 is the face, 90 degrees the left ear.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from headvox.data import F64
from headvox.synth.bodies import I32, Mask, RestBody, load_basis

SKIN, HAIR, CLOTH, HAT, GLASSES = 0, 1, 2, 3, 4

HAIR_STYLES = ("bald", "short", "bulky", "long", "bun", "ponytail")
HATS = ("none", "beanie", "cap", "helmet", "hood")

N_AZIMUTH = 32
N_ROWS = 10
# Elevation of a rim in degrees over |azimuth| 0, 30, 60, 80, 100, 130, 180.
RIM_AZIMUTH = (0.0, 30.0, 60.0, 80.0, 100.0, 130.0, 180.0)
RIMS = {
    "hair": (36.0, 36.0, 30.0, 14.0, 4.0, -22.0, -32.0),
    "beanie": (24.0, 23.0, 18.0, 8.0, 2.0, -8.0, -14.0),
    "cap": (28.0, 27.0, 23.0, 18.0, 14.0, 4.0, 0.0),
    "helmet": (26.0, 25.0, 22.0, 14.0, 6.0, -4.0, -10.0),
    "hood": (50.0, 46.0, 0.0, -40.0, -48.0, -50.0, -50.0),
}


@dataclass(frozen=True, slots=True)
class Wear:
    """What somebody wears; lengths in metres.

    ``hair`` is one of HAIR_STYLES with ``hair_m`` its thickness and ``hair_length_m`` how far it hangs;
    ``hair_albedo`` runs from 0 (black) to 1 (white); ``receding`` from 0 to 1 lifts the hairline of the
    forehead and ``fringe`` lowers it. ``beard_m`` and ``scarf_m`` are thicknesses, 0 is none. ``hat`` is one
    of HATS, ``hat_m`` its wall and ``hat_turn_rad`` where a visor points. ``cloth_m`` is how far clothes are
    off the skin; ``sleeves`` and ``trousers`` run from 0 (short) to 1 (long). ``seed`` draws every noise.
    """

    hair: str = "short"
    hair_m: float = 0.008
    hair_length_m: float = 0.0
    hair_albedo: float = 0.2
    receding: float = 0.0
    fringe: float = 0.0
    beard_m: float = 0.0
    hat: str = "none"
    hat_m: float = 0.008
    hat_turn_rad: float = 0.0
    glasses: str = "none"  # none, clear, dark
    mask: bool = False
    headphones: bool = False
    scarf_m: float = 0.0
    backpack: bool = False
    cloth_m: float = 0.01
    sleeves: float = 1.0
    trousers: float = 1.0
    seed: int = 0


NOTHING = Wear(hair="bald", cloth_m=0.0)


@dataclass(frozen=True, slots=True)
class Outfit:
    """A dressed body at rest.

    ``vertices`` (V, 3), ``skin_joints`` and ``skin_weights`` (V, 4), ``faces`` (F, 3), ``materials`` (F,).
    """

    vertices: F64
    skin_joints: I32
    skin_weights: F64
    faces: I32
    materials: npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Piece:
    """Something added to the body; ``follows_chest`` (V,) is the share of skinning that is not the head's."""

    vertices: F64
    faces: I32
    material: int
    follows_chest: F64 | None = None


def sample_wear(rng: np.random.Generator, sex: float, age_years: float) -> Wear:
    """Draw what a person wears."""
    female = sex > 0.5
    style_shares = (0.02, 0.25, 0.18, 0.30, 0.11, 0.14) if female else (0.16, 0.54, 0.22, 0.04, 0.01, 0.03)
    hair = HAIR_STYLES[int(rng.choice(len(HAIR_STYLES), p=style_shares))]
    thickness = {"short": (0.004, 0.015), "bulky": (0.015, 0.055), "long": (0.008, 0.028)}.get(
        hair, (0.004, 0.014)
    )
    grey = np.clip((age_years - 45.0) / 40.0, 0.0, 1.0) * rng.random()
    adult_man = not female and age_years > 18.0
    beard = rng.random() < 0.45 and adult_man
    hat = HATS[int(rng.choice(len(HATS), p=(0.76, 0.08, 0.08, 0.03, 0.05)))]
    hat_wall = {"helmet": (0.018, 0.04), "hood": (0.012, 0.035)}.get(hat, (0.004, 0.014))
    return Wear(
        hair=hair,
        hair_m=float(rng.uniform(*thickness)),
        hair_length_m=float(rng.uniform(0.12, 0.38)),
        hair_albedo=float(np.clip((1.0 - grey) * rng.beta(1.2, 3.0) + grey * 0.8, 0.02, 0.95)),
        receding=float(rng.beta(0.6, 2.0)) if adult_man else float(0.15 * rng.random()),
        fringe=float(rng.beta(0.7, 2.2 if not female else 1.3)),
        beard_m=float(rng.choice((0.003, 0.008, 0.015, 0.03), p=(0.4, 0.3, 0.2, 0.1))) if beard else 0.0,
        hat=hat,
        hat_m=float(rng.uniform(*hat_wall)),
        hat_turn_rad=float(rng.choice((0.0, np.pi), p=(0.8, 0.2)) + rng.normal(0.0, 0.1)),
        glasses=("none", "clear", "dark")[int(rng.choice(3, p=(0.68, 0.26, 0.06)))],
        mask=bool(rng.random() < 0.06),
        headphones=bool(rng.random() < 0.06) and hat in ("none", "beanie"),
        scarf_m=float(rng.uniform(0.015, 0.04)) if rng.random() < 0.06 else 0.0,
        backpack=bool(rng.random() < 0.08),
        cloth_m=float(0.005 + 0.035 * rng.beta(1.1, 2.2)),
        sleeves=float(rng.choice((0.15, 0.3, 0.6, 1.0), p=(0.1, 0.3, 0.1, 0.5))),
        trousers=float(rng.choice((0.25, 0.5, 1.0), p=(0.1, 0.15, 0.75))),
        seed=int(rng.integers(2**31)),
    )


def dress(body: RestBody, wear: Wear) -> Outfit:
    """Dress a rest body: clothes and beard move its skin outwards, the rest is added."""
    basis = load_basis()
    rng = np.random.default_rng(wear.seed)
    head = HeadField(body)
    vertices, materials = _clothe(body, wear, rng)
    pieces: list[Piece] = []
    if wear.hair != "bald":
        pieces += _hair(body, vertices, head, wear, rng)
    if wear.hat != "none":
        pieces += _hat(body, vertices, head, wear)
    if wear.glasses != "none":
        pieces += _glasses(body, wear.glasses == "dark")
    if wear.mask:
        pieces.append(_mask(head))
    if wear.headphones:
        pieces += _headphones(body, head, wear)
    if wear.scarf_m > 0.0:
        pieces.append(_scarf(body, vertices, wear))
    if wear.backpack:
        pieces.append(_backpack(body, vertices, wear))
    return _assemble(vertices, materials, pieces, basis.joint("head"), basis.joint("spine01"))


def _assemble(
    vertices: F64, materials: npt.NDArray[np.uint8], pieces: list[Piece], head: int, chest: int
) -> Outfit:
    basis = load_basis()
    points, joints, weights = [vertices], [basis.skin_joints], [basis.skin_weights]
    faces, kinds = [basis.faces], [materials]
    start = len(vertices)
    for piece in pieces:
        n = len(piece.vertices)
        share = np.zeros(n) if piece.follows_chest is None else piece.follows_chest
        points.append(piece.vertices)
        joints.append(np.tile(np.array([head, chest, head, head], dtype=np.int32), (n, 1)))
        weights.append(np.column_stack([1.0 - share, share, np.zeros(n), np.zeros(n)]))
        faces.append((piece.faces + start).astype(np.int32))
        kinds.append(np.full(len(piece.faces), piece.material, dtype=np.uint8))
        start += n
    return Outfit(
        np.concatenate(points),
        np.concatenate(joints),
        np.concatenate(weights),
        np.concatenate(faces),
        np.concatenate(kinds),
    )


# ---------------------------------------------------------------------------------------------- geometry


def vertex_normals(vertices: F64, faces: I32) -> F64:
    """Return the area-weighted outward unit normals (V, 3)."""
    corners = vertices[faces]
    of_face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for axis in range(3):
        weights = np.repeat(of_face[:, axis], 3)
        normals[:, axis] = np.bincount(faces.ravel(), weights=weights, minlength=len(vertices))
    lengths = np.sqrt((normals * normals).sum(1, keepdims=True))
    return np.asarray(normals / np.maximum(lengths, 1e-12))


def smooth_noise(points: F64, rng: np.random.Generator, wavelength_m: float, waves: int = 6) -> F64:
    """Return smooth noise in about -1..1 at (..., 3) points: a sum of plane waves of random direction."""
    directions = rng.normal(size=(waves, 3))
    directions /= np.sqrt((directions * directions).sum(1, keepdims=True))
    lengths = wavelength_m * rng.uniform(0.6, 1.6, waves)
    phases = rng.uniform(0.0, 2.0 * np.pi, waves)
    angles = np.einsum("...a,wa->...w", points, directions) * (2.0 * np.pi / lengths) + phases
    return np.asarray(np.sin(angles).sum(-1) / np.sqrt(waves / 2.0) / 2.0)


def _ramp(x: F64, low: float, high: float) -> F64:
    """Return 0 below ``low``, 1 above ``high``, smooth between."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def _around(count: int) -> F64:
    """Return ``count`` equal steps round the circle, radians."""
    return np.asarray(np.arange(count) * (2.0 * np.pi / count), dtype=np.float64)


def _directions(azimuth: F64, elevation: F64) -> F64:
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)


def _grid_faces(rows: int, columns: int, closed: bool) -> I32:
    """Return triangles of a (rows, columns) grid, outward if columns run against the clock, rows up."""
    r, c = np.meshgrid(np.arange(rows - 1), np.arange(columns if closed else columns - 1), indexing="ij")
    right = (c + 1) % columns
    a, b, d, e = (
        x.ravel()
        for x in (r * columns + c, r * columns + right, (r + 1) * columns + c, (r + 1) * columns + right)
    )
    return np.concatenate([np.column_stack([a, b, e]), np.column_stack([a, e, d])]).astype(np.int32)


def _tube(path: F64, radii: npt.ArrayLike, material: int, closed: bool = False, sides: int = 8) -> Piece:
    """Sweep a circle along ``path`` (N, 3); ``radii`` is one number or one a point."""
    forward = np.roll(path, -1, 0) - np.roll(path, 1, 0) if closed else np.gradient(path, axis=0)
    forward /= np.sqrt((forward * forward).sum(1, keepdims=True))
    helper = np.eye(3)[int(np.argmin(np.abs(forward).max(0)))]
    across = np.cross(forward, helper)
    across /= np.sqrt((across * across).sum(1, keepdims=True))
    other = np.cross(forward, across)
    angle = _around(sides)
    ring = np.cos(angle)[None, :, None] * across[:, None] + np.sin(angle)[None, :, None] * other[:, None]
    vertices = (
        path[:, None] + np.broadcast_to(np.asarray(radii, dtype=np.float64), len(path))[:, None, None] * ring
    )
    rows = np.concatenate([vertices, vertices[:1]]) if closed else vertices
    return Piece(rows.reshape(-1, 3), _grid_faces(len(rows), sides, closed=True), material)


def _ball(centre: F64, radii: npt.ArrayLike, material: int, rows: int = 8, columns: int = 12) -> Piece:
    elevation, azimuth = np.meshgrid(
        np.linspace(-np.pi / 2, np.pi / 2, rows), np.arange(columns) * (2.0 * np.pi / columns), indexing="ij"
    )
    vertices = centre + _directions(azimuth, elevation) * np.asarray(radii)
    return Piece(vertices.reshape(-1, 3), _grid_faces(rows, columns, closed=True), material)


class HeadField:
    """The bald head without ears as a radius over directions from its centre."""

    def __init__(self, body: RestBody) -> None:
        basis = load_basis()
        offsets = (body.vertices - body.head_centre)[basis.is_head & ~basis.is_ear & ~basis.is_eye]
        self.radii = np.sqrt((offsets * offsets).sum(1))
        self.tree = cKDTree(offsets / self.radii[:, None])
        self.centre = body.head_centre
        self.size = body.head_size

    def radius(self, azimuth: F64, elevation: F64) -> F64:
        """Return the distance from centre to skin along directions, any shape, metres."""
        distance, near = self.tree.query(_directions(azimuth, elevation), k=4)
        weight = 1.0 / (distance * distance + 1e-4)
        return np.asarray((weight * self.radii[near]).sum(-1) / weight.sum(-1))

    def at(self, azimuth: F64, elevation: F64, radius: F64) -> F64:
        """Return the points (..., 3) of spherical coordinates about the centre."""
        return np.asarray(self.centre + _directions(azimuth, elevation) * radius[..., None])


def _rim(name: str, azimuth: F64) -> F64:
    """Return the elevation of a rim, radians, over azimuth in radians."""
    turned = np.abs((azimuth + np.pi) % (2.0 * np.pi) - np.pi)
    return np.asarray(np.radians(np.interp(np.degrees(turned), RIM_AZIMUTH, RIMS[name])))


def _shell(
    head: HeadField,
    rim: F64,
    wall: Callable[[F64, F64], F64],
    material: int,
    smooth: int = 0,
    taper: bool = False,
) -> Piece:
    """Build a cap over the head from its rim (one elevation an azimuth) to the pole.

    ``wall`` gives the distance from the skin over (azimuth, elevation); the rim is closed against the skin.
    ``smooth`` rounds of smoothing take the head's own relief out; ``taper`` thins the cap towards its rim.
    """
    azimuth = _around(len(rim))
    share = np.linspace(0.0, 1.0, N_ROWS)[:, None]
    elevation = rim[None, :] + share * (np.pi / 2 - rim[None, :])
    azimuth = np.tile(azimuth, (N_ROWS, 1))
    skin = head.radius(azimuth, elevation)
    thickness = wall(azimuth, elevation) * (_ramp(share, -0.05, 0.22) if taper else 1.0)
    radius = skin + thickness
    for _ in range(smooth):
        padded = np.concatenate([radius[:1], radius, radius[-1:]])
        around = (np.roll(radius, 1, 1) + np.roll(radius, -1, 1)) / 2
        radius = np.maximum(
            0.5 * radius + 0.25 * around + 0.125 * (padded[:-2] + padded[2:]), skin + 0.6 * thickness
        )
    radius[-1] = radius[-1].mean()
    points = head.at(azimuth, elevation, radius)
    inner = head.at(azimuth[:1], elevation[:1], skin[:1] - 0.002)
    rows = np.concatenate([inner, points])
    return Piece(rows.reshape(-1, 3), _grid_faces(len(rows), len(rim), closed=True), material)


def _curtain(
    body: RestBody,
    clothed: F64,
    azimuth: F64,
    top_z: float,
    length_m: F64,
    stand_off: float,
    material: int,
    rng: np.random.Generator,
) -> Piece:
    """Hang a sheet round the back of head and neck, outside of the trunk, down to a length or a shoulder.

    ``clothed`` (V, 3) are the vertices of the dressed body; ``azimuth`` and ``length_m`` are (columns,). The
    lower it hangs, the more it follows the chest.
    """
    rows = 16
    z = top_z - np.linspace(0.0, 1.0, rows)[:, None] * length_m
    axis = body.head_centre[:2] - (0.1 * body.head_size[0], 0.0)
    profile = _trunk_radius(clothed, axis, np.tile(azimuth, (rows, 1)), z)
    fall = length_m / (rows - 1)
    radius = np.empty_like(z)
    alive = np.ones_like(z, dtype=bool)
    radius[0] = profile[0] + stand_off
    for row in range(1, rows):
        alive[row] = alive[row - 1] & (profile[row] + stand_off < radius[0] + 0.025)
        drawn_in = radius[row - 1] - 0.35 * fall  # hair below the skull falls inwards again
        radius[row] = np.where(alive[row], np.maximum(profile[row] + stand_off, drawn_in), radius[row - 1])
    plain = np.stack([axis[0] + radius * np.cos(azimuth), axis[1] + radius * np.sin(azimuth), z], axis=-1)
    radius = radius + 0.35 * stand_off * smooth_noise(plain, rng, 0.05)
    points = np.stack([axis[0] + radius * np.cos(azimuth), axis[1] + radius * np.sin(azimuth), z], axis=-1)
    faces = _grid_faces(rows, len(azimuth), closed=False)[:, ::-1]
    share = 0.85 * _chest_share(body, points[..., 2].ravel())
    return Piece(points.reshape(-1, 3), faces[alive.ravel()[faces].all(1)], material, share)


def _chest_share(body: RestBody, z: F64) -> F64:
    """Return how far things at a height follow the chest: 0 at the chin and above, 1 at the shoulders."""
    basis = load_basis()
    shoulder_z, chin_z = body.joints[basis.joint("upperarm01.L"), 2], body.vertices[basis.menton, 2]
    return 1.0 - _ramp(z, shoulder_z, chin_z)


def _trunk_radius(clothed: F64, axis: F64, azimuth: F64, z: F64) -> F64:
    """Return how far head, neck and trunk reach from an upright axis (2,) at each azimuth and height."""
    basis = load_basis()
    arms = ("upperarm02", "lowerarm", "wrist", "finger")
    limbs = [i for i, name in enumerate(basis.joint_names) if name.startswith(arms)]
    part = ~np.isin(basis.skin_joints[:, 0], limbs) & (clothed[:, 2] > z.min() - 0.03)
    offset = clothed[part, :2] - axis
    reach, bearing = np.hypot(offset[:, 0], offset[:, 1]), np.arctan2(offset[:, 1], offset[:, 0])
    height = clothed[part, 2]
    out = np.zeros(z.shape)
    for column in range(z.shape[1]):
        beside = np.abs((bearing - azimuth[0, column] + np.pi) % (2.0 * np.pi) - np.pi) < 0.22
        near = np.abs(height[beside][None, :] - z[:, column, None]) < 0.02
        out[:, column] = np.where(near, reach[beside][None, :], 0.0).max(1, initial=0.0)
    return out


# ---------------------------------------------------------------------------------------------- clothes


def _clothe(body: RestBody, wear: Wear, rng: np.random.Generator) -> tuple[F64, npt.NDArray[np.uint8]]:
    """Return body vertices (V, 3) moved outwards by clothes and beard, and a material for each face (F,)."""
    basis = load_basis()
    cover = _cloth_cover(body, wear)
    normals = vertex_normals(body.vertices, basis.faces)
    folds = (
        1.0 + 0.35 * smooth_noise(body.vertices, rng, 0.16) + 0.15 * smooth_noise(body.vertices, rng, 0.05)
    )
    cloth = wear.cloth_m * cover * np.maximum(folds, 0.2)
    beard = _beard_cover(body) if wear.beard_m > 0.0 else np.zeros(len(cover))
    droop = np.array([0.25, 0.0, -0.9])
    bristle = wear.beard_m * beard * (1.0 + 0.25 * smooth_noise(body.vertices, rng, 0.05))
    long_part = max(0.0, wear.beard_m - 0.01) / max(wear.beard_m, 1e-9)  # long beards hang, short ones stand
    vertices = body.vertices + cloth[:, None] * normals
    vertices = vertices + bristle[:, None] * (
        (1.0 - long_part) * normals + long_part * (0.4 * normals + 0.6 * droop)
    )
    materials = np.full(len(basis.faces), SKIN, dtype=np.uint8)
    if wear.cloth_m > 0.0:
        materials[(cover[basis.faces] > 0.0).all(1)] = CLOTH
    materials[(beard[basis.faces] > 0.2).any(1)] = HAIR
    return vertices, materials


def _cloth_cover(body: RestBody, wear: Wear) -> F64:
    """Return how much of the cloth's thickness each vertex gets, 0 where the skin shows: (V,)."""
    basis = load_basis()

    def along(side: str, start: str, end: str) -> F64:
        """Position of every vertex along a limb, 0 at its start and 1 at its end."""
        a, b = (body.joints[basis.joint(f"{name}.{side}")] for name in (start, end))
        return np.asarray((body.vertices - a) @ (b - a) / ((b - a) @ (b - a)))

    cover = np.ones(len(body.vertices))
    neck = body.joints[basis.joint("neck01")]
    cover *= 1.0 - _ramp(body.vertices[:, 2] - neck[2] + 0.35 * (body.vertices[:, 0] - neck[0]), -0.01, 0.012)
    for side in "LR":
        on_arm = _owned(side, ("upperarm", "lowerarm", "wrist", "finger"))
        to_elbow = along(side, "upperarm01", "lowerarm01")
        to_wrist = np.where(to_elbow < 1.0, 0.5 * to_elbow, 0.5 + 0.5 * along(side, "lowerarm01", "wrist"))
        cover[on_arm] *= (0.7 * (1.0 - _ramp(to_wrist, wear.sleeves - 0.04, wear.sleeves)))[on_arm]
        on_leg = _owned(side, ("upperleg", "lowerleg"))
        to_knee = along(side, "upperleg01", "lowerleg01")
        to_foot = np.where(to_knee < 1.0, 0.5 * to_knee, 0.5 + 0.5 * along(side, "lowerleg01", "foot"))
        cover[on_leg] *= (0.75 * (1.0 - _ramp(to_foot, wear.trousers - 0.04, wear.trousers + 0.01)))[on_leg]
    cover[basis.is_hand | basis.is_head] = 0.0
    cover[basis.is_foot] = 0.006 / max(wear.cloth_m, 1e-9)  # shoes
    return cover


def _owned(side: str, parts: tuple[str, ...]) -> Mask:
    """Return the vertices whose strongest joint is one of the parts of a side."""
    basis = load_basis()
    owners = [i for i, n in enumerate(basis.joint_names) if n.startswith(parts) and n.endswith(f".{side}")]
    return np.isin(basis.skin_joints[:, 0], owners)


def _beard_cover(body: RestBody) -> F64:
    """Return the beard's share of its thickness at each vertex: jaw, chin, upper lip: (V,)."""
    basis = load_basis()
    at = (body.vertices - body.head_centre) / (body.head_size / 2.0)
    x, y, z = at.T
    low = 1.0 - _ramp(z - 0.4 * (1.0 - np.clip(x, 0.0, 1.0)), -0.50, -0.38)
    front = _ramp(x, -0.05, 0.15)
    lips = (np.abs(z + 0.56) < 0.075) & (np.abs(y) < 0.40) & (x > 0.6)
    under_chin = _ramp(z, -1.2, -1.05)
    return np.asarray(np.where(basis.is_head & ~lips & ~basis.is_ear, low * front * under_chin, 0.0))


# ---------------------------------------------------------------------------------------------- on the head


def _hair(body: RestBody, clothed: F64, head: HeadField, wear: Wear, rng: np.random.Generator) -> list[Piece]:
    azimuth = _around(N_AZIMUTH)
    thickness = min(wear.hair_m, 0.005) if wear.hat != "none" else wear.hair_m
    rim = _rim("hair", azimuth) + wear.receding * np.radians(38.0) * _ramp(np.cos(azimuth), 0.0, 0.8)
    falls = (
        wear.fringe
        * (1.0 - wear.receding)
        * np.interp(np.abs(np.cos(azimuth)), (0.0, 0.5, 1.0), (24.0, 14.0, 26.0))
    )
    rim = rim - np.radians(falls) * _ramp(np.cos(azimuth), -0.5, 0.0)
    rim = rim + np.radians(3.0) * smooth_noise(_directions(azimuth, np.zeros_like(azimuth)), rng, 0.8)

    def wall(theta: F64, elevation: F64) -> F64:
        points = head.at(theta, elevation, np.full(theta.shape, 0.1))
        shape = 0.75 + 0.25 * np.sin(elevation) - 0.12 * np.cos(theta)
        tousled = 1.0 + 0.30 * smooth_noise(points, rng, 0.14) + 0.18 * smooth_noise(points, rng, 0.04)
        return np.asarray(thickness * shape * np.maximum(tousled, 0.3))

    pieces = [_shell(head, rim, wall, HAIR, taper=wear.hair != "long")]
    if wear.hair == "long":
        back = np.radians(np.linspace(rng.uniform(48.0, 85.0), 360.0 - rng.uniform(48.0, 85.0), 27))
        length = wear.hair_length_m * (1.0 + 0.08 * smooth_noise(_directions(back, 0.0 * back), rng, 0.5))
        top = body.head_centre[2] + 0.1 * body.head_size[2]
        pieces.append(_curtain(body, clothed, back, top, length, max(0.008, wear.hair_m), HAIR, rng))
    if wear.hair == "bun" and wear.hat in ("none", "cap"):
        pieces.append(_bun(head, wear, rng))
    if wear.hair == "ponytail":
        pieces.append(_ponytail(body, head, wear, rng))
    return pieces


def _bun(head: HeadField, wear: Wear, rng: np.random.Generator) -> Piece:
    size = rng.uniform(0.024, 0.045)
    theta, elevation = np.array(np.pi + rng.normal(0.0, 0.12)), np.array(np.radians(rng.uniform(-5.0, 75.0)))
    radius = head.radius(theta, elevation) + wear.hair_m + 0.45 * size
    return _ball(head.at(theta, elevation, radius), size * rng.uniform(0.85, 1.15, 3), HAIR)


def _ponytail(body: RestBody, head: HeadField, wear: Wear, rng: np.random.Generator) -> Piece:
    theta, elevation = np.array(np.pi), np.array(np.radians(rng.uniform(-12.0, 35.0)))
    start = head.at(theta, elevation, head.radius(theta, elevation))
    t = np.linspace(0.0, 1.0, 10)[:, None]
    back = np.array([-1.0, 0.0, 0.0])
    down = np.array([0.0, rng.normal(0.0, 0.1), -1.0])
    path = start + back * 0.06 * np.sqrt(t) + down * wear.hair_length_m * t**1.6
    thick = rng.uniform(0.016, 0.032) * np.array([0.6, 0.9, 1.0, 1.0, 1.0, 0.95, 0.85, 0.7, 0.5, 0.15])
    basis = load_basis()
    tail = _tube(path, thick, HAIR)
    shoulder_z, chin_z = body.joints[basis.joint("upperarm01.L"), 2], body.vertices[basis.menton, 2]
    return Piece(
        tail.vertices, tail.faces, HAIR, 0.6 * (1.0 - _ramp(tail.vertices[:, 2], shoulder_z - 0.1, chin_z))
    )


def _hat(body: RestBody, clothed: F64, head: HeadField, wear: Wear) -> list[Piece]:
    rng = np.random.default_rng([wear.seed, 1])
    azimuth = _around(N_AZIMUTH)
    under = 0.006  # flattened hair
    lift = np.radians(rng.normal(0.0, 4.0))
    slouch = rng.uniform(0.0, 0.05) * (rng.random() < 0.4)
    rise = {
        "beanie": 0.008 + slouch,
        "cap": rng.uniform(0.008, 0.028),
        "helmet": 0.012,
        "hood": 0.01 + slouch,
    }[wear.hat]

    def wall(theta: F64, elevation: F64) -> F64:
        back = slouch * np.maximum(0.0, -np.cos(theta)) * np.cos(elevation)
        return np.asarray(under + wear.hat_m + rise * _ramp(elevation, 0.2, 1.4) + 0.6 * back)

    turn = wear.hat_turn_rad if wear.hat == "cap" else 0.0
    rim = _rim(wear.hat, azimuth - turn) + (0.0 if wear.hat == "hood" else lift)
    pieces = [_shell(head, rim, wall, HAT, smooth={"beanie": 3, "cap": 8, "helmet": 20, "hood": 8}[wear.hat])]
    if wear.hat == "cap":
        pieces.append(_visor(head, rim, turn, wear.hat_m + under, rng))
    if wear.hat == "hood":
        back = np.radians(np.linspace(62.0, 298.0, 27))
        top = body.head_centre[2] - 0.1 * body.head_size[2]
        pieces.append(_curtain(body, clothed, back, top, np.full(27, 0.15), under + wear.hat_m, HAT, rng))
    return pieces


def _visor(head: HeadField, rim: F64, turn: float, wall: float, rng: np.random.Generator) -> Piece:
    length, droop = rng.uniform(0.055, 0.085), rng.uniform(0.05, 0.45)
    spread = np.linspace(-1.0, 1.0, 11)
    azimuth = turn + np.radians(52.0) * spread
    elevation = np.interp(
        azimuth, np.arange(-len(rim), 2 * len(rim)) * (2 * np.pi / len(rim)), np.tile(rim, 3)
    )
    inner = head.at(azimuth, elevation, head.radius(azimuth, elevation) + 0.5 * wall)
    out = np.array([np.cos(turn), np.sin(turn), 0.0])
    reach = length * np.sqrt(np.maximum(0.0, 1.0 - spread**2))[:, None]
    rows = [inner + share * reach * (out + np.array([0.0, 0.0, -droop])) for share in (0.0, 0.5, 1.0)]
    top = np.stack(rows)
    top[..., 2] += 0.008 * (1.0 - spread**2)  # visors are arched
    bottom = top[::-1] - np.array([0.0, 0.0, 0.003])
    sheet = np.concatenate([top, bottom])
    faces = _grid_faces(len(sheet), len(spread), closed=False)[:, ::-1]
    return Piece(sheet.reshape(-1, 3), faces, HAT)


def _glasses(body: RestBody, dark: bool) -> list[Piece]:
    basis = load_basis()
    eyes = {side: body.joints[basis.joint(f"eye.{side}")] for side in "LR"}
    between = float(np.abs(eyes["L"][1] - eyes["R"][1]))
    front = float(body.vertices[basis.nasion, 0]) + 0.008
    wide, high = 0.40 * between, 0.30 * between
    turn = _around(16)
    pieces = []
    for side, sign in (("L", 1.0), ("R", -1.0)):
        eye = eyes[side]
        x = np.full_like(turn, front)
        ring = np.column_stack([x, eye[1] + wide * np.cos(turn), eye[2] - 0.003 + high * np.sin(turn)])
        pieces.append(_tube(ring, 0.0022, GLASSES, closed=True, sides=6))
        if dark:
            lens = np.concatenate([ring, [[front + 0.002, eye[1], eye[2] - 0.003]]])
            fan = np.column_stack([np.full(16, 16), np.arange(16), (np.arange(16) + 1) % 16]).astype(np.int32)
            pieces.append(Piece(lens, fan, GLASSES))
        ears = body.vertices[basis.is_ear & (sign * body.vertices[:, 1] > 0.0)]
        hook = np.array([ears[:, 0].mean(), sign * (0.5 * body.head_size[1] + 0.006), eye[2] + 0.008])
        hinge = np.array([front, sign * (abs(eye[1]) + wide), eye[2] + 0.008])
        share = np.linspace(0.0, 1.0, 5)[:, None]
        pieces.append(_tube(hinge + share * (hook - hinge), 0.002, GLASSES, sides=6))
    bridge = np.array([[front, s * (between / 2 - wide), eyes["L"][2] + 0.002] for s in (-1.0, 0.0, 1.0)])
    pieces.append(_tube(bridge, 0.002, GLASSES, sides=6))
    return pieces


def _mask(head: HeadField) -> Piece:
    """Build a face mask from chin to the bridge of the nose."""
    azimuth, share = np.meshgrid(np.radians(np.linspace(-62.0, 62.0, 17)), np.linspace(0.0, 1.0, 9))
    narrow = np.cos(azimuth * 1.1)
    low = np.radians(-22.0 - 25.0 * narrow)
    high = np.radians(-22.0 + 14.0 * narrow)
    elevation = low + share * (high - low)
    radius = head.radius(azimuth, elevation) + 0.006
    skin = radius.copy()
    for _ in range(6):  # cloth bridges the hollows beside the nose
        padded = np.pad(radius, 1, mode="edge")
        mean = (padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]) / 4
        radius = np.maximum(skin, mean)
    points = head.at(azimuth, elevation, radius)
    return Piece(points.reshape(-1, 3), _grid_faces(9, 17, closed=False), CLOTH)


def _headphones(body: RestBody, head: HeadField, wear: Wear) -> list[Piece]:
    basis = load_basis()
    rng = np.random.default_rng([wear.seed, 2])
    radius, depth = rng.uniform(0.03, 0.042), rng.uniform(0.014, 0.024)
    pieces = []
    ears = []
    for sign in (1.0, -1.0):
        ear = body.vertices[basis.is_ear & (sign * body.vertices[:, 1] > 0.0)]
        centre = np.array([ear[:, 0].mean(), sign * (0.5 * body.head_size[1] + 0.016), ear[:, 2].mean()])
        pieces.append(_ball(centre, (radius, depth, radius * 1.15), HAT))
        ears.append(centre)
    hair = 0.0 if wear.hair == "bald" else min(wear.hair_m, 0.03)
    gap = hair + (0.02 if wear.hat != "none" else 0.0) + rng.uniform(0.006, 0.015)
    angle = np.linspace(np.radians(5.0), np.radians(175.0), 15)
    # the band runs over the crown from ear to ear, in the plane of the ears
    side = np.where(np.cos(angle) >= 0.0, np.pi / 2, -np.pi / 2)
    elevation = np.minimum(angle, np.pi - angle)
    band = head.at(side, elevation, head.radius(side, elevation) + gap)
    band[:, 0] = ears[0][0] + 0.005
    pieces.append(_tube(band, 0.007, HAT))
    return pieces


def _scarf(body: RestBody, clothed: F64, wear: Wear) -> Piece:
    """Wind a soft ring round the neck."""
    basis = load_basis()
    rng = np.random.default_rng([wear.seed, 3])
    neck = body.joints[basis.joint("neck02")]
    azimuth = _around(28)
    z = neck[2] - 0.01 + 0.02 * np.cos(azimuth + rng.uniform(-0.6, 0.6)) * -1.0
    reach = _trunk_radius(clothed, neck[:2], azimuth[None, :], z[None, :])[0]
    reach = np.minimum(reach, np.median(reach) + 0.03) + 0.4 * wear.scarf_m
    path = np.column_stack([neck[0] + reach * np.cos(azimuth), neck[1] + reach * np.sin(azimuth), z])
    ring = _tube(
        path, wear.scarf_m * (1.0 + 0.25 * smooth_noise(path, rng, 0.06)), CLOTH, closed=True, sides=10
    )
    return Piece(ring.vertices, ring.faces, CLOTH, np.full(len(ring.vertices), 0.75))


def _backpack(body: RestBody, clothed: F64, wear: Wear) -> Piece:
    """Put a rounded box on the back, its top near the shoulders."""
    basis = load_basis()
    rng = np.random.default_rng([wear.seed, 4])
    tall = float(np.ptp(body.vertices[:, 2]))
    half = tall * rng.uniform((0.035, 0.08, 0.11), (0.07, 0.1, 0.15))
    chest, shoulder = body.joints[basis.joint("spine02")], body.joints[basis.joint("upperarm01.L")]
    top = shoulder[2] + rng.uniform(-0.03, 0.05) * tall
    on_back = (np.abs(clothed[:, 1]) < half[1]) & (np.abs(clothed[:, 2] - top + half[2]) < half[2])
    back = float(np.quantile(clothed[on_back, 0], 0.03))
    ball = _ball(np.zeros(3), 1.0, CLOTH, rows=11, columns=16)
    rounded = np.sign(ball.vertices) * np.abs(ball.vertices) ** 0.5  # towards a box
    vertices = np.array([min(back, chest[0]) - 0.85 * half[0], 0.0, top - half[2]]) + rounded * half
    vertices = vertices + 0.012 * smooth_noise(vertices, rng, 0.2)[:, None] * rounded
    return Piece(vertices, ball.faces, CLOTH, np.ones(len(vertices)))
