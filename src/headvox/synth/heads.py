"""The paper's data set of heads: bald shells of many identities, as clouds of evenly spaced points.

Files are in the paper's axes, x right, y forward, z up, with the origin at the head's centre. Normalised
heads have 64 mm between the eyes, as in the paper; metric ones keep the size of a real head.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw
from scipy.stats import qmc

from headvox.data import F64
from headvox.errors import HeadvoxError
from headvox.synth.bodies import (
    I32,
    Mask,
    blend_points,
    load_basis,
    make_rest_body,
    mean_head_scale,
    mean_height_m,
)

EYE_DISTANCE_M = 0.064  # of a normalised head
RANGES = {"age_years": (8.0, 80.0), "sex": (0.0, 1.0), "mass": (0.15, 0.9), "elongation": (-1.0, 1.0)}
LONG = {"head-scale-depth-incr": 0.35, "head-back-scale-depth-incr": 0.2, "head-scale-horiz-incr": -0.35}
ESCAPE_DIRECTIONS = 96
ESCAPE_SHARE = 0.06  # of the directions that leave a face must go free, or it lies in a fold
HEADVOX_TO_PAPER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
MAX_SEED = 2**31 - 1  # of Open3D
TILE_PX = (150, 180)


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
    o3d = _open3d()
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.sqrt((normals * normals).sum(1, keepdims=True)), 1e-12)
    k = np.arange(ESCAPE_DIRECTIONS) + 0.5
    height = 1.0 - 2.0 * k / ESCAPE_DIRECTIONS
    angle = np.pi * (1.0 + np.sqrt(5.0)) * k
    flat = np.sqrt(1.0 - height**2)
    directions = np.column_stack([flat * np.cos(angle), flat * np.sin(angle), height])
    starts = corners.mean(1) + 2e-4 * normals
    rays = np.concatenate(np.broadcast_arrays(starts[:, None], directions[None]), axis=-1)
    blocked = _scene(o3d, vertices, faces).test_occlusions(o3d.core.Tensor(rays.astype(np.float32))).numpy()
    outward = np.einsum("fa,da->fd", normals, directions) > 0.1
    return np.asarray((outward & ~blocked).sum(1) >= ESCAPE_SHARE * outward.sum(1))


def sample_points(shell: HeadShell, count: int, seed: int) -> F64:
    """Return ``count`` points (N, 3) spread by Poisson disks over a shell."""
    o3d = _open3d()
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(shell.vertices), o3d.utility.Vector3iVector(shell.faces)
    )
    o3d.utility.random.seed(seed)
    return np.asarray(mesh.sample_points_poisson_disk(count).points)


def make_heads(
    out: Path, count: int = 44, points: int = 9000, metric: bool = False, seed: int = 0, workers: int = 1
) -> None:
    """Write ``count`` heads into the folder ``out``.

    ``head_00.ply`` is a cloud of ``points`` points, ``head_00_mesh.ply`` its surface; ``manifest.json`` holds
    every head's parameters, centre, eyes and size; ``heads.png`` shows them all. A stopped run goes on where
    it was, and any number of ``workers`` writes the same bytes.

    Raises:
        HeadvoxError: a number below one, a negative seed, Open3D missing, or a folder that cannot be made or
            that holds other heads.
    """
    for name, value in (("count", count), ("points", points), ("workers", workers)):
        if value < 1:
            raise HeadvoxError(f"Expected {name} to be at least 1, got {value}.", "Give a positive number.")
    if seed < 0:
        raise HeadvoxError(f"Expected a seed of 0 or more, got {seed}.", "Give a whole number.")
    _open3d()
    out = Path(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HeadvoxError(
            f"Cannot make the folder {out}: {error.strerror}.", "Choose another folder."
        ) from None
    identities = sample_identities(count, seed)
    settings = {"count": count, "points": points, "metric": metric, "seed": seed}
    _claim(out / "settings.json", settings)
    job = partial(_write_head, out=out, points=points, metric=metric, seed=seed)
    if workers == 1:
        entries = [job(identity) for identity in identities]
    else:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            entries = list(pool.map(job, identities))
    manifest = {
        "format": "headvox-heads",
        "version": 1,
        **settings,
        "unit": "m",
        "axes": "x right, y forward, z up",
        "eye_distance_m": None if metric else EYE_DISTANCE_M,
        "heads": entries,
    }
    _contact_sheet(out / "heads.png", [make_shell(identity, metric) for identity in identities])
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
    with _replacing(path) as fresh:
        fresh.write_text(text)


def _write_head(identity: Identity, out: Path, points: int, metric: bool, seed: int) -> dict[str, Any]:
    """Write what is missing of one head and return its entry of the manifest."""
    shell = make_shell(identity, metric)
    cloud, mesh = (out / f"head_{identity.number:02d}{kind}.ply" for kind in ("", "_mesh"))
    if not mesh.exists():
        with _replacing(mesh) as path:
            path.write_bytes(ply_bytes(shell.vertices, shell.faces))
    if not cloud.exists():
        with _replacing(cloud) as path:
            path.write_bytes(
                ply_bytes(sample_points(shell, points, (seed * 100_003 + identity.number) % MAX_SEED))
            )
    size = np.ptp(shell.vertices, axis=0)
    return {
        **asdict(identity),
        "cloud": cloud.name,
        "mesh": mesh.name,
        "centre": [0.0, 0.0, 0.0],
        "eye_left": shell.eyes[0].tolist(),
        "eye_right": shell.eyes[1].tolist(),
        "size": np.round(size, 6).tolist(),
        "scale": round(shell.scale, 9),
    }


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


def _contact_sheet(path: Path, shells: list[HeadShell]) -> None:
    """Draw all heads from the front left, shaded, on one picture."""
    columns = min(11, len(shells))
    rows = -(-len(shells) // columns)
    width, height = TILE_PX
    sheet = Image.new("L", (columns * width, rows * height), 255)
    draw = ImageDraw.Draw(sheet)
    for number, shell in enumerate(shells):
        corner = (number % columns * width, number // columns * height)
        sheet.paste(Image.fromarray(_picture(shell)), corner)
        draw.text((corner[0] + 4, corner[1] + 3), f"{number:02d}", fill=0)
    with _replacing(path) as temporary:
        sheet.save(temporary, format="PNG")


def _picture(shell: HeadShell) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return a shaded view (height, width) from the front left, 0.34 m wide."""
    o3d = _open3d()
    width, height = TILE_PX
    turn = np.radians(30.0)
    toward = np.array([-np.sin(turn), np.cos(turn), 0.15])
    toward /= np.sqrt((toward * toward).sum())
    right = np.array([-np.cos(turn), -np.sin(turn), 0.0])
    up = np.cross(right, -toward)
    pixel = 0.34 / width
    columns, rows = np.meshgrid(np.arange(width) + 0.5 - width / 2, height / 2 - np.arange(height) - 0.5)
    starts = toward + pixel * (columns[..., None] * right + rows[..., None] * up)
    rays = np.concatenate([starts, np.broadcast_to(-toward, starts.shape)], axis=-1)
    seen = _scene(o3d, shell.vertices, shell.faces).cast_rays(o3d.core.Tensor(rays.astype(np.float32)))
    shade = np.abs(seen["primitive_normals"].numpy() @ toward)
    return np.where(np.isfinite(seen["t_hit"].numpy()), 40 + 190 * shade, 255).astype(np.uint8)


def _scene(o3d: Any, vertices: F64, faces: I32) -> Any:
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
    )
    return scene


def _open3d() -> Any:
    try:
        import open3d
    except ImportError:
        raise HeadvoxError(
            "Making the heads data set needs Open3D.", 'Install it with: pip install "headvox[synth]"'
        ) from None
    return open3d
