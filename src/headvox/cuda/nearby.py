"""What the sensors measured near each head: the same points and rays as on the CPU, in the same order.

A block gathers for a head, one sensor after the other. Its threads share out the readings twice: once to count, and
once to write each to its place, which follows from the counts before it.
"""

from __future__ import annotations

import numpy as np
from numba import cuda

from headvox.assemble import MOST_POSES
from headvox.cuda.blocks import share_of, sum_rows
from headvox.cuda.lanes import MATH, device, kernel, on_device
from headvox.cuda.readings import (
    CLOUD,
    DATA,
    EXPECTED,
    EXPECTED_AT,
    HEADER,
    HEIGHT,
    KIND,
    KNOWS,
    LENS,
    NOTHING,
    PLACE,
    SENSOR,
    SENSORS,
    WIDTH,
)
from headvox.cuda.suppress import HEADS
from headvox.pose.nearby import (
    FAR,
    MOST_PIXELS,
    MOST_SAMPLES,
    MOST_VISITS,
    NEAR,
    PASSES,
    REACH_M,
    keep_passing,
    keep_pixel,
    keep_point,
    look_at_pixel,
    look_at_point,
    place,
    view,
    window,
    window_of,
)
from headvox.pose.settle import expect_turns
from headvox.pose.trials import (
    COARSE_SAMPLES,
    FINE_RAYS,
    FINE_SAMPLES,
    LEAST_SAMPLES,
    POLISH_RAYS,
    POLISH_SAMPLES,
    ROUND_SHARE,
    evenly,
    lean,
)

MOST_THREADS = 256  # of a block; a power of two
SAMPLES, RAYS, ROUND = 0, 1, 2
"""What the columns of ``near`` (frames, heads, 3) tell: how many of each, and whether they lie all around."""

_view, _place = on_device(view, np=MATH), on_device(place, np=MATH)
_window_of = on_device(window_of, np=MATH, window=on_device(window, np=MATH))
_look_at_pixel = on_device(look_at_pixel, np=MATH)
_look_at_point = on_device(look_at_point, np=MATH)
_keep_pixel = on_device(keep_pixel, np=MATH, view=_view, place=_place)
_keep_point = on_device(keep_point, np=MATH)
_keep_passing = on_device(keep_passing, np=MATH, place=_place)
_lean = on_device(lean, np=MATH)
_evenly = on_device(evenly)
_expect_turns = on_device(expect_turns, np=MATH)


@device
def first_of_round(k, room):
    """Return the number, from 1, of the reading at which a list with so much room is thinned for the k-th time."""
    first = room + 1
    for done in range(1, k):
        first = ((first >> done) + room - (room + 1) // 2) << done
    return first


@device
def place_of(number, there, room):
    """Return where the reading of this ``number``, from 1, of all that are ``there`` is kept; -1 where it is not.

    A list with ``room`` for so many is thinned whenever it is full, and from then on takes every second of what it took
    before: see :func:`headvox.pose.nearby.gather_points`.
    """
    rounds, mine = 0, 0
    while first_of_round(rounds + 1, room) <= there:
        rounds += 1
        if first_of_round(rounds, room) <= number:
            mine = rounds
    at = number - 1
    if mine > 0:
        first = first_of_round(mine, room)
        if number != first and number & ((1 << mine) - 1):
            return -1
        at = (room + 1) // 2 + (number >> mine) - (first >> mine)
    for _ in range(mine, rounds):
        if at & 1:
            return -1
        at >>= 1
    return at


@device
def length_of(there, room):
    """Return how many of ``there`` readings are in such a list in the end."""
    rounds = 0
    while first_of_round(rounds + 1, room) <= there:
        rounds += 1
    if rounds == 0:
        return there
    return (room + 1) // 2 + 1 + (there >> rounds) - (first_of_round(rounds, room) >> rounds)


@device
def shift_to(wide, at, centre, T):
    """Write to ``T`` (3, 4) what maps a sensor's coordinates to those from ``centre`` (3,)."""
    for i in range(3):
        for j in range(4):
            T[i, j] = wide[at + 4 * i + j]
        T[i, 3] -= centre[i]


@kernel
def gather(
    whole, wide, real, half, octets, counts, heads, spheres, samples, rays, near, points, passing, turns
):
    """Fill ``samples`` (frames * heads, S, SAMPLE) and ``rays`` (frames * heads, R, RAY) with what is near each head.

    ``near`` (frames, heads, 3) tells how many there are; ``points`` (frames * heads, SAMPLE, FINE_SAMPLES +
    COARSE_SAMPLES + POLISH_SAMPLES) and ``passing`` (frames * heads, RAY, FINE_RAYS + POLISH_RAYS) receive those that
    are used, evenly of all, and ``turns`` (frames * heads, 9) the rotation that is expected of each head, or NaN.
    """
    found = cuda.shared.array((MOST_THREADS, 2), np.int32)
    around = cuda.shared.array((MOST_THREADS, 5), np.float64)
    T = cuda.local.array((3, 4), np.float64)
    frame, thread, threads = cuda.blockIdx.y, cuda.threadIdx.x, cuda.blockDim.x
    sensors = whole[frame, SENSORS]
    for head in range(cuda.blockIdx.x, min(counts[frame, HEADS], MOST_POSES), cuda.gridDim.x):
        at_head = frame * MOST_POSES + head
        centre = spheres[frame, heads[frame, head]]
        mine, passing_by = samples[at_head], rays[at_head]
        n = m = 0
        for sensor in range(sensors):
            left, at = sensors - sensor, HEADER + sensor * SENSOR
            room_n, room_m = (MOST_SAMPLES - n) // left, (MOST_SAMPLES - m) // left
            data, width, height = whole[frame, at + DATA], whole[frame, at + WIDTH], whole[frame, at + HEIGHT]
            is_cloud, knows = whole[frame, at + KIND] == CLOUD, whole[frame, at + KNOWS] != 0
            shift_to(wide[frame], (at + PLACE) // 2, centre, T)
            lens = wide[frame, (at + LENS) // 2 : (at + LENS) // 2 + 5]
            origin, u0, u1, v0, v1, stride = _window_of(
                lens, T, REACH_M, height, width, min(MOST_PIXELS, room_n)
            )
            columns = (u1 - u0 + stride - 1) // stride
            items = columns * ((v1 - v0 + stride - 1) // stride)
            step = max(1, (width + MOST_VISITS - 1) // MOST_VISITS)
            if is_cloud:
                items = (width + step - 1) // step
            if whole[frame, at + KIND] == NOTHING:
                items = 0
            first, after = share_of(items, thread, threads)
            for writes in (False, True):
                hits = passes = 0
                if writes:  # from how many those before this thread have found
                    cuda.syncthreads()
                    for other in range(thread):
                        hits += found[other, 0]
                        passes += found[other, 1]
                    all_hits = all_passes = 0
                    for other in range(threads):
                        all_hits += found[other, 0]
                        all_passes += found[other, 1]
                for item in range(first, after):
                    if is_cloud:
                        begin = data + 3 * step * item
                        px, py = np.float64(real[frame, begin]), np.float64(real[frame, begin + 1])
                        pz = np.float64(real[frame, begin + 2])
                        kind, x, y, z, squared, along = _look_at_point(px, py, pz, T, knows, REACH_M)
                        length = squared
                    else:
                        u, v = u0 + item % columns * stride, v0 + item // columns * stride
                        kind, x, y, z, length, along = _look_at_pixel(
                            half[frame, data + v * width + u], u, v, lens, origin, REACH_M
                        )
                    if kind == FAR:
                        continue
                    hits += kind == NEAR
                    passes += kind == PASSES
                    if not writes:
                        continue
                    if kind == NEAR:
                        row = place_of(hits, all_hits, room_n) if is_cloud else hits - 1
                        if 0 <= row < room_n and is_cloud:
                            _keep_point(T, x, y, z, length, knows, mine, n + row)
                        elif 0 <= row < room_n:
                            _keep_pixel(T, x, y, z, length, lens, mine, n + row)
                    else:
                        row = place_of(passes, all_passes, room_m) if is_cloud else passes - 1
                        if 0 <= row < room_m and is_cloud:
                            _keep_passing(T, x, y, z, length, along, passing_by, m + row)
                        elif 0 <= row < room_m:
                            _view(T, x, y, 1.0, length, passing_by, m + row)
                            _place(T, along, passing_by, m + row)
                if not writes:
                    found[thread, 0], found[thread, 1] = hits, passes
            cuda.syncthreads()
            n += length_of(all_hits, room_n) if is_cloud else min(all_hits, room_n)
            m += length_of(all_passes, room_m) if is_cloud else min(all_passes, room_m)
        copy_evenly(mine, n, FINE_SAMPLES, points[at_head], 0)
        copy_evenly(mine, n, COARSE_SAMPLES, points[at_head], FINE_SAMPLES)
        copy_evenly(mine, n, POLISH_SAMPLES, points[at_head], FINE_SAMPLES + COARSE_SAMPLES)
        copy_evenly(passing_by, m, FINE_RAYS, passing[at_head], 0)
        copy_evenly(passing_by, m, POLISH_RAYS, passing[at_head], FINE_RAYS)
        first, after = share_of(n, thread, threads)
        seen, close, x, y, z = _lean(mine, first, after)
        around[thread, 0], around[thread, 1] = seen, close
        around[thread, 2], around[thread, 3], around[thread, 4] = x, y, z
        sum_rows(around, thread, threads)
        if thread == 0:
            close, length = around[0, 1], 0.0
            for k in range(2, 5):
                length += around[0, k] * around[0, k]
            near[frame, head, SAMPLES], near[frame, head, RAYS] = n, m
            near[frame, head, ROUND] = (
                around[0, 0] == 0.0 and close >= LEAST_SAMPLES and MATH.sqrt(length) < ROUND_SHARE * close
            )
            for k in range(9):
                turns[at_head, k] = MATH.nan
            e = whole[frame, EXPECTED_AT]
            known = octets[frame, e : e + whole[frame, EXPECTED]]
            _expect_turns(
                spheres[frame, heads[frame, head] : heads[frame, head] + 1, :3],
                known[:, :3],
                known[:, 3:7],
                known[:, 7],
                turns[at_head : at_head + 1],
            )
        cuda.syncthreads()


@device
def copy_evenly(source, there, most, target, first):
    """Copy at most ``most`` of the rows that are ``there`` to the columns of ``target`` from ``first`` on."""
    used = min(there, most)
    for s in range(cuda.threadIdx.x, used, cuda.blockDim.x):
        at = _evenly(s, used, there)
        for j in range(source.shape[1]):
            target[j, first + s] = source[at, j]
