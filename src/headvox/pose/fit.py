"""From a candidate to a 6-DoF head: a head template is aligned to the raw points about it.

A head is tried at several yaws, the best few of which are refined (:mod:`headvox.pose.trials`). What the others cost
says how sure the orientation is: the back of a head knows its centre, not always its yaw.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import count
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from headvox.data import F64, I64, Expected, Frame
from headvox.machine.threads import Threads
from headvox.pose.nearby import gather, sensors_of
from headvox.pose.settle import expect_turns, finish_all
from headvox.pose.template import load_template
from headvox.pose.trials import Scratch, Trials, list_jobs, refine_all, search

YAWS = 12
NOD_RAD = np.radians(10.0)  # people look down a little more often than up


class Poses(NamedTuple):
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

        def nan(*shape: int) -> F64:
            return np.full((len(centres), *shape), np.nan)

        return cls(centres.copy(), nan(4), nan(), nan(3, 3), nan(3, 3), nan(), nan(), nan())

    def of(self, rows: I64, centres: F64) -> Poses:
        """Return those of some ``rows`` (N,), unknown where there is no such row; ``centres`` (N, 3) are theirs."""
        told, there = Poses.unknown(centres), rows < len(self.radii)
        for mine, theirs in zip(told, self, strict=True):
            mine[there] = theirs[rows[there]]
        return told


@lru_cache(maxsize=1)
def upright_turns() -> F64:
    """Return the rotations (YAWS, 9) of heads that look every way, a little down."""
    yaws = 2.0 * np.pi * np.arange(YAWS) / YAWS
    turns = Rotation.from_euler("ZY", np.column_stack([yaws, np.full(YAWS, NOD_RAD)]))
    return np.ascontiguousarray(turns.as_matrix().reshape(YAWS, 9))


@lru_cache(maxsize=1)
def all_turns() -> F64:
    """Return 60 rotations (60, 9), the icosahedron's: none of all is farther than 45 degrees from one of them."""
    return np.ascontiguousarray(Rotation.create_group("I").as_matrix().reshape(-1, 9))


class FitMemory(NamedTuple):
    """The working memory of :func:`fit_poses`: nothing large is allocated per frame."""

    scratch: list[Scratch]
    """one a thread"""
    trials: Trials

    @classmethod
    def new(cls, threads: int, heads: int) -> FitMemory:
        """Return the memory for so many ``threads`` and, at most, ``heads``."""
        return cls([Scratch.new() for _ in range(threads)], Trials.new(heads))


def fit_poses(
    frame: Frame, centres: F64, memory: FitMemory, threads: Threads, expected: Expected | None = None
) -> Poses:
    """Fit a head near each of ``centres`` (N, 3), world, metres.

    A candidate within reach of a head in ``expected`` whose orientation is known starts from that alone, unless the fit
    is poor.
    """
    poses, heads, trials = Poses.unknown(centres), len(centres), memory.trials
    first = expected_turns(centres, expected)
    sensors = sensors_of(frame)
    template, upright, anyhow = load_template(), upright_turns(), all_turns()
    left = count()  # whoever is free takes the next head

    def find(work: Scratch) -> None:
        while (i := next(left)) < heads:
            n, m = gather(sensors, centres[i], work.samples, work.rays)
            search(work, n, m, first[i], upright, anyhow, template, trials, i)

    threads.run(find, [(work,) for work in memory.scratch[:heads]])
    jobs = list_jobs(trials, heads)
    taken, finished = np.zeros(1, np.int64), np.zeros(1, np.int64)

    def improve(work: Scratch) -> None:
        refine_all(work, trials, jobs, taken, template)

    threads.run(improve, [(work,) for work in memory.scratch[:jobs]])

    def finish(work: Scratch) -> None:
        finish_all(work, trials, heads, finished, centres, template, poses)

    threads.run(finish, [(work,) for work in memory.scratch[:heads]])
    return poses


def expected_turns(centres: F64, expected: Expected | None) -> F64:
    """Return the rotation (N, 9) that is expected at each of ``centres`` (N, 3); NaN where none is."""
    turns = np.full((len(centres), 9), np.nan)
    if expected is not None and len(expected):
        tables = (expected.centres, expected.quaternions, expected.reaches_m)
        expect_turns(centres, *(np.ascontiguousarray(table) for table in tables), turns)
    return turns
