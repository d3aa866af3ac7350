"""People made of ellipsoids and capsules: coarse and quick.

The same four functions as :mod:`headvox.synth.people`, so that a scene takes either. For tests, and for
looking at motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from headvox.data import F64
from headvox.synth.people import CLOTH, HAIR, SKIN, PosedBody
from headvox.synth.poses import Pose
from headvox.synth.postures import sample_pose, walking_pose
from headvox.synth.solids import Solid, ellipsoid, lathe

__all__ = ["Mannequin", "pose_person", "sample_person", "sample_pose", "walking_pose"]

HEAD_HALF_AXES_M = (0.097, 0.076, 0.114)


@dataclass(frozen=True, slots=True)
class Mannequin:
    """``height_m``, ``head_scale`` and how much infrared its hair sends back (0..1)."""

    height_m: float
    head_scale: float
    hair_albedo: float


def sample_person(rng: np.random.Generator, child_share: float = 0.15) -> Mannequin:
    """Draw one; a child is 0.9 to 1.4 m tall."""
    child = rng.uniform() < child_share
    height = float(rng.uniform(0.9, 1.4) if child else np.clip(rng.normal(1.7, 0.09), 1.48, 1.98))
    return Mannequin(
        height, float(rng.uniform(0.85, 0.95) if child else rng.uniform(0.95, 1.07)), float(rng.uniform())
    )


def pose_person(
    person: Mannequin,
    pose: Pose,
    xy: tuple[float, float] = (0.0, 0.0),
    heading_rad: float = 0.0,
    floor_z: float = 0.0,
) -> PosedBody:
    """Put the mannequin in a pose, lowest point on ``floor_z``, hips above ``xy`` [m]."""
    h, k = person.height_m, person.head_scale
    pelvis, chest = Rotation.from_rotvec(pose.pelvis), Rotation.from_rotvec(pose.chest)
    head = chest * Rotation.from_euler("ZYX", pose.head[::-1])
    middle = pelvis.apply((0.0, 0.0, 0.14 * h))
    neck = middle + chest.apply((0.0, 0.0, 0.16 * h))
    pivot = neck + chest.apply((0.0, 0.0, 0.03 * h))
    half_axes = k * np.array(HEAD_HALF_AXES_M)
    centre = pivot + head.apply((0.02, 0.0, half_axes[2] - 0.02))

    parts: list[tuple[Solid, int]] = [
        (capsule(np.zeros(3), middle, 0.085 * h), CLOTH),
        (capsule(middle, neck - chest.apply((0.0, 0.0, 0.06 * h)), 0.08 * h), CLOTH),
        (capsule(neck, centre, 0.055 * k), SKIN),
        (_turned(ellipsoid(_axes(half_axes), (0.0, 0.0, 0.0)), head, centre), SKIN),
        (_turned(ellipsoid((0.03, 0.015, 0.025), (half_axes[0], 0.0, -0.01), 8), head, centre), SKIN),
        (_turned(ellipsoid(_axes(half_axes * (0.95, 1.1, 0.85)), (-0.02, 0.0, 0.03)), head, centre), HAIR),
    ]
    for side, arm, leg in zip((1.0, -1.0), pose.arms, pose.legs, strict=True):
        shoulder = neck + chest.apply((0.0, side * 0.11 * h, -0.03 * h))
        parts.append((capsule(neck - chest.apply((0.0, 0.0, 0.03 * h)), shoulder, 0.04 * h), CLOTH))
        parts += _limb(shoulder, arm, (0.17 * h, 0.15 * h), 0.028 * h, CLOTH, hand=0.05 * h)
        parts += _limb(
            pelvis.apply((0.0, side * 0.05 * h, -0.02 * h)), leg, (0.24 * h, 0.24 * h), 0.045 * h, CLOTH
        )
    upright = Rotation.from_euler("z", heading_rad) * Rotation.from_rotvec(pose.whole)
    vertices = np.concatenate([upright.apply(v) for (v, _), _ in parts])
    shift = np.array([xy[0], xy[1], floor_z - vertices[:, 2].min()])
    first = np.cumsum([0] + [len(v) for (v, _), _ in parts[:-1]])
    T_world_head = np.eye(4)
    T_world_head[:3, :3] = (upright * head).as_matrix()
    T_world_head[:3, 3] = upright.apply(centre) + shift
    return PosedBody(
        vertices=vertices + shift,
        faces=np.concatenate([f + n for ((_, f), _), n in zip(parts, first, strict=True)]).astype(np.int32),
        materials=np.concatenate([np.full(len(f), material, np.uint8) for (_, f), material in parts]),
        T_world_head=T_world_head,
        posture=pose.posture,
        hair_albedo=person.hair_albedo,
    )


def capsule(start: F64, end: F64, radius: float) -> Solid:
    """A rod with round ends between two points (3,)."""
    length = float(np.linalg.norm(end - start))
    angle = np.linspace(0.0, np.pi / 2.0, 5)
    cap = [(radius * float(np.cos(a)), radius * float(np.sin(a))) for a in angle]
    profile = [(r, -z) for r, z in cap[::-1]] + [(r, length + z) for r, z in cap]
    vertices, faces = lathe(profile, sides=12)
    axis = (end - start) / max(length, 1e-9)
    side = np.cross(axis, (1.0, 0.0, 0.0) if abs(axis[0]) < 0.9 else (0.0, 1.0, 0.0))
    side /= np.linalg.norm(side)
    return vertices @ np.stack([side, np.cross(axis, side), axis]) + start, faces


def _axes(half_axes: F64) -> tuple[float, float, float]:
    return float(half_axes[0]), float(half_axes[1]), float(half_axes[2])


def _turned(solid: Solid, turn: Rotation, at: F64) -> Solid:
    return turn.apply(solid[0]) + at, solid[1]


def _limb(
    root: F64,
    directions: tuple[tuple[float, float, float], tuple[float, float, float]],
    lengths: tuple[float, float],
    radius: float,
    material: int,
    hand: float = 0.0,
) -> list[tuple[Solid, int]]:
    parts, start = [], root
    for direction, length in zip(directions, lengths, strict=True):
        end = start + length * np.asarray(direction) / np.linalg.norm(direction)
        parts.append((capsule(start, end, radius), material))
        start = end
    if hand > 0.0:
        parts.append((ellipsoid((hand, hand, hand), _axes(start)), SKIN))
    return parts
