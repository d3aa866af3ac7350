"""Postures of people, drawn at random: standing, walking, sitting, bending, crouching, lying, with raised arms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from headvox.errors import HeadvoxError
from headvox.synth.poses import Limb, Pose, Vec, mirror

POSTURES = ("standing", "walking", "sitting", "bending", "crouching", "lying", "arms_raised")
POSTURE_SHARES = (0.27, 0.22, 0.22, 0.09, 0.07, 0.05, 0.08)
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
