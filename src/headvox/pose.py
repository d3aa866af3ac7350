"""From a candidate to a 6-DoF head: a head template is aligned to the raw points about it.

A head is tried at several yaws, the best few of which are refined (:mod:`headvox.align`). What the others cost says how
sure the orientation is: the back of a head knows its centre, not always its yaw.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from headvox.align import (
    COST,
    CROSSED,
    EVIDENCE,
    FINE_RAYS,
    FINE_SAMPLES,
    MOST_REFINED,
    ON_SURFACE,
    STATE,
    TOLD,
    align,
)
from headvox.data import F64, Expected, Frame
from headvox.kernels import Threads
from headvox.nearby import MOST_SAMPLES, RAY, SAMPLE, gather
from headvox.template import Template, load_template

YAWS = 10
POOR = 0.6  # mean cost of a point from which on an expected orientation is not trusted
LEAST_SAMPLES = 20  # fewer points say nothing about a pose
SURE_YAW_RAD = np.radians(45.0)  # an orientation that is less sure is not stated
ROUND_M = 0.14  # what counts as the head when we ask whether it was seen from all sides
ROUND_SHARE = 0.35


@dataclass(frozen=True, slots=True)
class Poses:
    """What was fitted to each candidate: structure of arrays, in the candidates' order.

    ``centres`` (N, 3), ``quaternions`` (N, 4) and ``radii`` (N,) and the two covariances are those of
    :class:`~headvox.data.Heads`. ``misfits`` (N,) is the mean cost of a point (0 perfect, 3 none of it is a head),
    ``coverages`` (N,) the share of the points that lie on the template, ``crossings`` (N,) the share of the rays to
    the background that would have to pass through it. All are NaN where there were too few points.
    """

    centres: F64
    quaternions: F64
    radii: F64
    centre_covariances: F64
    rotation_covariances: F64
    misfits: F64
    coverages: F64
    crossings: F64

    @classmethod
    def unknown(cls, centres: F64) -> Poses:
        """Return ``centres`` (N, 3) of which nothing else is known."""
        n = len(centres)
        nan = np.full(n, np.nan)
        square = np.full((n, 3, 3), np.nan)
        return cls(
            centres.copy(), np.full((n, 4), np.nan), nan, square, square.copy(), nan.copy(), nan.copy(), nan.copy()
        )  # fmt: skip


class Scratch:
    """The working memory of one thread."""

    def __init__(self) -> None:
        self.samples = np.zeros((MOST_SAMPLES, SAMPLE))
        self.rays = np.zeros((MOST_SAMPLES, RAY))
        self.coarse = np.zeros((len(all_turns()), STATE))
        self.fine = np.zeros((MOST_REFINED, STATE))
        self.told = np.zeros((MOST_REFINED, TOLD))
        self.covariances = np.zeros((MOST_REFINED, 6, 6))


@lru_cache(maxsize=1)
def upright_turns() -> F64:
    """Return the rotations (YAWS, 9) of upright heads that look every way."""
    about_z = np.zeros((YAWS, 3))
    about_z[:, 2] = 2.0 * np.pi * np.arange(YAWS) / YAWS
    return np.ascontiguousarray(Rotation.from_rotvec(about_z).as_matrix().reshape(YAWS, 9))


@lru_cache(maxsize=1)
def all_turns() -> F64:
    """Return 60 rotations (60, 9), the icosahedron's: none of all is farther than 45 degrees from one of them."""
    return np.ascontiguousarray(Rotation.create_group("I").as_matrix().reshape(-1, 9))


def fit_poses(
    frame: Frame, centres: F64, scratch: list[Scratch], threads: Threads, expected: Expected | None = None
) -> Poses:
    """Fit a head near each of ``centres`` (N, 3), world, metres.

    ``scratch`` holds one memory a thread. A candidate within reach of a head in ``expected`` whose orientation is known
    starts from that alone, unless the fit is poor.
    """
    poses = Poses.unknown(centres)
    first = expected_turns(centres, expected)
    parts = threads.count

    def fit(part: int) -> None:
        for i in range(part, len(centres), parts):
            fit_pose(frame, centres[i], first[i], scratch[part], poses, i)

    threads.run(fit, [(part,) for part in range(min(parts, max(len(centres), 1)))])
    return poses


def expected_turns(centres: F64, expected: Expected | None) -> F64:
    """Return the rotation (N, 9) that is expected at each of ``centres`` (N, 3); NaN where none is."""
    turns = np.full((len(centres), 9), np.nan)
    if expected is None or len(expected) == 0:
        return turns
    for i, centre in enumerate(centres):
        far = np.linalg.norm(expected.centres - centre, axis=1)
        far[~(far <= expected.reaches_m) | ~np.isfinite(expected.quaternions).all(axis=1)] = np.inf
        nearest = int(np.argmin(far))
        if np.isfinite(far[nearest]):
            turns[i] = Rotation.from_quat(expected.quaternions[nearest]).as_matrix().reshape(9)
    return turns


def fit_pose(
    frame: Frame, centre: F64, first: F64, scratch: Scratch, poses: Poses, i: int
) -> tuple[int, int]:
    """Fit a head near ``centre`` (3,) and write it to row ``i`` of ``poses``.

    ``first`` (9,) is the rotation to start from, NaN where none is known. Returns which of the states in ``scratch`` is
    the best, and how many there are: none where there are too few points.
    """
    template = load_template()
    n, m = gather(frame, centre, scratch.samples, scratch.rays)
    if n < LEAST_SAMPLES:
        return 0, 0
    refined = 0
    if np.isfinite(first).all():
        refined = _align(first.reshape(1, 9), True, n, m, template, scratch)
        if scratch.told[0, COST] > POOR * min(n, FINE_SAMPLES):
            refined = 0
    if refined == 0:
        everywhere = _seen_from_everywhere(scratch.samples[:n])
        starts = all_turns() if everywhere else upright_turns()
        refined = _align(starts, not everywhere, n, m, template, scratch)
    best = int(np.argmin(scratch.told[:refined, EVIDENCE]))
    _settle(centre, best, refined, min(n, FINE_SAMPLES), min(m, FINE_RAYS), template, scratch, poses, i)
    return best, refined


def _align(starts: F64, upright: bool, n: int, m: int, template: Template, scratch: Scratch) -> int:
    refined: int = align(
        scratch.samples, n, scratch.rays, m, starts, upright, template.rows, template.low, template.voxel_m,
        scratch.coarse, scratch.fine, scratch.told, scratch.covariances,
    )  # fmt: skip
    return refined


def _seen_from_everywhere(samples: F64) -> bool:
    """Whether points whose sensor nobody knows lie all around: a shell, whose neck and gravity need not be right."""
    near = samples[(samples[:, :3] ** 2).sum(axis=1) < ROUND_M**2]
    if len(near) < LEAST_SAMPLES or np.any(near[:, 3:6]):
        return False
    away = near[:, :3] / np.maximum(np.sqrt((near[:, :3] ** 2).sum(axis=1, keepdims=True)), 1e-9)
    return bool(np.sqrt((away.mean(axis=0) ** 2).sum()) < ROUND_SHARE)


def _settle(
    centre: F64,
    best: int,
    refined: int,
    n: int,
    m: int,
    template: Template,
    scratch: Scratch,
    poses: Poses,
    i: int,
) -> None:
    """Write the best of the refined states to row ``i``, with covariances that know of the others."""
    states, told, covariances = scratch.fine[:refined], scratch.told[:refined], scratch.covariances
    state = states[best]
    if not np.isfinite(state).all():
        return
    R = state[3:12].reshape(3, 3)
    odds = np.exp((told[best, EVIDENCE] - told[:, EVIDENCE]) / template.temperature)
    odds /= odds.sum()
    turns = Rotation.from_matrix(R.T @ states[:, 3:12].reshape(-1, 3, 3)).as_rotvec()
    shifts = states[:, :3] - state[:3]
    shape = template.shift_factor * covariances[best, :3, :3]
    poses.centres[i] = centre + state[:3]
    poses.radii[i] = template.radius_m * np.exp(state[12])
    poses.centre_covariances[i] = R @ shape @ R.T + (odds * shifts.T) @ shifts
    turn_covariance = template.turn_factor * covariances[best, 3:, 3:] + (odds * turns.T) @ turns
    poses.misfits[i] = told[best, COST] / n
    poses.coverages[i] = told[best, ON_SURFACE] / n
    poses.crossings[i] = told[best, CROSSED] / max(m, 1)
    if turn_covariance[2, 2] < SURE_YAW_RAD**2:
        poses.quaternions[i] = Rotation.from_matrix(R).as_quat()
        poses.rotation_covariances[i] = turn_covariance
