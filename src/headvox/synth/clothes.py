"""Clothes and beards: skin that is moved outwards."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from headvox.data import F64
from headvox.synth.bodies import Mask, RestBody, load_basis
from headvox.synth.pieces import ramp, smooth_noise, vertex_normals
from headvox.synth.wear import CLOTH, HAIR, SKIN, Wear


def clothe(body: RestBody, wear: Wear, rng: np.random.Generator) -> tuple[F64, npt.NDArray[np.uint8]]:
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
    cover *= 1.0 - ramp(body.vertices[:, 2] - neck[2] + 0.35 * (body.vertices[:, 0] - neck[0]), -0.01, 0.012)
    for side in "LR":
        on_arm = _owned(side, ("upperarm", "lowerarm", "wrist", "finger"))
        to_elbow = along(side, "upperarm01", "lowerarm01")
        to_wrist = np.where(to_elbow < 1.0, 0.5 * to_elbow, 0.5 + 0.5 * along(side, "lowerarm01", "wrist"))
        cover[on_arm] *= (0.7 * (1.0 - ramp(to_wrist, wear.sleeves - 0.04, wear.sleeves)))[on_arm]
        on_leg = _owned(side, ("upperleg", "lowerleg"))
        to_knee = along(side, "upperleg01", "lowerleg01")
        to_foot = np.where(to_knee < 1.0, 0.5 * to_knee, 0.5 + 0.5 * along(side, "lowerleg01", "foot"))
        cover[on_leg] *= (0.75 * (1.0 - ramp(to_foot, wear.trousers - 0.04, wear.trousers + 0.01)))[on_leg]
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
    low = 1.0 - ramp(z - 0.4 * (1.0 - np.clip(x, 0.0, 1.0)), -0.50, -0.38)
    front = ramp(x, -0.05, 0.15)
    lips = (np.abs(z + 0.56) < 0.075) & (np.abs(y) < 0.40) & (x > 0.6)
    under_chin = ramp(z, -1.2, -1.05)
    return np.asarray(np.where(basis.is_head & ~lips & ~basis.is_ear, low * front * under_chin, 0.0))
