"""Rest bodies from the baked basis: shape, joints, skinning and the landmarks of the head.

The rest frame is x forward, y to the person's left, z up, in metres; its origin is near the hips. The basis
is made by ``tools/bake_bodies.py``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np
import numpy.typing as npt

from headvox.data import F64, I32

Mask = npt.NDArray[np.bool_]

AGE_YEARS = (1.0, 10.0, 25.0, 90.0)  # the ages of the four anchor bodies
ANCHORS = (AGE_YEARS, (0.0, 1.0), (0.0, 0.5, 1.0), (0.0, 0.5, 1.0))  # age, sex, mass, muscle


@dataclass(frozen=True, slots=True)
class BodyBasis:
    """The baked asset.

    ``mean`` (P, 3) and ``components`` (K, P, 3) over P = V + J points, vertices first, then joints; ``codes``
    (age, sex, mass, muscle, height, ancestry, K) at the anchors; ``head_changes`` (H, P, 3).
    """

    mean: F64
    components: F64
    codes: F64
    head_change_names: tuple[str, ...]
    head_changes: F64
    joint_names: tuple[str, ...]
    joint_parents: tuple[int, ...]
    skin_joints: I32  # (V, 4)
    skin_weights: F64  # (V, 4), rows sum to 1
    faces: I32  # (F, 3)
    is_head: Mask  # (V,) each
    is_hand: Mask
    is_foot: Mask
    is_eye: Mask
    is_ear: Mask
    menton: int  # vertices on the mid-line
    nasion: int
    is_skull: Mask  # (V,) what the box of the bald head is measured on

    def joint(self, name: str) -> int:
        """Return the number of a joint."""
        return self.joint_names.index(name)


@dataclass(frozen=True, slots=True)
class RestBody:
    """One person's body in the rest pose: ``vertices`` (V, 3), ``joints`` (J, 3), ``head_centre`` (3,)."""

    vertices: F64
    joints: F64
    head_centre: F64
    head_size: F64  # (3,) depth, breadth and height of the bald head's box


@lru_cache(maxsize=1)
def load_basis() -> BodyBasis:
    """Read the baked asset once."""
    with files("headvox").joinpath("assets/bodies.npz").open("rb") as stream, np.load(stream) as asset:
        arrays = {name: asset[name] for name in asset.files}
    mean = arrays["mean"].astype(np.float64)
    changes = np.zeros((len(arrays["head_changes"]), *mean.shape))
    changes[:, arrays["head_change_points"]] = arrays["head_changes"]
    weights = arrays["skin_weights"].astype(np.float64)
    n_vertices = len(weights)
    adult = mean[:n_vertices]
    menton, nasion, is_skull = _head_landmarks(
        adult, mean[n_vertices:], list(arrays["joint_names"]), arrays["is_head"] & ~arrays["is_ear"]
    )
    return BodyBasis(
        mean=mean,
        components=arrays["components"].astype(np.float64),
        codes=arrays["grid_codes"].astype(np.float64),
        head_change_names=tuple(map(str, arrays["head_change_names"])),
        head_changes=changes,
        joint_names=tuple(map(str, arrays["joint_names"])),
        joint_parents=tuple(map(int, arrays["joint_parents"])),
        skin_joints=arrays["skin_joints"].astype(np.int32),
        skin_weights=weights / weights.sum(1, keepdims=True),
        faces=arrays["faces"].astype(np.int32),
        is_head=arrays["is_head"],
        is_hand=arrays["is_hand"],
        is_foot=arrays["is_foot"],
        is_eye=arrays["is_eye"],
        is_ear=arrays["is_ear"],
        menton=menton,
        nasion=nasion,
        is_skull=is_skull,
    )


def _head_landmarks(vertices: F64, joints: F64, names: list[str], is_face: Mask) -> tuple[int, int, Mask]:
    """Find menton and nasion on the mid-line of the mean body, and the skull's vertices above the eyes."""
    eye = (joints[names.index("eye.L")] + joints[names.index("eye.R")]) / 2
    front = is_face & (np.abs(vertices[:, 1]) < 1.5e-3) & (vertices[:, 0] > eye[0] - 0.06)
    chin = front & (vertices[:, 0] > eye[0] - 0.005) & (vertices[:, 2] < eye[2] - 0.06)
    menton = int(np.argmax(np.where(chin, 0.3 * vertices[:, 0] - vertices[:, 2], -np.inf)))
    between_eyes = front & (np.abs(vertices[:, 2] - eye[2]) < 0.012)
    nasion = int(np.argmin(np.where(between_eyes, vertices[:, 0], np.inf)))
    return menton, nasion, is_face & (vertices[:, 2] > eye[2])


def mean_height_m(age_years: float, sex: float) -> float:
    """Return the mean height of people of an age, ``sex`` from 0 (male) to 1 (female)."""
    ages = (1, 2, 3, 4, 6, 8, 10, 12, 14, 16, 18, 50, 90)
    male = (0.76, 0.88, 0.96, 1.03, 1.16, 1.28, 1.39, 1.50, 1.64, 1.73, 1.76, 1.75, 1.69)
    female = (0.74, 0.86, 0.95, 1.02, 1.15, 1.27, 1.39, 1.52, 1.60, 1.63, 1.63, 1.62, 1.56)
    return float((1.0 - sex) * np.interp(age_years, ages, male) + sex * np.interp(age_years, ages, female))


def mean_head_scale(age_years: float, height_ratio: float) -> float:
    """Return how much larger real heads of an age are than those of the basis.

    The heads of its children are too small, and its heads grow in proportion to height, where real ones grow
    half as fast.
    """
    of_age = float(
        np.interp(age_years, (1.0, 3.0, 6.0, 10.0, 16.0, 25.0), (1.20, 1.17, 1.10, 1.05, 1.02, 1.01))
    )
    return of_age / float(np.sqrt(height_ratio))


def blend_points(
    age_years: float, sex: float, mass: float, muscle: float, height_m: float, ancestry: tuple[float, ...]
) -> F64:
    """Return the rest points (P, 3) of a body that stands ``height_m`` tall.

    ``sex`` runs from 0 (male) to 1 (female), ``mass`` and ``muscle`` from 0 to 1, ``ancestry`` weighs the
    three anchors of the basis.
    """
    basis = load_basis()
    codes = basis.codes
    for value, anchors in zip((age_years, sex, mass, muscle), ANCHORS, strict=True):
        hats = [np.interp(value, anchors, row) for row in np.eye(len(anchors))]
        codes = np.einsum("i,i...->...", hats, codes)
    short, tall = np.einsum("r,hrk->hk", np.asarray(ancestry) / sum(ancestry), codes)
    points = [basis.mean + np.einsum("k,kpc->pc", code, basis.components) for code in (short, tall)]
    heights = [np.ptp(p[: len(basis.skin_weights), 2]) for p in points]
    share = (height_m - heights[0]) / (heights[1] - heights[0])
    eyes_apart = np.interp(age_years, (12.0, 20.0), (0.1, 0.35))  # those of the basis are too close by 1-3 mm
    direction = basis.head_changes[basis.head_change_names.index("eye-trans-out")]
    return np.asarray((1.0 - share) * points[0] + share * points[1] + eyes_apart * direction)


def measure_head(vertices: F64) -> tuple[F64, F64]:
    """Return centre and size (3,) of the bald head's box: nasion to back, ear to ear, chin to crown."""
    basis = load_basis()
    skull = vertices[basis.is_skull]
    low = np.array([skull[:, 0].min(), skull[:, 1].min(), vertices[basis.menton, 2]])
    high = np.array([vertices[basis.nasion, 0], skull[:, 1].max(), skull[:, 2].max()])
    return (low + high) / 2, high - low


def make_rest_body(points: F64, head_scale: float, head_changes: tuple[float, ...]) -> RestBody:
    """Scale the head about its joint, add local head changes (in the order of the basis), and measure the
    head.

    ``points`` (P, 3) come from :func:`blend_points`. The neck follows as far as its skinning follows the
    head, so the surface stays smooth.
    """
    basis = load_basis()
    n_vertices = len(basis.skin_weights)
    points = points + np.einsum("h,hpc->pc", np.asarray(head_changes), basis.head_changes)
    head = basis.joint("head")
    follows = np.where(basis.skin_joints == head, basis.skin_weights, 0.0).sum(1)
    is_head_joint = [p == head for p in basis.joint_parents]  # the eyes
    share = np.concatenate([follows, np.asarray(is_head_joint, dtype=np.float64)])
    pivot = points[n_vertices + head]
    points = points + (head_scale - 1.0) * share[:, None] * (points - pivot)
    centre, size = measure_head(points[:n_vertices])
    return RestBody(points[:n_vertices], points[n_vertices:], centre, size)
