"""The paper's data set of heads: bald shells of many identities, as clouds of evenly spaced points.

Files are in the paper's axes, x right, y forward, z up, with the origin at the head's centre. Normalised
heads have 64 mm between the eyes, as in the paper; metric ones keep the size of a real head.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw
from scipy.stats import qmc

from headvox.data import F64, I32, Intrinsics
from headvox.errors import HeadvoxError
from headvox.parallel.workers import ALONE, Workers
from headvox.synth.bodies import (
    Mask,
    blend_points,
    load_basis,
    make_rest_body,
    mean_head_scale,
    mean_height_m,
)
from headvox.synth.rays import NOTHING, Mesh, look
from headvox.synth.spread import escapes, spread_points
from headvox.writable import make_folder

EYE_DISTANCE_M = 0.064  # of a normalised head
RANGES = {"age_years": (8.0, 80.0), "sex": (0.0, 1.0), "mass": (0.15, 0.9), "elongation": (-1.0, 1.0)}
LONG = {"head-scale-depth-incr": 0.35, "head-back-scale-depth-incr": 0.2, "head-scale-horiz-incr": -0.35}
ESCAPE_DIRECTIONS = 96
ESCAPE_SHARE = 0.06  # of the directions that leave a face must go free, or it lies in a fold
HEADVOX_TO_PAPER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
TILE_PX = (150, 180)
TILE_M = 0.34  # wide
VIEW_FROM_M = 20.0  # far enough for parallel rays

Picture = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Identity:
    """The parameters of one head: ``sex`` 0 male to 1 female, ``elongation`` -1 short and broad to 1 long."""

    number: int
    age_years: float
    sex: float
    mass: float
    elongation: float


@dataclass(frozen=True, slots=True)
class HeadShell:
    """A bald head cut at the neck, in the paper's axes, origin at the head's centre.

    ``vertices`` (V, 3) metres, ``faces`` (F, 3) the outer surface only, ``eyes`` (2, 3) the centres of left
    and right eyeball, ``scale`` from the real head to this one.
    """

    vertices: F64
    faces: I32
    eyes: F64
    scale: float


def sample_identities(count: int, seed: int) -> list[Identity]:
    """Spread ``count`` identities evenly over the four parameters: a Latin hypercube."""
    unit = qmc.LatinHypercube(d=len(RANGES), seed=np.random.default_rng(seed)).random(count)
    low, high = np.array(list(RANGES.values())).T
    rows = np.round(low + unit * (high - low), 6).tolist()
    return [Identity(number, *row) for number, row in enumerate(rows)]


@lru_cache(maxsize=64)
def make_shell(identity: Identity, metric: bool) -> HeadShell:
    """Build the shell of one identity."""
    basis = load_basis()
    height = mean_height_m(identity.age_years, identity.sex)
    points = blend_points(identity.age_years, identity.sex, identity.mass, 0.5, height, (1.0, 1.0, 1.0))
    changes = tuple(identity.elongation * LONG.get(name, 0.0) for name in basis.head_change_names)
    body = make_rest_body(points, mean_head_scale(identity.age_years, 1.0), changes)
    vertices = (body.vertices - body.head_centre) @ HEADVOX_TO_PAPER.T
    eyes = body.joints[[basis.joint("eye.L"), basis.joint("eye.R")]] - body.head_centre
    eyes = eyes @ HEADVOX_TO_PAPER.T
    scale = 1.0 if metric else EYE_DISTANCE_M / float(np.sqrt(((eyes[0] - eyes[1]) ** 2).sum()))
    faces = basis.faces[(basis.is_head | basis.is_eye)[basis.faces].all(1)]
    faces = faces[seen_from_outside(vertices, faces)]
    used, corners = np.unique(faces, return_inverse=True)
    return HeadShell(
        np.round(vertices[used] * scale, 6),
        corners.reshape(-1, 3).astype(np.int32),
        np.round(eyes * scale, 6),
        scale,
    )


def seen_from_outside(vertices: F64, faces: I32) -> Mask:
    """Return which faces (F,) can be seen from far away: enough directions that leave one hit nothing."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.sqrt((normals * normals).sum(1, keepdims=True)), 1e-12)
    k = np.arange(ESCAPE_DIRECTIONS) + 0.5
    height = 1.0 - 2.0 * k / ESCAPE_DIRECTIONS
    angle = np.pi * (1.0 + np.sqrt(5.0)) * k
    flat = np.sqrt(1.0 - height**2)
    directions = np.column_stack([flat * np.cos(angle), flat * np.sin(angle), height])
    free = escapes(vertices, faces, corners.mean(1) + 2e-4 * normals, directions)
    outward = normals @ directions.T > 0.1
    return np.asarray((outward & free).sum(1) >= ESCAPE_SHARE * outward.sum(1))


def make_heads(
    out: Path,
    count: int = 44,
    points: int = 9000,
    metric: bool = False,
    seed: int = 0,
    workers: Workers = ALONE,
    on_done: Callable[[int], None] | None = None,
) -> None:
    """Write ``count`` heads into the folder ``out``.

    ``head_00.ply`` is a cloud of ``points`` points, ``head_00_mesh.ply`` its surface; ``manifest.json`` holds
    every head's parameters, centre, eyes and size; ``heads.png`` shows them all. A stopped run goes on where
    it was, and any ``workers`` write the same bytes. ``on_done`` is told how many
    heads there are so far.

    Raises:
        HeadvoxError: a number below one, a negative seed, or a folder that cannot be made or that holds other
            things.
    """
    for name, value in (("count", count), ("points", points)):
        if value < 1:
            raise HeadvoxError(f"Expected {name} to be at least 1, got {value}.", "Give a positive number.")
    if seed < 0:
        raise HeadvoxError(f"Expected a seed of 0 or more, got {seed}.", "Give a whole number.")
    out = Path(out)
    make_folder(out)
    identities = sample_identities(count, seed)
    settings = {"count": count, "points": points, "metric": metric, "seed": seed}
    _claim(out / "settings.json", settings)
    job = partial(_write_head, out=out, points=points, metric=metric, seed=seed)
    entries, pictures = [], []
    for entry, picture in workers.map(job, identities):
        entries.append(entry)
        pictures.append(picture)
        if on_done is not None:
            on_done(len(entries))
    manifest = {
        "format": "headvox-heads",
        "version": 1,
        **settings,
        "unit": "m",
        "axes": "x right, y forward, z up",
        "eye_distance_m": None if metric else EYE_DISTANCE_M,
        "heads": entries,
    }
    _contact_sheet(out / "heads.png", pictures)
    with _replacing(out / "manifest.json") as path:
        path.write_text(json.dumps(manifest, indent=1) + "\n")


def _claim(path: Path, settings: dict[str, Any]) -> None:
    """Say what the folder holds, or refuse to mix two data sets in it."""
    text = json.dumps(settings, sort_keys=True) + "\n"
    if path.exists() and path.read_text() != text:
        raise HeadvoxError(
            f"{path.parent} holds heads with other settings: {path.read_text().strip()}.",
            "Choose an empty folder.",
        )
    if not path.exists() and any(path.parent.iterdir()):
        raise HeadvoxError(
            f"{path.parent} holds other things already.", "Give another name, or remove it first."
        )
    with _replacing(path) as fresh:
        fresh.write_text(text)


def _write_head(
    identity: Identity, out: Path, points: int, metric: bool, seed: int
) -> tuple[dict[str, Any], Picture]:
    """Write what is missing of one head; return its entry of the manifest and its picture."""
    shell = make_shell(identity, metric)
    cloud, mesh = (out / f"head_{identity.number:02d}{kind}.ply" for kind in ("", "_mesh"))
    if not mesh.exists():
        with _replacing(mesh) as path:
            path.write_bytes(ply_bytes(shell.vertices, shell.faces))
    if not cloud.exists():
        with _replacing(cloud) as path:
            rng = np.random.default_rng([seed, identity.number])
            path.write_bytes(ply_bytes(spread_points(shell.vertices, shell.faces, points, rng)))
    size = np.ptp(shell.vertices, axis=0)
    entry = {
        **asdict(identity),
        "cloud": cloud.name,
        "mesh": mesh.name,
        "centre": [0.0, 0.0, 0.0],
        "eye_left": shell.eyes[0].tolist(),
        "eye_right": shell.eyes[1].tolist(),
        "size": np.round(size, 6).tolist(),
        "scale": round(shell.scale, 9),
    }
    return entry, _picture(shell)


def ply_bytes(vertices: F64, faces: I32 | None = None) -> bytes:
    """Return a binary PLY file with float32 vertices (V, 3) and, if given, triangles (F, 3)."""
    header = f"ply\nformat binary_little_endian 1.0\ncomment metres\nelement vertex {len(vertices)}\n"
    header += "property float x\nproperty float y\nproperty float z\n"
    body = vertices.astype("<f4").tobytes()
    if faces is not None:
        header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
        body += b"".join(struct.pack("<B3i", 3, *face) for face in faces.tolist())
    return (header + "end_header\n").encode("ascii") + body


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """Give a temporary name beside ``path`` that takes its place when all went well."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _contact_sheet(path: Path, pictures: list[Picture]) -> None:
    """Put the pictures of all heads on one."""
    columns = min(11, len(pictures))
    rows = -(-len(pictures) // columns)
    width, height = TILE_PX
    sheet = Image.new("L", (columns * width, rows * height), 255)
    draw = ImageDraw.Draw(sheet)
    for number, picture in enumerate(pictures):
        corner = (number % columns * width, number // columns * height)
        sheet.paste(Image.fromarray(picture), corner)
        draw.text((corner[0] + 4, corner[1] + 3), f"{number:02d}", fill=0)
    with _replacing(path) as temporary:
        sheet.save(temporary, format="PNG")


def _picture(shell: HeadShell) -> Picture:
    """Return a shaded view (height, width) from the front left."""
    width, height = TILE_PX
    turn = np.radians(30.0)
    backward = np.array([np.sin(turn), -np.cos(turn), -0.15])
    backward /= np.sqrt((backward * backward).sum())
    right = np.array([-np.cos(turn), -np.sin(turn), 0.0])
    T_head_camera = np.eye(4)
    T_head_camera[:3, :3] = np.column_stack([right, np.cross(backward, right), backward])
    T_head_camera[:3, 3] = -VIEW_FROM_M * backward
    focal = VIEW_FROM_M * width / TILE_M
    lens = Intrinsics(width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5)
    plain = np.ones(len(shell.faces), np.float32)
    view = look(Mesh(shell.vertices, shell.faces, plain, np.zeros(len(plain), np.int32)), lens, T_head_camera)
    return np.where(view.ids != NOTHING, 40 + 190 * view.cosine, 255).astype(np.uint8)
