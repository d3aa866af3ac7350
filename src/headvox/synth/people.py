"""Parametric people: who they are, what they wear, how they stand, and where exactly their head is.

A person is a body of :mod:`headvox.synth.bodies`, dressed by :mod:`headvox.synth.wear`, in a pose of
:mod:`headvox.synth.poses`. Everything is NumPy in float64, rounded to a micrometre, so that the same random
generator gives the same bytes on any number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from headvox.data import F64
from headvox.errors import HeadvoxError
from headvox.synth.bodies import (
    RestBody,
    blend_points,
    load_basis,
    make_rest_body,
    mean_head_scale,
    mean_height_m,
)
from headvox.synth.dress import Outfit, dress
from headvox.synth.poses import Pose as Pose
from headvox.synth.poses import pose_skeleton
from headvox.synth.postures import POSTURES as POSTURES
from headvox.synth.postures import sample_pose as sample_pose
from headvox.synth.postures import walking_pose as walking_pose
from headvox.synth.wear import CLOTH as CLOTH
from headvox.synth.wear import GLASSES as GLASSES
from headvox.synth.wear import HAIR as HAIR
from headvox.synth.wear import HAT as HAT
from headvox.synth.wear import SKIN as SKIN
from headvox.synth.wear import Wear, sample_wear

ROUND_DIGITS = 6  # micrometres
TAKES_OFF_BACKPACK = ("sitting", "lying")


@dataclass(frozen=True, slots=True)
class Person:
    """Who somebody is and what they wear.

    ``sex`` runs from 0 (male) to 1 (female); ``mass`` and ``muscle`` from 0 to 1 with 0.5 the average;
    ``ancestry`` weighs the three anchors of the body basis; ``head_scale`` multiplies the head;
    ``head_changes`` go in the order of ``load_basis().head_change_names`` and stay within about 0.4.
    """

    age_years: float
    sex: float
    mass: float
    muscle: float
    height_m: float
    ancestry: tuple[float, float, float]
    head_scale: float
    head_changes: tuple[float, ...]
    wear: Wear


@dataclass(frozen=True, slots=True)
class PosedBody:
    """A dressed person in a pose, in the world frame.

    ``vertices`` (V, 3) metres, ``faces`` (F, 3), ``materials`` (F,): SKIN, HAIR, CLOTH, HAT or GLASSES.
    ``T_world_head`` (4, 4): x out of the face, y to the person's left, z through the crown, origin at the
    centre of the bald head's box. ``hair_albedo`` runs from 0 (black) to 1 (white). ``hair`` names what is on the head:
    a hat, or else the style of the hair.
    """

    vertices: F64
    faces: npt.NDArray[np.int32]
    materials: npt.NDArray[np.uint8]
    T_world_head: F64
    posture: str
    hair_albedo: float
    hair: str = ""


def sample_person(rng: np.random.Generator, child_share: float = 0.15) -> Person:
    """Draw a person; ``child_share`` of them are 3 to 15 years old."""
    if not 0.0 <= child_share <= 1.0:
        raise HeadvoxError(
            f"Expected a share of children from 0 to 1, got {child_share}.", "Give a fraction."
        )
    is_child = rng.random() < child_share
    age = float(rng.uniform(3.0, 15.0) if is_child else 16.0 + 70.0 * rng.beta(1.3, 2.2))
    sex = float(np.clip((rng.random() < 0.5) + rng.normal(0.0, 0.12), 0.0, 1.0))
    mean = mean_height_m(age, sex)
    ratio = float(np.clip(rng.normal(1.0, 0.04), 0.9, 1.1))
    race = rng.dirichlet((0.6, 0.6, 0.6)).tolist()
    basis = load_basis()
    changes = np.clip(rng.normal(0.0, 0.17, len(basis.head_change_names)), -0.4, 0.4)
    return Person(
        age_years=age,
        sex=sex,
        mass=float(np.clip(rng.normal(0.5, 0.16), 0.1, 0.97)),
        muscle=float(np.clip(rng.normal(0.5, 0.15), 0.1, 0.9)),
        height_m=mean * ratio,
        ancestry=(race[0], race[1], race[2]),
        head_scale=mean_head_scale(age, ratio) * float(np.clip(rng.normal(1.0, 0.022), 0.94, 1.06)),
        head_changes=tuple(changes.tolist()),
        wear=sample_wear(rng, sex, age),
    )


@lru_cache(maxsize=64)
def _rest(person: Person) -> tuple[RestBody, Outfit]:
    points = blend_points(
        person.age_years, person.sex, person.mass, person.muscle, person.height_m, person.ancestry
    )
    body = make_rest_body(points, person.head_scale, person.head_changes)
    return body, dress(body, person.wear)


def _skin(outfit: Outfit, rotations: F64, positions: F64, rest_joints: F64) -> F64:
    """Blend the joints' rigid motions: (V, 3)."""
    offsets = positions - np.einsum("jab,jb->ja", rotations, rest_joints)
    out = np.zeros_like(outfit.vertices)
    for k in range(outfit.skin_joints.shape[1]):
        joint = outfit.skin_joints[:, k]
        moved = np.einsum("vab,vb->va", rotations[joint], outfit.vertices) + offsets[joint]
        out += outfit.skin_weights[:, k, None] * moved
    return out


def pose_person(
    person: Person,
    pose: Pose,
    xy: tuple[float, float] = (0.0, 0.0),
    heading_rad: float = 0.0,
    floor_z: float = 0.0,
) -> PosedBody:
    """Dress a person, take the pose, and put the lowest point on the floor.

    ``xy`` is where the middle of the pelvis is, in the world, metres; ``heading_rad`` turns about z, 0 looks
    along x.
    """
    if person.wear.backpack and pose.posture in TAKES_OFF_BACKPACK:
        person = replace(person, wear=replace(person.wear, backpack=False))
    body, outfit = _rest(person)
    rotations, positions = pose_skeleton(pose, body.joints)
    cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    rotations = np.einsum("ab,jbc->jac", turn, rotations)
    positions = np.einsum("ab,jb->ja", turn, positions)
    vertices = _skin(outfit, rotations, positions, body.joints)
    basis = load_basis()
    hips = (positions[basis.joint("upperleg01.L")] + positions[basis.joint("upperleg01.R")]) / 2
    shift = np.array([xy[0] - hips[0], xy[1] - hips[1], floor_z - vertices[:, 2].min()])
    head = basis.joint("head")
    T_world_head = np.eye(4)
    T_world_head[:3, :3] = rotations[head]
    arm = np.einsum("ab,b->a", rotations[head], body.head_centre - body.joints[head])
    T_world_head[:3, 3] = np.round(positions[head] + arm + shift, ROUND_DIGITS)
    return PosedBody(
        vertices=np.round(vertices + shift, ROUND_DIGITS),
        faces=outfit.faces,
        materials=outfit.materials,
        T_world_head=np.round(T_world_head, 12),
        posture=pose.posture,
        hair_albedo=person.wear.hair_albedo,
        hair=person.wear.hair if person.wear.hat == "none" else person.wear.hat,
    )
