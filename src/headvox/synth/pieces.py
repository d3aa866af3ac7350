"""Grids of triangles that are worn: shells over the head, curtains round it, tubes and balls.

Everything is built on the rest body. Things on the head are grids over azimuth and elevation about the head's centre:
azimuth 0 is the face, 90 degrees the left ear.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from headvox.data import F64, I32
from headvox.synth.bodies import RestBody, load_basis

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
class Piece:
    """Something added to the body; ``follows_chest`` (V,) is the share of skinning that is not the head's."""

    vertices: F64
    faces: I32
    material: int
    follows_chest: F64 | None = None


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


def ramp(x: F64, low: float, high: float) -> F64:
    """Return 0 below ``low``, 1 above ``high``, smooth between."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def azimuths(count: int) -> F64:
    """Return ``count`` equal steps round the circle, radians."""
    return np.asarray(np.arange(count) * (2.0 * np.pi / count), dtype=np.float64)


def directions(azimuth: F64, elevation: F64) -> F64:
    """Return unit vectors (..., 3) at azimuths and elevations in radians."""
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)


def grid_faces(rows: int, columns: int, closed: bool) -> I32:
    """Return triangles of a (rows, columns) grid, outward if columns run against the clock, rows up."""
    r, c = np.meshgrid(np.arange(rows - 1), np.arange(columns if closed else columns - 1), indexing="ij")
    right = (c + 1) % columns
    a, b, d, e = (
        x.ravel()
        for x in (r * columns + c, r * columns + right, (r + 1) * columns + c, (r + 1) * columns + right)
    )
    return np.concatenate([np.column_stack([a, b, e]), np.column_stack([a, e, d])]).astype(np.int32)


def tube(path: F64, radii: npt.ArrayLike, material: int, closed: bool = False, sides: int = 8) -> Piece:
    """Sweep a circle along ``path`` (N, 3); ``radii`` is one number or one a point."""
    forward = np.roll(path, -1, 0) - np.roll(path, 1, 0) if closed else np.gradient(path, axis=0)
    forward /= np.sqrt((forward * forward).sum(1, keepdims=True))
    helper = np.eye(3)[int(np.argmin(np.abs(forward).max(0)))]
    across = np.cross(forward, helper)
    across /= np.sqrt((across * across).sum(1, keepdims=True))
    other = np.cross(forward, across)
    angle = azimuths(sides)
    ring = np.cos(angle)[None, :, None] * across[:, None] + np.sin(angle)[None, :, None] * other[:, None]
    vertices = (
        path[:, None] + np.broadcast_to(np.asarray(radii, dtype=np.float64), len(path))[:, None, None] * ring
    )
    rows = np.concatenate([vertices, vertices[:1]]) if closed else vertices
    return Piece(rows.reshape(-1, 3), grid_faces(len(rows), sides, closed=True), material)


def ball_of(centre: F64, radii: npt.ArrayLike, material: int, rows: int = 8, columns: int = 12) -> Piece:
    """Return an ellipsoid about ``centre`` (3,) with ``radii``, one or three, in metres."""
    elevation, azimuth = np.meshgrid(
        np.linspace(-np.pi / 2, np.pi / 2, rows), np.arange(columns) * (2.0 * np.pi / columns), indexing="ij"
    )
    vertices = centre + directions(azimuth, elevation) * np.asarray(radii)
    return Piece(vertices.reshape(-1, 3), grid_faces(rows, columns, closed=True), material)


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
        distance, near = self.tree.query(directions(azimuth, elevation), k=4)
        weight = 1.0 / (distance * distance + 1e-4)
        return np.asarray((weight * self.radii[near]).sum(-1) / weight.sum(-1))

    def at(self, azimuth: F64, elevation: F64, radius: F64) -> F64:
        """Return the points (..., 3) of spherical coordinates about the centre."""
        return np.asarray(self.centre + directions(azimuth, elevation) * radius[..., None])


def rim_of(name: str, azimuth: F64) -> F64:
    """Return the elevation of a rim, radians, over azimuth in radians."""
    turned = np.abs((azimuth + np.pi) % (2.0 * np.pi) - np.pi)
    return np.asarray(np.radians(np.interp(np.degrees(turned), RIM_AZIMUTH, RIMS[name])))


def shell_over(
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
    azimuth = azimuths(len(rim))
    share = np.linspace(0.0, 1.0, N_ROWS)[:, None]
    elevation = rim[None, :] + share * (np.pi / 2 - rim[None, :])
    azimuth = np.tile(azimuth, (N_ROWS, 1))
    skin = head.radius(azimuth, elevation)
    thickness = wall(azimuth, elevation) * (ramp(share, -0.05, 0.22) if taper else 1.0)
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
    return Piece(rows.reshape(-1, 3), grid_faces(len(rows), len(rim), closed=True), material)


def curtain(
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
    profile = trunk_radius(clothed, axis, np.tile(azimuth, (rows, 1)), z)
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
    faces = grid_faces(rows, len(azimuth), closed=False)[:, ::-1]
    share = 0.85 * _chest_share(body, points[..., 2].ravel())
    return Piece(points.reshape(-1, 3), faces[alive.ravel()[faces].all(1)], material, share)


def _chest_share(body: RestBody, z: F64) -> F64:
    """Return how far things at a height follow the chest: 0 at the chin and above, 1 at the shoulders."""
    basis = load_basis()
    shoulder_z, chin_z = body.joints[basis.joint("upperarm01.L"), 2], body.vertices[basis.menton, 2]
    return 1.0 - ramp(z, shoulder_z, chin_z)


def trunk_radius(clothed: F64, axis: F64, azimuth: F64, z: F64) -> F64:
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
