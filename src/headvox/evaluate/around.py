"""Thirty-two views of four bodies: the frames that other detectors were measured on, too.

The bodies are those of the paper's authors: four meshes, two of them bent over, which are not part of headvox. Each is
seen from eight sides by one simulated Kinect, on a floor and before a wall.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from headvox.data import F64, I64, DepthImage, Frame, Intrinsics
from headvox.errors import HeadvoxError
from headvox.evaluate.match import Rules
from headvox.evaluate.scenarios import Labelled, Scenario
from headvox.evaluate.truth import TrueHeads
from headvox.sources.ply import read_ply_mesh
from headvox.synth.rays import Mesh, look

HEADS_M = {  # true centres in the meshes' own frame, z up, floor at 0
    "male": (0.0418, 0.0, 1.6077),
    "001_male": (0.0704, -0.0161, 1.7168),
    "001_male_hard": (-0.0489, -0.5845, 1.3447),
    "001_male_expert": (0.3978, -0.5112, 1.2401),
}
RULES = Rules(radius_m=0.10, clear_m=0.20)
VIEWS = 8
CAMERA = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)
CAMERA_AWAY_M, CAMERA_HEIGHT_M, LOOKS_AT_M = 2.5, 1.4, 1.15
WALL_BEHIND_M, WALL_HALF_M, WALL_HEIGHT_M = 1.5, 6.0, 4.0
FLOOR_HALF_M = 8.0
NOISE_PER_M = 0.0015  # standard deviation in metres at 1 m; it grows with the square of the distance
APART_NS = 1_000_000_000


def around(folder: Path, seed: int = 0) -> Scenario:
    """Return the 32 frames; ``folder`` holds the four meshes as PLY files.

    Raises:
        HeadvoxError: a mesh is missing.
    """
    for body in HEADS_M:
        if not (folder / f"{body}.ply").is_file():
            raise HeadvoxError(
                f"{folder}: there is no {body}.ply in it.",
                f"Expected {', '.join(f'{n}.ply' for n in HEADS_M)}.",
            )
    count = VIEWS * len(HEADS_M)
    return Scenario("peers", count, partial(_views, folder, seed), synthetic=False, moving=False, rules=RULES)


def _views(folder: Path, seed: int) -> Iterator[Labelled]:
    rng = np.random.default_rng(seed)
    number = 0
    for body, centre in HEADS_M.items():
        vertices, faces = read_ply_mesh((folder / f"{body}.ply").read_bytes(), f"{body}.ply")
        head = np.array(centre)
        for view in range(VIEWS):
            T_world_camera = _camera_pose(head, 2.0 * np.pi * view / VIEWS)
            mesh = _with_room(np.asarray(vertices, np.float64), faces, head, T_world_camera)
            seen = look(mesh, CAMERA, T_world_camera).distance_m
            depth_m = np.where(np.isfinite(seen), seen, 0.0).astype(np.float64)
            depth_m += NOISE_PER_M * depth_m**2 * rng.normal(size=depth_m.shape)
            depth = np.clip(np.round(depth_m / CAMERA.depth_scale), 0, 0xFFFF).astype(np.uint16)
            stamp_ns = number * APART_NS
            frame = Frame(stamp_ns, depths=(DepthImage("camera", depth, CAMERA, T_world_camera),))
            yield frame, TrueHeads.of(stamp_ns, [{"centre": list(centre)}])
            number += 1


def _camera_pose(head: F64, azimuth_rad: float) -> F64:
    """T_world_camera (4, 4) of the camera that stands on the side ``azimuth_rad`` of the head, looking at the chest."""
    away = np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0])
    eye = np.array([head[0], head[1], 0.0]) + CAMERA_AWAY_M * away + [0.0, 0.0, CAMERA_HEIGHT_M]
    forward = np.array([head[0], head[1], LOOKS_AT_M]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    T_world_camera[:3, 3] = eye
    return T_world_camera


def _with_room(vertices: F64, faces: I64, head: F64, T_world_camera: F64) -> Mesh:
    """Put a body on a floor, and a wall behind it as the camera sees it."""
    back = np.array([*T_world_camera[:2, 2], 0.0])
    back /= np.linalg.norm(back)
    side = np.array([-back[1], back[0], 0.0])
    middle = np.array([head[0], head[1], 0.0]) + WALL_BEHIND_M * back
    left, right = middle - WALL_HALF_M * side, middle + WALL_HALF_M * side
    up = np.array([0.0, 0.0, WALL_HEIGHT_M])
    wall = np.array([left, right, right + up, left + up])
    floor = FLOOR_HALF_M * np.array([(-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0)])
    square = np.array([[0, 1, 2], [0, 2, 3]])
    count = len(vertices)
    corners = np.concatenate([faces, square + count, square + count + 4]).astype(np.int32)
    plain = np.full(len(corners), 0.6, np.float32)
    return Mesh(np.concatenate([vertices, wall, floor]), corners, plain, np.zeros(len(corners), np.int32))
