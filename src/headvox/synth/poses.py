"""Postures of people, and the skeleton that takes them.

A posture is described in the *body frame*: x forward, y to the person's left, z up, with the person upright.
Limbs are given by the directions in which they point, trunk and head by rotation vectors, so that the same
pose fits a child and an adult. ``whole`` then turns the complete body, which is how people lie down.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from headvox.data import F64
from headvox.errors import HeadvoxError
from headvox.synth.bodies import load_basis

Vec = tuple[float, float, float]
Bone = Callable[[str, str], F64]  # from the name of a joint to the name of the next: the bone at rest
Limb = tuple[Vec, Vec]  # the directions of upper and lower part, body frame, any length

POSTURES = ("standing", "walking", "sitting", "bending", "crouching", "lying", "arms_raised")
POSTURE_SHARES = (0.27, 0.22, 0.22, 0.09, 0.07, 0.05, 0.08)

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


# Gestures of the left arm: upper and lower direction, and how far each may wander. The right arm mirrors y.
GESTURES: dict[str, tuple[Limb, float]] = {
    "hang": (((0.0, 0.14, -1.0), (0.25, 0.04, -1.0)), 0.10),
    "clasp": (((0.1, 0.15, -1.0), (0.6, -0.5, -0.7)), 0.06),
    "hold": (((0.25, 0.2, -1.0), (1.0, -0.3, 0.25)), 0.15),
    "cross": (((0.35, 0.2, -1.0), (0.5, -1.0, 0.1)), 0.05),
    "hip": (((-0.15, 0.75, -0.8), (0.3, -0.6, -0.75)), 0.08),
    "point": (((1.0, 0.2, -0.15), (1.0, 0.1, 0.05)), 0.20),
    "back": (((-0.35, 0.3, -1.0), (-0.3, -0.6, -0.7)), 0.05),
    "phone": (((0.5, 0.55, -0.6), (-0.15, -0.5, 0.8)), 0.08),
    "chin": (((0.5, 0.1, -0.8), (0.15, -0.4, 0.9)), 0.06),
    "lap": (((0.3, 0.15, -1.0), (1.0, -0.25, -0.3)), 0.10),
    "table": (((0.55, 0.25, -0.9), (1.0, -0.3, 0.05)), 0.12),
    "forward": (((1.0, 0.1, -0.3), (1.0, 0.0, 0.1)), 0.15),
    "down": (((0.25, 0.12, -1.0), (0.2, 0.0, -1.0)), 0.15),
    "up": (((0.1, 0.3, 1.0), (0.1, 0.0, 1.0)), 0.22),
    "wave": (((0.15, 0.9, 0.1), (0.1, 0.2, 1.0)), 0.18),
    "tee": (((0.0, 1.0, 0.0), (0.1, 1.0, 0.0)), 0.15),
    "nape": (((0.3, 0.8, 0.6), (-0.25, -0.9, 0.35)), 0.06),
    "side": (((0.0, 0.2, -1.0), (0.05, 0.15, -1.0)), 0.08),
    "spread": (((0.0, 0.8, -0.6), (0.0, 0.7, -0.6)), 0.25),
}


def _arm(rng: np.random.Generator, side: str, gestures: Sequence[str], shares: Sequence[float]) -> Limb:
    (upper, lower), wander = GESTURES[gestures[int(rng.choice(len(gestures), p=shares))]]
    sign = 1.0 if side == "L" else -1.0
    noise = rng.normal(0.0, wander, (2, 3))
    return _limb(np.array(upper) * (1, sign, 1) + noise[0], np.array(lower) * (1, sign, 1) + noise[1])


def _limb(upper: npt.ArrayLike, lower: npt.ArrayLike) -> Limb:
    (a, b, c), (d, e, f) = (
        np.asarray(upper, dtype=np.float64).tolist(),
        np.asarray(lower, dtype=np.float64).tolist(),
    )
    return (a, b, c), (d, e, f)


def _vec(*degrees: float) -> Vec:
    a, b, c = np.radians(degrees).tolist()
    return a, b, c


def _look(rng: np.random.Generator, pitch: float = 4.0, spread: float = 1.0) -> Vec:
    """Draw a head turn of natural range, as people look around: (roll, pitch, yaw)."""
    roll = np.clip(rng.normal(0.0, 6.0 * spread), -25.0, 25.0)
    nod = np.clip(rng.normal(pitch, 11.0 * spread), -45.0, 50.0)
    yaw = np.clip(rng.normal(0.0, 26.0 * spread), -75.0, 75.0)
    return _vec(roll, nod, yaw)


def _hands(rng: np.random.Generator) -> tuple[float, float]:
    left, right = rng.beta(1.2, 1.6, 2).tolist()
    return left, right


def _standing(rng: np.random.Generator) -> Pose:
    kinds = ["hang", "clasp", "hold", "cross", "hip", "point", "back", "phone", "chin"]
    together = rng.random()
    if together < 0.12:
        both = "cross" if together < 0.06 else "clasp"
        arms = _arm(rng, "L", [both], [1.0]), _arm(rng, "R", [both], [1.0])
    else:
        shares = [0.52, 0.05, 0.12, 0.03, 0.08, 0.05, 0.05, 0.05, 0.05]
        arms = _arm(rng, "L", kinds, shares), _arm(rng, "R", kinds, shares)
    pitch, lean, twist = rng.normal((3.0, 0.0, 0.0), (5.0, 3.0, 6.0))
    width = rng.uniform(0.02, 0.14)
    bent = np.abs(rng.normal(0.0, 0.06, 2))
    return Pose(
        posture="standing",
        pelvis=_vec(0.3 * lean, 0.3 * pitch, -0.5 * twist),
        chest=_vec(lean, pitch, twist),
        head=_look(rng),
        arms=arms,
        legs=(
            _limb((bent[0], width, -1.0), (-bent[0], 0.5 * width, -1.0)),
            _limb((bent[1], -width, -1.0), (-bent[1], -0.5 * width, -1.0)),
        ),
        hands=_hands(rng),
    )


def walking_pose(
    phase_rad: float,
    head_yaw: float = 0.0,
    head_pitch: float = 0.0,
    head_roll: float = 0.0,
    stride: float = 1.0,
    arm_swing: float = 1.0,
) -> Pose:
    """Return the pose at one phase of a walk; the left heel strikes near phase 0, one cycle is two steps.

    Cosine hips, a knee of two Gaussian bumps (loading and swing; fitted so that the standing foot stays down
    and the head bobs by 45 mm), arms against the legs, pelvis and chest turning against each other. Angles in
    radians; with ``stride`` 1 a step is about 0.4 body heights long, a cycle 0.8.
    """
    legs, feet, arms = [], [], []
    for side, offset in ((1.0, 0.0), (-1.0, np.pi)):
        phase = (phase_rad + offset) % (2.0 * np.pi)
        hip = stride * (0.12 + 0.37 * np.cos(phase))
        knee = stride * (0.30 * _bump(phase, 0.75, 0.45) + 1.03 * _bump(phase, 4.45, 0.67)) + 0.065
        shin = hip - knee
        legs.append(_limb((np.sin(hip), 0.035 * side, -np.cos(hip)), (np.sin(shin), 0.0, -np.cos(shin))))
        feet.append(float(stride * (-0.30 * _bump(phase, 6.2, 0.4) + 0.69 * _bump(phase, 3.98, 0.39))))
        swing = arm_swing * (-0.05 - 0.32 * np.cos(phase))
        elbow = swing + 0.25 + 0.18 * arm_swing * max(0.0, -float(np.cos(phase)))
        arms.append(
            _limb((np.sin(swing), 0.16 * side, -np.cos(swing)), (np.sin(elbow), 0.03 * side, -np.cos(elbow)))
        )
    yaw = 0.07 * stride * float(np.cos(phase_rad))
    sway = 0.025 * stride * float(np.sin(phase_rad))
    return Pose(
        posture="walking",
        pelvis=(sway, 0.03, -yaw),
        chest=(-0.5 * sway, 0.06, yaw),
        head=(head_roll, head_pitch - 0.03, head_yaw - yaw),
        arms=(arms[0], arms[1]),
        legs=(legs[0], legs[1]),
        feet=(feet[0], feet[1]),
    )


def _bump(phase: float, centre: float, width: float) -> float:
    """Return a Gaussian on the circle."""
    distance = (phase - centre + np.pi) % (2.0 * np.pi) - np.pi
    return float(np.exp(-0.5 * (distance / width) ** 2))


def _walking(rng: np.random.Generator) -> Pose:
    roll, pitch, yaw = _look(rng, pitch=6.0)
    pose = walking_pose(
        rng.uniform(0.0, 2.0 * np.pi),
        yaw,
        pitch,
        roll,
        stride=rng.uniform(0.6, 1.2),
        arm_swing=rng.uniform(0.4, 1.4),
    )
    if rng.random() < 0.2:  # something in one hand
        return replace(
            pose, arms=(pose.arms[0], _arm(rng, "R", ["hold", "phone"], [0.6, 0.4])), hands=_hands(rng)
        )
    return replace(pose, hands=_hands(rng))


def _sitting(rng: np.random.Generator) -> Pose:
    slouch = rng.normal(-4.0, 9.0)
    forward = rng.uniform(0.0, 1.0) < 0.3
    pitch = rng.uniform(15.0, 45.0) if forward else slouch
    kinds = ["lap", "table", "hang", "chin", "hold", "phone", "cross"]
    shares = [0.36, 0.32, 0.06, 0.09, 0.08, 0.04, 0.05]
    spread = rng.uniform(0.0, 0.35, 2)
    rise = rng.normal(0.03, 0.07, 2)
    reach = rng.normal(0.05, 0.16, 2)
    lean, twist = rng.normal(0.0, (4.0, 9.0))
    return Pose(
        posture="sitting",
        pelvis=_vec(0.0, 0.45 * pitch - 6.0, 0.0),
        chest=_vec(lean, pitch, twist),
        head=_look(rng, pitch=8.0 - 0.45 * pitch if forward else 8.0),
        arms=(_arm(rng, "L", kinds, shares), _arm(rng, "R", kinds, shares)),
        legs=(
            _limb((1.0, spread[0], rise[0]), (reach[0], 0.3 * spread[0], -1.0)),
            _limb((1.0, -spread[1], rise[1]), (reach[1], -0.3 * spread[1], -1.0)),
        ),
        hands=_hands(rng),
    )


def _bending(rng: np.random.Generator) -> Pose:
    pitch = rng.uniform(35.0, 105.0)
    lean, twist = rng.normal(0.0, (6.0, 10.0))
    knee = rng.uniform(0.0, 0.45)
    width = rng.uniform(0.03, 0.2)
    kinds = ["down", "forward", "table", "back"]
    shares = [0.6, 0.15, 0.17, 0.08]
    return Pose(
        posture="bending",
        pelvis=_vec(0.0, 0.55 * pitch, 0.0),
        chest=_vec(lean, pitch, twist),
        head=_look(rng, pitch=-0.22 * pitch, spread=1.2),
        arms=(_arm(rng, "L", kinds, shares), _arm(rng, "R", kinds, shares)),
        legs=(
            _limb((knee - 0.15, width, -1.0), (-knee - 0.05, 0.5 * width, -1.0)),
            _limb((knee - 0.15, -width, -1.0), (-knee - 0.05, -0.5 * width, -1.0)),
        ),
        hands=_hands(rng),
    )


def _crouching(rng: np.random.Generator) -> Pose:
    squat = _limb((1.0, rng.uniform(0.1, 0.5), rng.uniform(-0.1, 0.3)), (-0.55, 0.0, -0.85))
    kneel = _limb((rng.uniform(-0.05, 0.25), rng.uniform(0.0, 0.2), -1.0), (-1.0, 0.0, -0.12))
    lunge = _limb((1.0, rng.uniform(0.0, 0.2), 0.05), (0.0, 0.0, -1.0))
    legs = [(squat, squat), (kneel, kneel), (lunge, kneel)][int(rng.choice(3, p=[0.5, 0.2, 0.3]))]
    (upper, lower) = legs[1]
    right = ((upper[0], -upper[1], upper[2]), (lower[0], -lower[1], lower[2]))
    pitch = rng.uniform(5.0, 50.0)
    kinds = ["forward", "down", "hold", "table"]
    shares = [0.25, 0.35, 0.2, 0.2]
    pose = Pose(
        posture="crouching",
        pelvis=_vec(0.0, 0.5 * pitch, 0.0),
        chest=_vec(rng.normal(0.0, 5.0), pitch, rng.normal(0.0, 10.0)),
        head=_look(rng, pitch=8.0 - 0.3 * pitch),
        arms=(_arm(rng, "L", kinds, shares), _arm(rng, "R", kinds, shares)),
        legs=(legs[0], right),
        hands=_hands(rng),
    )
    return mirror(pose) if rng.random() < 0.5 else pose


def _lying(rng: np.random.Generator) -> Pose:
    kind = ("back", "front", "side")[int(rng.choice(3, p=[0.5, 0.2, 0.3]))]
    arms = (
        _arm(rng, "L", ["side", "spread", "nape"], [0.6, 0.3, 0.1]),
        _arm(rng, "R", ["side", "spread"], [0.7, 0.3]),
    )
    width = rng.uniform(0.02, 0.25, 2)
    roll, pitch, yaw = _look(rng, pitch=0.0, spread=0.6)
    pose = Pose(
        posture="lying",
        head=(roll, pitch, yaw),
        arms=arms,
        legs=(
            _limb((0.0, width[0], -1.0), (0.0, width[0], -1.0)),
            _limb((0.0, -width[1], -1.0), (0.0, -width[1], -1.0)),
        ),
        feet=(float(rng.uniform(0.3, 0.8)), float(rng.uniform(0.3, 0.8))),
        hands=_hands(rng),
        whole=_vec(0.0, -90.0, 0.0),
    )
    if kind == "front":
        aside = rng.uniform(45.0, 80.0) * rng.choice((-1.0, 1.0))
        return replace(pose, head=_vec(0.0, -6.0, aside), feet=(1.0, 1.0), whole=_vec(0.0, 90.0, 0.0))
    if kind == "side":
        curl = rng.uniform(0.1, 0.9, 2)
        side = replace(
            pose,
            chest=_vec(0.0, 30.0 * curl.mean(), 0.0),
            arms=(
                _arm(rng, "L", ["hold", "lap", "chin"], [0.4, 0.4, 0.2]),
                _arm(rng, "R", ["hold", "lap"], [0.5, 0.5]),
            ),
            legs=(
                _limb((curl[0], 0.02, -1.0), (-curl[0], 0.0, -1.0)),
                _limb((curl[1], -0.02, -1.0), (-curl[1], 0.0, -1.0)),
            ),
            head=(roll - 0.15, pitch + 0.15, 0.5 * yaw),
            whole=_vec(-90.0, 0.0, 0.0),
        )  # on the left side; roll towards the floor there would be negative
        return mirror(side) if rng.random() < 0.5 else side
    return pose


def _arms_raised(rng: np.random.Generator) -> Pose:
    one = ["up", "wave", "tee", "nape", "hang"]
    first = _arm(rng, "L", one[:4], [0.45, 0.25, 0.12, 0.18])
    second = _arm(rng, "R", one, [0.35, 0.1, 0.1, 0.15, 0.3])
    pose = replace(_standing(rng), posture="arms_raised", arms=(first, second))
    return mirror(pose) if rng.random() < 0.5 else pose


_SAMPLERS = {
    "standing": _standing,
    "walking": _walking,
    "sitting": _sitting,
    "bending": _bending,
    "crouching": _crouching,
    "lying": _lying,
    "arms_raised": _arms_raised,
}


def sample_pose(rng: np.random.Generator, posture: str | None = None) -> Pose:
    """Draw a natural pose of a posture, or of a random one.

    Raises:
        HeadvoxError: an unknown posture.
    """
    if posture is None:
        posture = POSTURES[int(rng.choice(len(POSTURES), p=POSTURE_SHARES))]
    if posture not in _SAMPLERS:
        raise HeadvoxError(
            f"Expected one of the postures {', '.join(POSTURES)}, got {posture!r}.", "Name one of them."
        )
    return _SAMPLERS[posture](rng)
