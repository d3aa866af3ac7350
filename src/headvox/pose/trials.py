"""Which pose of all: many starts on few points, the best few refined on more, and the best of all polished on most.

What is tried of a head lies in :class:`Trials`, apart from the thread that does it: the starts of a head are explored
by one thread, but any thread refines any state, so that three heads take two threads no longer than they must.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from headvox.data import F64, I64
from headvox.machine.cholesky import half_log_determinant
from headvox.machine.kernels import bare_kernel, rule
from headvox.machine.simd import LANES
from headvox.machine.threads import take
from headvox.pose.align import invert, linearise, move, solve
from headvox.pose.nearby import MOST_SAMPLES, RAY, SAMPLE
from headvox.pose.residuals import COST, EVIDENCE, PARAMETERS, ROWS, STATE, TOLD
from headvox.pose.template import FINE_MODES, LINE, MODES, WORDS

COARSE_STEPS, FINE_STEPS, POLISH_STEPS = 4, 5, 3
COARSE_SAMPLES, FINE_SAMPLES, POLISH_SAMPLES = 120, 240, 400
FINE_RAYS, POLISH_RAYS = 120, 400
# Of a row of the Jacobian: all points and all rays in whole vectors, and an odd number of lines of the cache.
ROOM = LANES * (-(-POLISH_SAMPLES // LANES) - (-POLISH_RAYS // LANES)) + LINE
COARSE_MODES = 0
# Of the first coarse step (1 less each step), the first and the last fine one.
COARSE_K, FINE_K, LAST_K = 4.0, 4.0, 2.5
MOST_STARTS = 60
MOST_REFINED = 6
MARGIN = 7.0  # a start that costs more than the best one by this is not refined, but for the second best
ALIKE = 2.91  # trace of the turn between two starts that are one: 17 degrees apart
LEAST_SAMPLES = 20  # fewer points say nothing about a pose
POOR = 0.4  # mean cost of a point from which on an expected orientation is not trusted: most wrong ones cost more
ROUND_M = 0.14  # what counts as the head when we ask whether it was seen from all sides
ROUND_SHARE = 0.35
POINTS, RAYS, MORE_POINTS, MORE_RAYS, STANDS, TRIED, REFINED = range(7)  # what is counted of a head
COUNTS = 7


class Scratch(NamedTuple):
    """The working memory of one thread."""

    samples: F64
    """(MOST_SAMPLES, SAMPLE) what was gathered about the candidate (:mod:`headvox.pose.nearby`), and"""
    rays: F64
    """(MOST_SAMPLES, RAY)"""
    points: F64
    """(SAMPLE, COARSE_SAMPLES) those of the samples that all starts are tried on"""
    J: F64
    """(ROWS, ROOM) the Jacobian, a column a point, and what leads to it"""
    words: I64
    """(WORDS, ROOM) what the template says of these columns, and"""
    A: F64
    """(PARAMETERS, PARAMETERS + 1) the normal equations"""
    x: F64
    """(PARAMETERS,) a step"""
    costs: F64
    """(MOST_STARTS,) of the starts"""
    coarse: F64
    """(MOST_STARTS, STATE) what the starts came to"""
    told: F64
    """(TOLD,) scrap"""

    @classmethod
    def new(cls) -> Scratch:
        """Return the memory for one thread, all zeros."""
        return cls(
            np.zeros((MOST_SAMPLES, SAMPLE)), np.zeros((MOST_SAMPLES, RAY)), np.zeros((SAMPLE, COARSE_SAMPLES)),
            np.zeros((ROWS, ROOM)), np.zeros((WORDS, ROOM), np.int64), np.zeros((PARAMETERS, PARAMETERS + 1)),
            np.zeros(PARAMETERS), np.zeros(MOST_STARTS), np.zeros((MOST_STARTS, STATE)), np.zeros(TOLD),
        )  # fmt: skip


class Trials(NamedTuple):
    """What is tried of some heads: a row a head."""

    points: F64
    """(H, SAMPLE, FINE_SAMPLES) the samples that states are refined on, and"""
    passing: F64
    """(H, RAY, FINE_RAYS) the rays"""
    more_points: F64
    """(H, SAMPLE, POLISH_SAMPLES) the samples that the best state is polished on, and"""
    more_passing: F64
    """(H, RAY, POLISH_RAYS) the rays"""
    counts: I64
    """(H, COUNTS) how many of these, whether gravity holds, how many states are tried, and how many refined at once"""
    states: F64
    """(H, MOST_REFINED, STATE) what is tried"""
    told: F64
    """(H, MOST_REFINED, TOLD) of these, once they are refined"""
    covariances: F64
    """(H, 6, 6) of shift and turn of the best, in its axes"""
    jobs: I64
    """(H * MOST_REFINED, 2) heads and states that are left to refine"""

    @classmethod
    def new(cls, heads: int) -> Trials:
        """Return the memory for as many ``heads``, all zeros."""
        return cls(
            np.zeros((heads, SAMPLE, FINE_SAMPLES)), np.zeros((heads, RAY, FINE_RAYS)),
            np.zeros((heads, SAMPLE, POLISH_SAMPLES)), np.zeros((heads, RAY, POLISH_RAYS)),
            np.zeros((heads, COUNTS), np.int64), np.zeros((heads, MOST_REFINED, STATE)),
            np.zeros((heads, MOST_REFINED, TOLD)), np.zeros((heads, 6, 6)),
            np.zeros((heads * MOST_REFINED, 2), np.int64),
        )  # fmt: skip


@rule
def evenly(s, used, there):
    """Return which row of all that are ``there`` is the ``s``-th of those that are ``used``."""
    return (2 * s + 1) * there // (2 * used)


@rule
def choose(source, there, target, most):
    """Copy at most ``most`` of the first ``there`` rows of ``source``, evenly over all, to columns; return how many."""
    used = min(there, most)
    for s in range(used):
        at = evenly(s, used, there)
        for j in range(source.shape[1]):
            target[j, s] = source[at, j]
    return used


@rule
def begin(state, turn):
    """Let ``state`` be the mean head, turned as ``turn`` (9,) says."""
    for j in range(STATE):
        state[j] = turn[j - 3] if 3 <= j < 12 else 0.0


@bare_kernel
def is_round(samples, n):
    """Whether points whose sensor nobody knows lie all around: a shell, whose neck and gravity need not be right."""
    seen, near, x, y, z = lean(samples, 0, n)
    return not seen and near >= LEAST_SAMPLES and np.sqrt(x * x + y * y + z * z) < ROUND_SHARE * near


@rule
def lean(samples, first, after):
    """Return whether a sensor is known of samples[first:after], how many are near, and the sum of their directions.

    Where one is known, nothing else is told.
    """
    near = 0
    x = y = z = 0.0
    for s in range(first, after):
        px, py, pz = samples[s, 0], samples[s, 1], samples[s, 2]
        squared = px * px + py * py + pz * pz
        if squared < ROUND_M * ROUND_M:
            if samples[s, 3] != 0.0 or samples[s, 4] != 0.0 or samples[s, 5] != 0.0:
                return True, 0, 0.0, 0.0, 0.0
            near += 1
            length = max(np.sqrt(squared), 1e-9)
            x += px / length
            y += py / length
            z += pz / length
    return False, near, x, y, z


@bare_kernel
def search(work, n, m, expected, upright, anyhow, template, trials, i):
    """Find the states of head ``i`` of ``trials`` that are worth refining.

    Near it lie the first ``n`` samples and ``m`` rays of ``work``.

    ``expected`` (9,) is the rotation to start from, NaN where none is known. That alone is refined, at once; where it
    is not trusted, or not known, all of ``upright`` (U, 9) are explored too, or of ``anyhow`` (A, 9) where the points
    lie all around. ``work`` is a :class:`Scratch`, ``template`` a :class:`~headvox.pose.template.Template`.
    """
    counts = trials.counts[i]
    counts[POINTS] = choose(work.samples, n, trials.points[i], FINE_SAMPLES)
    counts[RAYS] = choose(work.rays, m, trials.passing[i], FINE_RAYS)
    counts[MORE_POINTS] = choose(work.samples, n, trials.more_points[i], POLISH_SAMPLES)
    counts[MORE_RAYS] = choose(work.rays, m, trials.more_passing[i], POLISH_RAYS)
    counts[TRIED] = counts[REFINED] = 0
    if n < LEAST_SAMPLES:
        return
    stands = not is_round(work.samples, n)
    counts[STANDS] = stands
    knows = True
    for j in range(9):
        knows = knows and np.isfinite(expected[j])
    if knows:
        begin(trials.states[i, 0], expected)
        refine(work, trials, i, 0, template)
        counts[TRIED] = counts[REFINED] = 1
        if is_trusted(trials.told[i, 0], counts[POINTS]):
            return
    starts = upright if stands else anyhow
    used = choose(work.samples, n, work.points, COARSE_SAMPLES)
    explore(work, used, trials.passing[i], starts, stands, template)
    counts[TRIED] = pick_all(work.costs, work.coarse, starts.shape[0], trials.states[i], counts[TRIED])


@rule
def is_trusted(told, points):
    """Return whether what is ``told`` of an expected state, refined on so many ``points``, needs no other beside it."""
    return told[COST] <= POOR * points


@bare_kernel
def explore(work, used, rays, starts, upright, template):
    """Take a few steps from each of ``starts`` (S, 9), on the ``used`` points and none of the ``rays``.

    States and costs are left in ``work``.
    """
    A, x, modes, none = work.A, work.x, np.int64(COARSE_MODES), np.int64(0)
    for i in range(starts.shape[0]):
        state = work.coarse[i]
        begin(state, starts[i])
        for step in range(COARSE_STEPS + 1):
            k, steps = COARSE_K - min(step, COARSE_STEPS - 1), step < COARSE_STEPS
            work.costs[i] = linearise(
                work.points, used, rays, none, modes, k, upright, steps, template, state, work.J, work.words, A,
                work.told,
            )  # fmt: skip
            if steps:
                solve(A, x, 7 + modes)
                move(state, x, 7 + modes)


@rule
def pick_all(costs, coarse, count, picked, tried):
    """Write the best of ``count`` starts behind the ``tried`` states in ``picked``; return how many there are then."""
    least = np.inf
    for i in range(count):
        least = min(least, costs[i])
    while tried < MOST_REFINED:
        best = pick(costs, count, least, coarse, picked, tried)
        if best < 0:
            break
        for j in range(STATE):
            picked[tried, j] = coarse[best, j]
        tried += 1
    return tried


@rule
def pick(costs, count, least, coarse, picked, tried):
    """Return the best of the ``count`` starts that is not done yet, and mark it as done; -1 where none is worth it.

    The best one cost ``least``. A start that came to what was ``picked`` before is not worth it.
    """
    while True:
        best = np.int64(0)
        for i in range(count):
            if costs[i] < costs[best]:
                best = np.int64(i)
        if costs[best] == np.inf or (tried >= 2 and costs[best] > least + MARGIN):
            return np.int64(-1)
        costs[best] = np.inf
        known = False
        for j in range(tried):
            trace = 0.0
            for q in range(3, 12):
                trace += coarse[best, q] * picked[j, q]
            known = known or trace > ALIKE
        if not known:
            return best


@bare_kernel
def list_jobs(trials, heads):
    """List the states of the first ``heads`` that are tried and not refined yet; return how many."""
    jobs = 0
    for i in range(heads):
        for at in range(trials.counts[i, REFINED], trials.counts[i, TRIED]):
            trials.jobs[jobs, 0], trials.jobs[jobs, 1] = i, at
            jobs += 1
    return jobs


@bare_kernel
def refine_all(work, trials, jobs, taken, template):
    """Refine what was listed, ``jobs`` states in all, with other threads that count what is ``taken`` (1,)."""
    while True:
        k = take(taken, 0)
        if k >= jobs:
            return
        refine(work, trials, trials.jobs[k, 0], trials.jobs[k, 1], template)


@bare_kernel
def refine(work, trials, i, at, template):
    """Take the steps of the first modes from the state ``at`` of head ``i``.

    The last state, and what it costs, are left in ``trials``.
    """
    A, x, state, told, counts = work.A, work.x, trials.states[i, at], trials.told[i, at], trials.counts[i]
    # Plain constants would make Numba compile linearise for each of them.
    modes, always = np.int64(FINE_MODES), np.bool_(True)
    for step in range(FINE_STEPS + 1):
        k = FINE_K + (LAST_K - FINE_K) * min(step, FINE_STEPS - 1) / (FINE_STEPS - 1)
        cost = linearise(
            trials.points[i], counts[POINTS], trials.passing[i], counts[RAYS], modes, k, counts[STANDS] != 0, always,
            template, state, work.J, work.words, A, told,
        )  # fmt: skip
        solve(A, x, 7 + modes)
        if step < FINE_STEPS:
            move(state, x, 7 + modes)
    told[EVIDENCE] = cost + half_log_determinant(A, 7 + modes)


@rule
def best_of(told, count):
    """Return which of ``count`` refined states has the best evidence; -1 where there is none."""
    best = np.int64(0)
    for s in range(1, count):
        if told[s, EVIDENCE] < told[best, EVIDENCE]:
            best = np.int64(s)
    return best if count > 0 and np.isfinite(told[best, EVIDENCE]) else np.int64(-1)


@bare_kernel
def polish(work, trials, i, at, template):
    """Take the last steps, of all modes and on more points and rays, from the state ``at`` of head ``i``.

    The state, what is told of it, but for the evidence, and its covariance are left in ``trials``.
    """
    A, x, state, told, counts = work.A, work.x, trials.states[i, at], trials.told[i, at], trials.counts[i]
    modes, always = np.int64(MODES), np.bool_(True)
    for step in range(POLISH_STEPS + 1):
        linearise(
            trials.more_points[i], counts[MORE_POINTS], trials.more_passing[i], counts[MORE_RAYS], modes, LAST_K,
            counts[STANDS] != 0, always, template, state, work.J, work.words, A, told,
        )  # fmt: skip
        solve(A, x, PARAMETERS)
        if step < POLISH_STEPS:
            move(state, x, PARAMETERS)
    invert(A, x, trials.covariances[i])
