"""Poses of people, and the skeleton that takes them.

A pose is described in the *body frame*: x forward, y to the person's left, z up, with the person upright.
Limbs are given by the directions in which they point, trunk and head by rotation vectors, so that the same
pose fits a child and an adult. ``whole`` then turns the complete body, which is how people lie down.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from headvox.data import F64
from headvox.synth.bodies import load_basis

Vec = tuple[float, float, float]
Bone = Callable[[str, str], F64]  # from the name of a joint to the name of the next: the bone at rest
Limb = tuple[Vec, Vec]  # the directions of upper and lower part, body frame, any length
SPINE = ("spine05", "spine04", "spine03", "spine02", "spine01")
NECK_SHARE = {"neck01": 0.2, "neck02": 0.4, "neck03": 0.6, "head": 1.0}
CLAVICLE_SHARE = 0.22  # of the turn of an arm that goes above the horizontal
ANKLE_RANGE = np.radians(60.0)
FINGER_CURL = (70.0, 160.0, 220.0)  # degrees that the three parts of a finger have turned in a fist


@dataclass(frozen=True, slots=True)
class Pose:
    """Angles of one posture. Rotation vectors are in radians, directions need no unit length.

    ``pelvis`` and ``chest`` are rotations in the body frame; ``head`` is (roll, pitch, yaw) relative to the
    chest: roll > 0 leans to the right shoulder, pitch > 0 looks down, yaw > 0 looks left. ``feet`` are
    pitches, toes down positive; ``hands`` say how far the fingers are curled, 0 flat to 1 fist. Pairs are
    (left, right).
    """

    posture: str
    pelvis: Vec = (0.0, 0.0, 0.0)
    chest: Vec = (0.0, 0.0, 0.0)
    head: Vec = (0.0, 0.0, 0.0)
    arms: tuple[Limb, Limb] = (((0.0, 0.15, -1.0), (0.2, 0.1, -1.0)), ((0.0, -0.15, -1.0), (0.2, -0.1, -1.0)))
    legs: tuple[Limb, Limb] = (((0.0, 0.06, -1.0), (0.0, 0.0, -1.0)), ((0.0, -0.06, -1.0), (0.0, 0.0, -1.0)))
    feet: tuple[float, float] = (0.0, 0.0)
    hands: tuple[float, float] = (0.3, 0.3)
    whole: Vec = (0.0, 0.0, 0.0)


def mirror(pose: Pose) -> Pose:
    """Swap left and right."""

    def flip(limb: Limb) -> Limb:
        (a, b, c), (d, e, f) = limb
        return (a, -b, c), (d, -e, f)

    def turn(v: Vec) -> Vec:
        return -v[0], v[1], -v[2]

    return replace(
        pose,
        pelvis=turn(pose.pelvis),
        chest=turn(pose.chest),
        head=turn(pose.head),
        arms=(flip(pose.arms[1]), flip(pose.arms[0])),
        legs=(flip(pose.legs[1]), flip(pose.legs[0])),
        feet=pose.feet[::-1],
        hands=pose.hands[::-1],
        whole=turn(pose.whole),
    )


def _unit(v: F64) -> F64:
    return np.asarray(v / np.sqrt((v * v).sum()))


def _rotation(rotation_vector: Vec | F64) -> F64:
    return np.asarray(Rotation.from_rotvec(rotation_vector).as_matrix())


def _swing(start: F64, end: F64) -> F64:
    """Return the rotation vector of the shortest turn from one direction to another."""
    start, end = _unit(start), _unit(end)
    axis = np.cross(start, end)
    sine, cosine = np.sqrt((axis * axis).sum()), float(start @ end)
    if sine < 1e-9:
        return np.zeros(3) if cosine > 0.0 else np.array([np.pi, 0.0, 0.0])
    return np.asarray(axis / sine * np.arctan2(sine, cosine))


def _head_turn(head: Vec) -> F64:
    return np.asarray(Rotation.from_euler("ZYX", head[::-1]).as_matrix())


def pose_skeleton(pose: Pose, rest_joints: F64) -> tuple[F64, F64]:
    """Return rotations (J, 3, 3) out of the rest frame and joint positions (J, 3), both turned by ``whole``.

    ``rest_joints`` is (J, 3). The root stays where it rests.
    """
    basis = load_basis()
    number = {name: i for i, name in enumerate(basis.joint_names)}
    turns = _trunk_turns(pose)
    for side, arm, leg, foot, curl in zip("LR", pose.arms, pose.legs, pose.feet, pose.hands, strict=True):

        def bone(start: str, end: str, side: str = side) -> F64:
            return np.asarray(rest_joints[number[f"{end}.{side}"]] - rest_joints[number[f"{start}.{side}"]])

        turns |= _arm_turns(side, arm, turns["spine01"], bone)
        turns |= _leg_turns(side, leg, foot, turns["root"], bone)
        turns |= _finger_turns(side, curl, turns[f"wrist.{side}"], rest_joints, number)
    whole = _rotation(pose.whole)
    rotations = np.empty((len(number), 3, 3))
    positions = np.empty((len(number), 3))
    for i, (name, parent) in enumerate(zip(basis.joint_names, basis.joint_parents, strict=True)):
        if parent < 0:
            rotations[i], positions[i] = whole @ turns[name], rest_joints[i]
            continue
        rotations[i] = whole @ turns[name] if name in turns else rotations[parent]
        positions[i] = positions[parent] + rotations[parent] @ (rest_joints[i] - rest_joints[parent])
    return rotations, positions


def _trunk_turns(pose: Pose) -> dict[str, F64]:
    pelvis, chest = _rotation(pose.pelvis), _rotation(pose.chest)
    turns = {"root": pelvis}
    bend = Rotation.from_matrix(chest @ pelvis.T).as_rotvec()
    for i, name in enumerate(SPINE, start=1):
        turns[name] = _rotation(bend * i / len(SPINE)) @ pelvis
    nod = Rotation.from_matrix(chest @ _head_turn(pose.head) @ chest.T).as_rotvec()
    for name, share in NECK_SHARE.items():
        turns[name] = _rotation(nod * share) @ chest
    return turns


def _swung(rotation: F64, rest_direction: F64, direction: F64, share: float = 1.0) -> F64:
    """Return ``rotation``, then the shortest turn that makes ``rest_direction`` point along ``direction``."""
    return _rotation(share * _swing(rotation @ rest_direction, direction)) @ rotation


def _arm_turns(side: str, arm: Limb, chest: F64, bone: Bone) -> dict[str, F64]:
    upper, lower = (np.asarray(direction, dtype=np.float64) for direction in arm)
    upper_rest = bone("upperarm01", "lowerarm01")
    lift = float(np.clip(_unit(upper) @ chest[:, 2] + 0.3, 0.0, 1.0))
    clavicle = _swung(chest, upper_rest, upper, CLAVICLE_SHARE * lift)
    shoulder = _swung(clavicle, upper_rest, upper)
    elbow = _swung(shoulder, bone("lowerarm01", "wrist"), lower)
    return {
        f"clavicle.{side}": clavicle,
        f"upperarm01.{side}": shoulder,
        f"lowerarm01.{side}": elbow,
        f"wrist.{side}": elbow,
    }


def _leg_turns(side: str, leg: Limb, foot_pitch: float, pelvis: F64, bone: Bone) -> dict[str, F64]:
    upper, lower = (np.asarray(direction, dtype=np.float64) for direction in leg)
    hip = _swung(pelvis, bone("upperleg01", "lowerleg01"), upper)
    knee = _swung(hip, bone("lowerleg01", "foot"), lower)
    sole_up = np.array([np.sin(foot_pitch), 0.0, np.cos(foot_pitch)])
    ankle = _swing(knee[:, 2], sole_up)
    angle = np.sqrt((ankle * ankle).sum())
    foot = _rotation(ankle * min(1.0, ANKLE_RANGE / max(angle, 1e-9))) @ knee
    return {f"upperleg01.{side}": hip, f"lowerleg01.{side}": knee, f"foot.{side}": foot}


def _finger_turns(side: str, curl: float, wrist: F64, rest: F64, number: dict[str, int]) -> dict[str, F64]:
    def at(name: str) -> F64:
        return np.asarray(rest[number[f"{name}.{side}"]])

    across = np.cross(at("finger2-1") - at("wrist"), at("finger5-1") - at("wrist"))
    palm = -across if side == "L" else across
    turns = {}
    for finger in range(1, 6):
        axis = _unit(np.cross(at(f"finger{finger}-3") - at(f"finger{finger}-1"), palm))
        strength = 0.35 * curl if finger == 1 else curl
        for part, degrees in enumerate(FINGER_CURL, start=1):
            turns[f"finger{finger}-{part}.{side}"] = wrist @ _rotation(axis * np.radians(degrees) * strength)
    return turns
