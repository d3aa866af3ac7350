"""Hair, hats, and what else is worn on head, neck and back."""

from __future__ import annotations

import numpy as np

from headvox.data import F64
from headvox.synth.bodies import RestBody, load_basis
from headvox.synth.pieces import (
    N_AZIMUTH,
    HeadField,
    Piece,
    azimuths,
    ball_of,
    curtain,
    directions,
    grid_faces,
    ramp,
    rim_of,
    shell_over,
    smooth_noise,
    trunk_radius,
    tube,
)
from headvox.synth.wear import CLOTH, GLASSES, HAIR, HAT, Wear


def hair_pieces(
    body: RestBody, clothed: F64, head: HeadField, wear: Wear, rng: np.random.Generator
) -> list[Piece]:
    """Return the hair: a cap, and what hangs down or is tied up."""
    azimuth = azimuths(N_AZIMUTH)
    thickness = min(wear.hair_m, 0.005) if wear.hat != "none" else wear.hair_m
    rim = rim_of("hair", azimuth) + wear.receding * np.radians(38.0) * ramp(np.cos(azimuth), 0.0, 0.8)
    falls = (
        wear.fringe
        * (1.0 - wear.receding)
        * np.interp(np.abs(np.cos(azimuth)), (0.0, 0.5, 1.0), (24.0, 14.0, 26.0))
    )
    rim = rim - np.radians(falls) * ramp(np.cos(azimuth), -0.5, 0.0)
    rim = rim + np.radians(3.0) * smooth_noise(directions(azimuth, np.zeros_like(azimuth)), rng, 0.8)

    def wall(theta: F64, elevation: F64) -> F64:
        points = head.at(theta, elevation, np.full(theta.shape, 0.1))
        shape = 0.75 + 0.25 * np.sin(elevation) - 0.12 * np.cos(theta)
        tousled = 1.0 + 0.30 * smooth_noise(points, rng, 0.14) + 0.18 * smooth_noise(points, rng, 0.04)
        return np.asarray(thickness * shape * np.maximum(tousled, 0.3))

    pieces = [shell_over(head, rim, wall, HAIR, taper=wear.hair != "long")]
    if wear.hair == "long":
        back = np.radians(np.linspace(rng.uniform(48.0, 85.0), 360.0 - rng.uniform(48.0, 85.0), 27))
        length = wear.hair_length_m * (1.0 + 0.08 * smooth_noise(directions(back, 0.0 * back), rng, 0.5))
        top = body.head_centre[2] + 0.1 * body.head_size[2]
        pieces.append(curtain(body, clothed, back, top, length, max(0.008, wear.hair_m), HAIR, rng))
    if wear.hair == "bun" and wear.hat in ("none", "cap"):
        pieces.append(_bun(head, wear, rng))
    if wear.hair == "ponytail":
        pieces.append(_ponytail(body, head, wear, rng))
    return pieces


def _bun(head: HeadField, wear: Wear, rng: np.random.Generator) -> Piece:
    size = rng.uniform(0.024, 0.045)
    theta, elevation = np.array(np.pi + rng.normal(0.0, 0.12)), np.array(np.radians(rng.uniform(-5.0, 75.0)))
    radius = head.radius(theta, elevation) + wear.hair_m + 0.45 * size
    return ball_of(head.at(theta, elevation, radius), size * rng.uniform(0.85, 1.15, 3), HAIR)


def _ponytail(body: RestBody, head: HeadField, wear: Wear, rng: np.random.Generator) -> Piece:
    theta, elevation = np.array(np.pi), np.array(np.radians(rng.uniform(-12.0, 35.0)))
    start = head.at(theta, elevation, head.radius(theta, elevation))
    t = np.linspace(0.0, 1.0, 10)[:, None]
    back = np.array([-1.0, 0.0, 0.0])
    down = np.array([0.0, rng.normal(0.0, 0.1), -1.0])
    path = start + back * 0.06 * np.sqrt(t) + down * wear.hair_length_m * t**1.6
    thick = rng.uniform(0.016, 0.032) * np.array([0.6, 0.9, 1.0, 1.0, 1.0, 0.95, 0.85, 0.7, 0.5, 0.15])
    basis = load_basis()
    tail = tube(path, thick, HAIR)
    shoulder_z, chin_z = body.joints[basis.joint("upperarm01.L"), 2], body.vertices[basis.menton, 2]
    return Piece(
        tail.vertices, tail.faces, HAIR, 0.6 * (1.0 - ramp(tail.vertices[:, 2], shoulder_z - 0.1, chin_z))
    )


def hat_pieces(body: RestBody, clothed: F64, head: HeadField, wear: Wear) -> list[Piece]:
    """Return the hat, and the visor of a cap."""
    rng = np.random.default_rng([wear.seed, 1])
    azimuth = azimuths(N_AZIMUTH)
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
        return np.asarray(under + wear.hat_m + rise * ramp(elevation, 0.2, 1.4) + 0.6 * back)

    turn = wear.hat_turn_rad if wear.hat == "cap" else 0.0
    rim = rim_of(wear.hat, azimuth - turn) + (0.0 if wear.hat == "hood" else lift)
    pieces = [
        shell_over(head, rim, wall, HAT, smooth={"beanie": 3, "cap": 8, "helmet": 20, "hood": 8}[wear.hat])
    ]
    if wear.hat == "cap":
        pieces.append(_visor(head, rim, turn, wear.hat_m + under, rng))
    if wear.hat == "hood":
        back = np.radians(np.linspace(62.0, 298.0, 27))
        top = body.head_centre[2] - 0.1 * body.head_size[2]
        pieces.append(curtain(body, clothed, back, top, np.full(27, 0.15), under + wear.hat_m, HAT, rng))
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
    faces = grid_faces(len(sheet), len(spread), closed=False)[:, ::-1]
    return Piece(sheet.reshape(-1, 3), faces, HAT)


def glasses_pieces(body: RestBody, dark: bool) -> list[Piece]:
    """Return rims and sides of glasses; dark ones have panes that a sensor sees."""
    basis = load_basis()
    eyes = {side: body.joints[basis.joint(f"eye.{side}")] for side in "LR"}
    between = float(np.abs(eyes["L"][1] - eyes["R"][1]))
    front = float(body.vertices[basis.nasion, 0]) + 0.008
    wide, high = 0.40 * between, 0.30 * between
    turn = azimuths(16)
    pieces = []
    for side, sign in (("L", 1.0), ("R", -1.0)):
        eye = eyes[side]
        x = np.full_like(turn, front)
        ring = np.column_stack([x, eye[1] + wide * np.cos(turn), eye[2] - 0.003 + high * np.sin(turn)])
        pieces.append(tube(ring, 0.0022, GLASSES, closed=True, sides=6))
        if dark:
            lens = np.concatenate([ring, [[front + 0.002, eye[1], eye[2] - 0.003]]])
            fan = np.column_stack([np.full(16, 16), np.arange(16), (np.arange(16) + 1) % 16]).astype(np.int32)
            pieces.append(Piece(lens, fan, GLASSES))
        ears = body.vertices[basis.is_ear & (sign * body.vertices[:, 1] > 0.0)]
        hook = np.array([ears[:, 0].mean(), sign * (0.5 * body.head_size[1] + 0.006), eye[2] + 0.008])
        hinge = np.array([front, sign * (abs(eye[1]) + wide), eye[2] + 0.008])
        share = np.linspace(0.0, 1.0, 5)[:, None]
        pieces.append(tube(hinge + share * (hook - hinge), 0.002, GLASSES, sides=6))
    bridge = np.array([[front, s * (between / 2 - wide), eyes["L"][2] + 0.002] for s in (-1.0, 0.0, 1.0)])
    pieces.append(tube(bridge, 0.002, GLASSES, sides=6))
    return pieces


def mask_piece(head: HeadField) -> Piece:
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
    return Piece(points.reshape(-1, 3), grid_faces(9, 17, closed=False), CLOTH)


def headphone_pieces(body: RestBody, head: HeadField, wear: Wear) -> list[Piece]:
    """Return a band over the head and two cups."""
    basis = load_basis()
    rng = np.random.default_rng([wear.seed, 2])
    radius, depth = rng.uniform(0.03, 0.042), rng.uniform(0.014, 0.024)
    pieces = []
    ears = []
    for sign in (1.0, -1.0):
        ear = body.vertices[basis.is_ear & (sign * body.vertices[:, 1] > 0.0)]
        centre = np.array([ear[:, 0].mean(), sign * (0.5 * body.head_size[1] + 0.016), ear[:, 2].mean()])
        pieces.append(ball_of(centre, (radius, depth, radius * 1.15), HAT))
        ears.append(centre)
    hair = 0.0 if wear.hair == "bald" else min(wear.hair_m, 0.03)
    gap = hair + (0.02 if wear.hat != "none" else 0.0) + rng.uniform(0.006, 0.015)
    angle = np.linspace(np.radians(5.0), np.radians(175.0), 15)
    # the band runs over the crown from ear to ear, in the plane of the ears
    side = np.where(np.cos(angle) >= 0.0, np.pi / 2, -np.pi / 2)
    elevation = np.minimum(angle, np.pi - angle)
    band = head.at(side, elevation, head.radius(side, elevation) + gap)
    band[:, 0] = ears[0][0] + 0.005
    pieces.append(tube(band, 0.007, HAT))
    return pieces


def scarf_piece(body: RestBody, clothed: F64, wear: Wear) -> Piece:
    """Wind a soft ring round the neck."""
    basis = load_basis()
    rng = np.random.default_rng([wear.seed, 3])
    neck = body.joints[basis.joint("neck02")]
    azimuth = azimuths(28)
    z = neck[2] - 0.01 + 0.02 * np.cos(azimuth + rng.uniform(-0.6, 0.6)) * -1.0
    reach = trunk_radius(clothed, neck[:2], azimuth[None, :], z[None, :])[0]
    reach = np.minimum(reach, np.median(reach) + 0.03) + 0.4 * wear.scarf_m
    path = np.column_stack([neck[0] + reach * np.cos(azimuth), neck[1] + reach * np.sin(azimuth), z])
    ring = tube(
        path, wear.scarf_m * (1.0 + 0.25 * smooth_noise(path, rng, 0.06)), CLOTH, closed=True, sides=10
    )
    return Piece(ring.vertices, ring.faces, CLOTH, np.full(len(ring.vertices), 0.75))


def backpack_piece(body: RestBody, clothed: F64, wear: Wear) -> Piece:
    """Put a rounded box on the back, its top near the shoulders."""
    basis = load_basis()
    rng = np.random.default_rng([wear.seed, 4])
    tall = float(np.ptp(body.vertices[:, 2]))
    half = tall * rng.uniform((0.035, 0.08, 0.11), (0.07, 0.1, 0.15))
    chest, shoulder = body.joints[basis.joint("spine02")], body.joints[basis.joint("upperarm01.L")]
    top = shoulder[2] + rng.uniform(-0.03, 0.05) * tall
    on_back = (np.abs(clothed[:, 1]) < half[1]) & (np.abs(clothed[:, 2] - top + half[2]) < half[2])
    back = float(np.quantile(clothed[on_back, 0], 0.03))
    ball = ball_of(np.zeros(3), 1.0, CLOTH, rows=11, columns=16)
    rounded = np.sign(ball.vertices) * np.abs(ball.vertices) ** 0.5  # towards a box
    vertices = np.array([min(back, chest[0]) - 0.85 * half[0], 0.0, top - half[2]]) + rounded * half
    vertices = vertices + 0.012 * smooth_noise(vertices, rng, 0.2)[:, None] * rounded
    return Piece(vertices, ball.faces, CLOTH, np.ones(len(vertices)))
