"""What a cascade is searched with: synthetic views and where every head in them really is.

Of twenty views nine are :func:`headvox.synth.scene.training_view`, five crowds of people who bend, crouch and lie,
three rooms with nobody, two bodies scanned from all around, and one a lone head shell. What real rigs have is
added: extrinsics a little wrong where several cameras look, and backgrounds that are cut off.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy
from scipy.spatial.transform import Rotation

from headvox.data import F64, Cloud, DepthImage, Frame, Intrinsics
from headvox.frames import inverse, transform
from headvox.mesh import sample_surface
from headvox.synth.heads import make_shell, sample_identities
from headvox.synth.people import pose_person, sample_person, sample_pose
from headvox.synth.scene import POSTURES, TrueHead, sample_scene, training_view
from headvox.synth.spread import spread_points

KINDS = ("ordinary",) * 9 + ("crowd",) * 5 + ("nobody",) * 3 + ("bodies",) * 2 + ("shell",)
RARE_SHARES = (0.12, 0.08, 0.14, 0.30, 0.16, 0.12, 0.08)  # of POSTURES
SHELL_POINTS = 9000
EXTRINSICS_SIGMA_M, EXTRINSICS_SIGMA_RAD = 0.012, 0.005
CUT_SHARE = 0.08  # of the views whose background is missing
LEAST_VISIBLE = 0.25

Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class Heads:
    """The heads of a view.

    ``centres`` (N, 3) m; ``visible`` (N,) the share that the sensor which sees it best sees; ``clear`` (N,) whether
    a detector should find it: a quarter visible, whole, and nobody's dummy; ``posture`` (N,) index into POSTURES;
    ``hair`` what is on each head, of depth images only; empty where it was not noted.
    """

    centres: F64
    visible: F64
    clear: npt.NDArray[np.bool_]
    posture: npt.NDArray[np.int64]
    hair: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class View:
    """One frame to learn from; ``number`` says which."""

    number: int
    frame: Frame
    heads: Heads

    @property
    def kind(self) -> str:
        """What sort of view it is: one of KINDS."""
        return KINDS[self.number % len(KINDS)]


def make_view(seed: int, number: int) -> View:
    """Make view ``number`` of a search: the same for the same seed."""
    rng = np.random.default_rng([seed, number, 0xE701])
    kind = KINDS[number % len(KINDS)]
    if kind == "bodies":
        return View(number, *_bodies(rng))
    if kind == "shell":
        return View(number, *_shell(rng))
    if kind == "ordinary":
        frame, truth = training_view(int(rng.integers(2**31)))
    else:
        count = 0 if kind == "nobody" else int(rng.integers(1, 7))
        postures = [str(posture) for posture in rng.choice(POSTURES, count, p=RARE_SHARES)]
        frame, truth = sample_scene(rng, None, postures, moving=False).frame(0)
    if len(frame.depths) > 1 and rng.uniform() < 0.7:
        frame = replace(frame, depths=tuple(_misplaced(image, rng) for image in frame.depths))
    far_m = {image.name: np.inf for image in frame.depths}
    if rng.uniform() < CUT_SHARE:
        far_m = {image.name: float(rng.uniform(1.5, 4.0)) for image in frame.depths}
    heads = _heads_of(truth, frame.depths, far_m)
    return View(
        number, replace(frame, depths=tuple(_cut(image, far_m[image.name]) for image in frame.depths)), heads
    )


def _heads_of(truth: Sequence[TrueHead], images: Sequence[DepthImage], far_m: dict[str, float]) -> Heads:
    """Return the heads; a camera whose image is cut off before a head does not see it."""
    visible = np.zeros(len(truth))
    for image in images:
        T = inverse(image.T_world_camera)
        for k, head in enumerate(truth):
            if transform(T, head.centre[None])[0, 2] < far_m[image.name]:
                visible[k] = max(visible[k], head.visible.get(image.name, 0.0))
    clear = [
        seen >= LEAST_VISIBLE and not head.ignore and not head.truncated
        for seen, head in zip(visible, truth, strict=True)
    ]
    posture = [POSTURES.index(head.posture) if head.posture in POSTURES else len(POSTURES) for head in truth]
    centres = np.array([head.centre for head in truth]).reshape(-1, 3)
    hair = tuple(head.hair for head in truth)
    return Heads(centres, visible, np.array(clear, bool), np.array(posture, np.int64), hair)


def _misplaced(image: DepthImage, rng: Rng) -> DepthImage:
    T = image.T_world_camera.copy()
    T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(rng.normal(0.0, EXTRINSICS_SIGMA_RAD, 3)).as_matrix()
    T[:3, 3] += rng.normal(0.0, EXTRINSICS_SIGMA_M, 3)
    return replace(image, T_world_camera=T)


def _cut(image: DepthImage, far_m: float) -> DepthImage:
    too_far = image.depth * image.intrinsics.depth_scale > far_m
    return replace(image, depth=np.where(too_far, 0, image.depth).astype(np.uint16))


def _bodies(rng: Rng) -> tuple[Frame, Heads]:
    """One to three whole bodies, as clouds of their surface with no known origin."""
    parts, centres, which = [], [], []
    for x, y in [(-1.6, -1.2), (1.5, -1.0), (0.0, 1.6)][: rng.integers(1, 4)]:
        posture = int(rng.choice(len(POSTURES), p=RARE_SHARES))
        pose = sample_pose(rng, POSTURES[posture])
        body = pose_person(sample_person(rng), pose, (x, y), float(rng.uniform(0, 2 * np.pi)))
        parts.append(sample_surface(body.vertices, body.faces, float(rng.uniform(0.008, 0.02))))
        centres.append(body.T_world_head[:3, 3])
        which.append(posture)
    if rng.random() < 0.5:
        floor = np.stack(np.meshgrid(np.arange(-3, 3, 0.02), np.arange(-3, 3, 0.02)), -1).reshape(-1, 2)
        parts.append(np.column_stack([floor, np.zeros(len(floor))]))
    points: F64 = np.concatenate(parts).astype(np.float64)
    points = points + rng.normal(0.0, rng.choice([0.0, 0.003]), points.shape)
    count = len(centres)
    heads = Heads(np.array(centres), np.ones(count), np.ones(count, bool), np.array(which))
    return Frame(0, clouds=(Cloud("bodies", np.ascontiguousarray(points, np.float32)),)), heads


def _shell(rng: Rng) -> tuple[Frame, Heads]:
    """One head alone, turned in any direction."""
    identity = sample_identities(1, int(rng.integers(2**31)))[0]
    shell = make_shell(identity, bool(rng.integers(2)))
    points = spread_points(shell.vertices, shell.faces, SHELL_POINTS, rng)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = rng.uniform([-1, -1, 0], [1, 1, 1.8]) if rng.random() < 0.7 else rng.normal(0, 0.03, 3)
    cloud = Cloud("shell", np.ascontiguousarray(transform(T, points), np.float32))
    heads = Heads(T[None, :3, 3].copy(), np.ones(1), np.ones(1, bool), np.zeros(1, np.int64))
    return Frame(0, clouds=(cloud,)), heads


# ------------------------------------------------------------------------------------------------------- on disk


def keep_view(folder: Path, seed: int, number: int) -> View:
    """Return view ``number``, from ``folder`` if it was made before; else make it and keep it there."""
    path = folder / f"{number:06d}.npz"
    if path.exists():
        return _read(path, number)
    folder.mkdir(parents=True, exist_ok=True)
    view = make_view(seed, number)
    part = path.with_suffix(f".{os.getpid()}.part")
    _write(part, view)
    os.replace(part, path)
    return view


def _write(path: Path, view: View) -> None:
    arrays: dict[str, npt.NDArray[Any]] = {
        "centres": view.heads.centres, "visible": view.heads.visible, "clear": view.heads.clear,
        "posture": view.heads.posture, "hair": np.array(view.heads.hair, np.str_),
    }  # fmt: skip
    for k, image in enumerate(view.frame.depths):
        c = image.intrinsics
        arrays[f"depth_{k}"] = image.depth
        arrays[f"camera_{k}"] = np.array([c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.depth_scale])
        arrays[f"T_world_camera_{k}"] = image.T_world_camera
    for k, cloud in enumerate(view.frame.clouds):
        arrays[f"points_{k}"] = cloud.points
    # numpy.savez_compressed takes five times as long, for files that are hardly smaller.
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                npy.write_array(file, np.ascontiguousarray(array), allow_pickle=False)


def _read(path: Path, number: int) -> View:
    with np.load(path, allow_pickle=False) as arrays:
        hair = tuple(arrays["hair"].tolist()) if "hair" in arrays.files else ()
        heads = Heads(arrays["centres"], arrays["visible"], arrays["clear"], arrays["posture"], hair)
        depths, clouds = [], []
        for k in range(len(arrays.files)):
            if f"depth_{k}" in arrays.files:
                width, height, *rest = arrays[f"camera_{k}"].tolist()
                lens = Intrinsics(int(width), int(height), *rest)
                depths.append(
                    DepthImage(f"camera_{k}", arrays[f"depth_{k}"], lens, arrays[f"T_world_camera_{k}"])
                )
            if f"points_{k}" in arrays.files:
                clouds.append(Cloud(f"cloud_{k}", arrays[f"points_{k}"]))
    return View(number, Frame(0, tuple(clouds), tuple(depths)), heads)
