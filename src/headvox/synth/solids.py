"""Solids of triangles: boxes, bodies of revolution, ellipsoids, lumps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from headvox.data import F64, I32

Rng = np.random.Generator
Solid = tuple[F64, I32]


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
