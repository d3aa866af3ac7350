"""The pose fit: all starts of all heads at once, each refined to its end; what is best of them is asked afterwards.

On the CPU a start is refined only when those before it were, and are not the same. Here there are threads for all of
them, and :mod:`headvox.pose.settle` chooses as it does there. A block takes a start; its threads share out the points,
and what they add up is added in an order that is always the same.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import cuda

from headvox.assemble import MOST_POSES
from headvox.cuda.blocks import share_of, sum_rows
from headvox.cuda.lanes import MATH, add, device, kernel, load, on_device, total, wait_for_block
from headvox.cuda.nearby import RAYS, ROUND, SAMPLES
from headvox.cuda.suppress import HEADS
from headvox.machine.cholesky import LEAST_PIVOT, substitute, substitute_back
from headvox.pose import residuals
from headvox.pose.align import add_prior_cost, add_priors, add_turn, invert_column, move
from headvox.pose.residuals import EVIDENCE, PARAMETERS, RESIDUAL, STATE, TOLD, weigh, weight_of_each
from headvox.pose.settle import Refined, assess, column, odds, quaternion_of, recentre, settle, turn_between
from headvox.pose.template import FINE_MODES, MODES
from headvox.pose.trials import (
    COARSE_K,
    COARSE_MODES,
    COARSE_SAMPLES,
    COARSE_STEPS,
    FINE_K,
    FINE_RAYS,
    FINE_SAMPLES,
    FINE_STEPS,
    LAST_K,
    LEAST_SAMPLES,
    MOST_REFINED,
    POLISH_RAYS,
    POLISH_SAMPLES,
    POLISH_STEPS,
    best_of,
    is_trusted,
    pick,
)

MOST_THREADS = 128  # of a block; a power of two
SYSTEM = PARAMETERS + 1  # columns of A: the last is the residual's
COLUMNS = max(FINE_SAMPLES + FINE_RAYS, POLISH_SAMPLES + POLISH_RAYS)

_whole_vectors = on_device(residuals.whole_vectors, LANES=1)
_in_registers = on_device(residuals.in_registers)
_place = on_device(residuals.place, np=MATH)
_corner = on_device(residuals.corner)
_short, _byte = on_device(residuals.short), on_device(residuals.byte)
_off_middle = on_device(residuals.off_middle, np=MATH)
_weigh = on_device(
    weigh,
    np=MATH,
    whole_vectors=_whole_vectors,
    place_points=on_device(
        residuals.place_points, np=MATH, in_registers=_in_registers, corner=_corner, place=_place
    ),
    look_up=on_device(residuals.look_up, np=MATH),
    unpack=on_device(residuals.unpack, np=MATH, short=_short, byte=_byte),
    add_shape=on_device(residuals.add_shape, np=MATH, corner=_corner, off_middle=_off_middle),
    add_noise=on_device(residuals.add_noise, np=MATH, in_registers=_in_registers),
    clear=on_device(residuals.clear),
    place_rays=on_device(
        residuals.place_rays, np=MATH, in_registers=_in_registers, corner=_corner, place=_place
    ),
    keep_crossing=on_device(residuals.keep_crossing),
    weigh_columns=on_device(residuals.weigh_columns, np=MATH),
    differentiate=on_device(residuals.differentiate, np=MATH),
    sum_of=on_device(residuals.sum_of, LANES=1, load=load, add=add, total=total),
)
_weight_of_each = on_device(weight_of_each)
_add_prior_cost = on_device(add_prior_cost)
_add_priors = on_device(add_priors, add_turn=on_device(add_turn))
_invert_column = on_device(
    invert_column, substitute=on_device(substitute), substitute_back=on_device(substitute_back)
)
_move = on_device(move, np=MATH)
_is_trusted = on_device(is_trusted)
_pick = on_device(pick, np=MATH)


class Starts(NamedTuple):
    """What the starts of all heads came to: rows of (frames * heads, starts); the first start is what is expected."""

    costs: Any
    """(.., starts) after the coarse steps; infinite where a start was not tried"""
    coarse: Any
    """(.., starts, STATE)"""
    fine: Any
    """(.., starts, STATE)"""
    told: Any
    """(.., starts, TOLD)"""


class Scratch(NamedTuple):
    """The working memory of each block: rows of (blocks, .., COLUMNS), see :func:`headvox.pose.residuals.weigh`."""

    J: Any
    words: Any


@device
def factor(A, size, thread, threads):
    """Leave U in the upper half of A, A = Uᵀ U, and what solves Uᵀ x = (column RESIDUAL) in that column.

    All threads of a block call this: as :func:`headvox.machine.cholesky.factor`, a row at a time.
    """
    for i in range(size):
        wait_for_block()
        if thread == 0:
            v = A[i, i]
            for q in range(i):
                v -= A[q, i] * A[q, i]
            A[i, i] = MATH.sqrt(max(v, LEAST_PIVOT))
        wait_for_block()
        for j in range(i + 1 + thread, size + 1, threads):
            column = j if j < size else RESIDUAL
            v = A[i, column]
            for q in range(i):
                v -= A[q, i] * A[q, column]
            A[i, column] = v / A[i, i]
    wait_for_block()


@device
def solve_back(A, size, x):
    """Write the step to ``x``, and return half the logarithm of the determinant."""
    half_log_det = 0.0
    for i in range(size - 1, -1, -1):
        v = -A[i, RESIDUAL]
        for q in range(i + 1, size):
            v -= A[i, q] * x[q]
        x[i] = v / A[i, i]
        half_log_det += MATH.log(A[i, i])
    return half_log_det


@device
def accumulate(J, count, size, A, thread, threads):
    """Set the upper half of A to J Jᵀ over ``count`` columns, and its last column to J e: an entry a thread."""
    entries = size * (size + 1) // 2 + size
    for entry in range(thread, entries, threads):
        i, left = 0, entry
        while left >= size + 1 - i:
            left -= size + 1 - i
            i += 1
        j = i + left if i + left < size else RESIDUAL
        product_sum = 0.0
        for s in range(count):
            product_sum += J[i, s] * J[j, s]
        A[i, j] = product_sum
    wait_for_block()


@device
def linearise(
    points, first, n, rays, m, modes, k, upright, template, state, J, words, A, told, costs, thread, threads
):
    """As :func:`headvox.pose.align.linearise`, by all threads of a block, of ``n`` points from the ``first`` on."""
    a, b = share_of(n, thread, threads)
    c, d = share_of(m, thread, threads)
    mine = J[:, a + c : b + d]
    cost, count = _weigh(
        points[:, first + a : first + b], b - a, _weight_of_each(n), rays[:, c:d], d - c, modes, k, True, template,
        state, mine, words[:, a + c : b + d], told[thread],
    )  # fmt: skip
    for i in range(PARAMETERS + 1):
        for s in range(count, b + d - a - c):
            mine[i, s] = 0.0
    costs[thread, 0] = cost
    sum_rows(costs, thread, threads)
    sum_rows(told, thread, threads)
    accumulate(J, n + m, 7 + modes, A, thread, threads)
    if thread == 0:
        _add_priors(state, modes, upright, A)
    return 0.5 * _add_prior_cost(costs[0, 0], state, modes, upright)


@kernel
def fit_starts(counts, near, points, passing, turns, upright, anyhow, template, scratch, starts):
    """Fit each start of each head: coarsely, but for the expected one, then to the end."""
    told = cuda.shared.array((MOST_THREADS, TOLD), np.float64)
    costs = cuda.shared.array((MOST_THREADS, 1), np.float64)
    A = cuda.shared.array((PARAMETERS, SYSTEM), np.float64)
    state = cuda.shared.array(STATE, np.float64)
    x = cuda.shared.array(PARAMETERS, np.float64)
    frame, thread, threads = cuda.blockIdx.y, cuda.threadIdx.x, cuda.blockDim.x
    block = frame * cuda.gridDim.x + cuda.blockIdx.x
    J, words = scratch.J[block], scratch.words[block]
    each = starts.costs.shape[1]
    heads = min(counts[frame, HEADS], MOST_POSES)
    for job in range(cuda.blockIdx.x, heads * each, cuda.gridDim.x):
        head, start = job // each, job % each
        at_head = frame * MOST_POSES + head
        n, m = near[frame, head, SAMPLES], near[frame, head, RAYS]
        stands = not near[frame, head, ROUND]
        there = upright.shape[0] if stands else anyhow.shape[0]
        tries = n >= LEAST_SAMPLES and start <= there
        if start == 0:
            tries = tries and MATH.isfinite(turns[at_head, 0])
        if thread == 0:
            starts.costs[at_head, start] = 0.0 if tries else MATH.inf
        if not tries:
            continue
        for k in range(thread, STATE, threads):
            state[k] = 0.0
            if 3 <= k < 12:
                state[k] = turns[at_head, k - 3]
                if start > 0:
                    state[k] = upright[start - 1, k - 3] if stands else anyhow[start - 1, k - 3]
        cuda.syncthreads()
        n_coarse, n_fine, m = min(n, COARSE_SAMPLES), min(n, FINE_SAMPLES), min(m, FINE_RAYS)
        for step in range(COARSE_STEPS + 1 if start > 0 and there > 1 else 0):
            cost = linearise(
                points[at_head], FINE_SAMPLES, n_coarse, passing[at_head], 0, COARSE_MODES,
                COARSE_K - min(step, COARSE_STEPS - 1), stands, template, state, J, words, A, told, costs, thread,
                threads,
            )  # fmt: skip
            if step < COARSE_STEPS:
                factor(A, 7 + COARSE_MODES, thread, threads)
                if thread == 0:
                    solve_back(A, 7 + COARSE_MODES, x)
                    _move(state, x, 7 + COARSE_MODES)
            elif thread == 0:
                starts.costs[at_head, start] = cost
            cuda.syncthreads()
        for k in range(thread, STATE, threads):
            starts.coarse[at_head, start, k] = state[k]
        cuda.syncthreads()
        for step in range(FINE_STEPS + 1):
            scale = FINE_K + (LAST_K - FINE_K) * min(step, FINE_STEPS - 1) / (FINE_STEPS - 1)
            cost = linearise(
                points[at_head], 0, n_fine, passing[at_head], m, FINE_MODES, scale, stands, template, state, J, words,
                A, told, costs, thread, threads,
            )  # fmt: skip
            factor(A, 7 + FINE_MODES, thread, threads)
            if thread == 0:
                half_log_det = solve_back(A, 7 + FINE_MODES, x)
                if step < FINE_STEPS:
                    _move(state, x, 7 + FINE_MODES)
                else:
                    for k in range(TOLD):
                        starts.told[at_head, start, k] = told[0, k]
                    starts.told[at_head, start, EVIDENCE] = cost + half_log_det
            cuda.syncthreads()
        for k in range(thread, STATE, threads):
            starts.fine[at_head, start, k] = state[k]
        cuda.syncthreads()


@device
def choose_refined(costs, coarse, fine, told, points, count, picked, refined):
    """Copy what :func:`headvox.pose.trials.search` would refine of ``count`` starts to ``refined``; return how many.

    ``points`` is how many they were fitted to. All starts are refined; the first is what is expected, if anything is.
    ``picked`` is working memory.
    """
    tried = 0
    if costs[0] < MATH.inf:
        for j in range(STATE):
            picked[0, j] = fine[0, j]
        take(fine, told, 0, refined, 0)
        if _is_trusted(told[0], points):
            return 1
        tried = 1
    least = MATH.inf
    for i in range(1, count + 1):
        least = min(least, costs[i])
    while tried < MOST_REFINED:
        best = _pick(costs[1:], count, least, coarse[1:], picked, tried)
        if best < 0:
            break
        for j in range(STATE):
            picked[tried, j] = coarse[1 + best, j]
        take(fine, told, 1 + best, refined, tried)
        tried += 1
    return tried


@device
def take(fine, told, start, refined, at):
    """Copy what a start came to to the row ``at`` of ``refined``."""
    for j in range(STATE):
        refined.states[at, j] = fine[start, j]
    for j in range(TOLD):
        refined.told[at, j] = told[start, j]


_quaternion_of = on_device(quaternion_of, np=MATH)
_turn_between = on_device(turn_between, np=MATH, quaternion_of=_quaternion_of, column=on_device(column))
_settle = on_device(
    settle, np=MATH, quaternion_of=_quaternion_of, turn_between=_turn_between, odds=on_device(odds, np=MATH)
)
_assess = on_device(assess)
_recentre = on_device(recentre, np=MATH)
_best_of = on_device(best_of, np=MATH)


@kernel
def settle_heads(
    counts,
    near,
    heads,
    spheres,
    points,
    passing,
    upright,
    anyhow,
    template,
    scratch,
    starts,
    picked,
    chosen,
    poses,
):
    """Choose the best state of each head, polish it, and write it to ``poses``; a block a head.

    ``chosen`` are the states that are asked for, a row a head, and ``picked`` what they were when they were chosen.
    """
    told = cuda.shared.array((MOST_THREADS, TOLD), np.float64)
    costs = cuda.shared.array((MOST_THREADS, 1), np.float64)
    A = cuda.shared.array((PARAMETERS, SYSTEM), np.float64)
    x = cuda.shared.array((6, PARAMETERS), np.float64)
    found = cuda.shared.array(2, np.int64)
    frame, thread, threads = cuda.blockIdx.y, cuda.threadIdx.x, cuda.blockDim.x
    block = frame * cuda.gridDim.x + cuda.blockIdx.x
    J, words = scratch.J[block], scratch.words[block]
    for head in range(cuda.blockIdx.x, min(counts[frame, HEADS], MOST_POSES), cuda.gridDim.x):
        i = frame * MOST_POSES + head
        centre, n, m = spheres[frame, heads[frame, head]], near[frame, head, SAMPLES], near[frame, head, RAYS]
        stands = not near[frame, head, ROUND]
        refined = Refined(chosen.states[i], chosen.told[i], chosen.covariance[i])
        if thread == 0:
            clear_pose(poses, i, centre)
            found[0] = 0
            if n >= LEAST_SAMPLES:
                found[0] = choose_refined(
                    starts.costs[i], starts.coarse[i], starts.fine[i], starts.told[i], min(n, FINE_SAMPLES),
                    upright.shape[0] if stands else anyhow.shape[0], picked[i], refined,
                )  # fmt: skip
            found[1] = _best_of(refined.told, found[0])
        cuda.syncthreads()
        best = found[1]
        if best >= 0:
            state = refined.states[best]
            more, passes = min(n, POLISH_SAMPLES), min(m, POLISH_RAYS)
            for step in range(POLISH_STEPS + 1):
                linearise(
                    points[i], FINE_SAMPLES + COARSE_SAMPLES, more, passing[i, :, FINE_RAYS:], passes, MODES, LAST_K,
                    stands, template, state, J, words, A, told, costs, thread, threads,
                )  # fmt: skip
                factor(A, PARAMETERS, thread, threads)
                if thread == 0:
                    solve_back(A, PARAMETERS, x[0])
                    if step < POLISH_STEPS:
                        _move(state, x[0], PARAMETERS)
                cuda.syncthreads()
            for column_of in range(thread, 6, threads):
                _invert_column(A, x[column_of], column_of)
                for k in range(6):
                    refined.covariance[k, column_of] = x[column_of, k]
            cuda.syncthreads()
            if thread == 0:
                for k in range(EVIDENCE):
                    refined.told[best, k] = told[0, k]
                _assess(refined.told[best], more, passes, poses, i)
                _settle(refined, found[0], best, centre, template, poses, i)
                if not stands:
                    _recentre(state, template, poses, i)
        cuda.syncthreads()


@device
def clear_pose(poses, i, centre):
    """Say of head ``i`` that nothing is known but its ``centre``."""
    poses.radii[i] = poses.misfits[i] = poses.coverages[i] = poses.crossings[i] = MATH.nan
    for k in range(4):
        poses.quaternions[i, k] = MATH.nan
    for a in range(3):
        poses.centres[i, a] = centre[a]
        for b in range(3):
            poses.centre_covariances[i, a, b] = poses.rotation_covariances[i, a, b] = MATH.nan
