"""What the sensors measured near a candidate: surface points, and rays that pass by it.

Nothing is unprojected that does not belong to the candidate: of a depth image only the window that a ball about it
covers is read, every so many pixels. Coordinates are metres from the candidate, world axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from headvox.data import F64, DepthImage, Frame
from headvox.machine.kernels import bare_kernel, read_only, rule
from headvox.machine.simd import LANES, add, below, fill, load_triples, lowest, mul, sub

REACH_M = 0.25  # of points, and
PASSING_M = 0.17  # of rays: farther away is nothing of a head that they could cross
MOST_SAMPLES = 8192  # of one candidate, shared by all sensors
MOST_PIXELS = 4096  # of one image that are looked at for a candidate
MOST_VISITS = 1 << 17  # points of one cloud that are looked at for a candidate
SAMPLE = 8  # x y z, the unit ray from the sensor, sigma along the ray, sigma across
FAR, NEAR, PASSES = 0, 1, 2  # what a reading is to a candidate
RAY = 6  # its point nearest to the candidate, its direction
PIXEL_SIGMA = 0.7  # a contour wanders by so many pixels
DEPTH_SIGMA_M = 0.0015  # at the sensor, and
DEPTH_SIGMA_PER_M = 0.0036  # times the distance squared: a D435i
CLOUD_FOCAL_PX = 450.0  # of the camera that a cloud is taken to come from
TINY = 1e-12  # m⁴: a point at the sensor is looked at, whatever its direction
UNKNOWN_SIGMA_M = 0.002  # of points whose sensor nobody knows


@rule
def view(T, x, y, z, length, out, at):
    """Write the unit direction of the sensor's ray x, y, z to out[at, 3:6]."""
    out[at, 3] = (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z) / length
    out[at, 4] = (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z) / length
    out[at, 5] = (T[2, 0] * x + T[2, 1] * y + T[2, 2] * z) / length


@rule
def place(T, along, out, at):
    """Write the point ``along`` metres on the ray of out[at, 3:6] to out[at, :3]."""
    for i in range(3):
        out[at, i] = out[at, 3 + i] * along + T[i, 3]


@rule
def _thin(buffer, first, end):
    """Keep every second row of buffer[first:end]; return the new end."""
    kept = (end - first + 1) // 2
    for i in range(kept):
        for j in range(buffer.shape[1]):
            buffer[first + i, j] = buffer[first + 2 * i, j]
    return first + kept


@rule
def window(middle, depth, reach, focal, centre, size):
    """Return the first and the last-but-one pixel, along one axis of an image, that a ball covers."""
    near, far = depth - reach, depth + reach
    if near < 0.05:
        return 0, size
    low, high = middle - reach, middle + reach
    first = min(low / near, low / far) * focal + centre
    last = max(high / near, high / far) * focal + centre
    return int(min(max(first, 0.0), size)), int(min(max(last + 2.0, 0.0), size))


@rule
def window_of(lens, T, reach, height, width, most):
    """Return the origin's place in the camera's frame, and which columns and rows of an image to look at, and how many.

    ``most`` pixels are looked at: every ``stride``-th of columns u0 to u1 and rows v0 to v1.
    """
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    ox = -(T[0, 0] * T[0, 3] + T[1, 0] * T[1, 3] + T[2, 0] * T[2, 3])
    oy = -(T[0, 1] * T[0, 3] + T[1, 1] * T[1, 3] + T[2, 1] * T[2, 3])
    oz = -(T[0, 2] * T[0, 3] + T[1, 2] * T[1, 3] + T[2, 2] * T[2, 3])
    u0, u1 = window(ox, oz, reach, fx, cx, width)
    v0, v1 = window(oy, oz, reach, fy, cy, height)
    if oz < -reach:
        u1, v1 = u0, v0
    stride = 1
    while ((u1 - u0 + stride - 1) // stride) * ((v1 - v0 + stride - 1) // stride) > max(1, most):
        stride += 1
    return (ox, oy, oz), u0, u1, v0, v1, stride


@rule
def look_at_pixel(raw, u, v, lens, origin, reach):
    """Return what a pixel shows, the x and y of its ray (z is 1) and its depth, the ray's length, and where along it.

    It is where the ray is nearest to the origin.
    """
    if raw == 0:
        return FAR, 0.0, 0.0, 0.0, 1.0, 0.0
    ox, oy, oz = origin
    x = (u - lens[2]) / lens[0]
    y = (v - lens[3]) / lens[1]
    z = raw * lens[4]
    length = np.sqrt(x * x + y * y + 1.0)
    dx, dy, dz = x * z - ox, y * z - oy, z - oz
    if dx * dx + dy * dy + dz * dz < reach * reach:
        return NEAR, x, y, z, length, 0.0
    along = (x * ox + y * oy + oz) / length
    distance2 = ox * ox + oy * oy + oz * oz
    passes = distance2 - along * along < PASSING_M * PASSING_M and 0.0 < along < z * length
    return PASSES if passes else FAR, x, y, z, length, along


@rule
def keep_pixel(T, x, y, z, length, lens, samples, n):
    """Write what :func:`look_at_pixel` told of a pixel to samples[n]."""
    view(T, x, y, 1.0, length, samples, n)
    place(T, z * length, samples, n)
    samples[n, 6] = DEPTH_SIGMA_M + DEPTH_SIGMA_PER_M * z * z
    samples[n, 7] = PIXEL_SIGMA * z / lens[0]


@bare_kernel
def gather_depth(depth, lens, T, reach, n, m, most_n, most_m, samples, rays):
    """Add what one depth image shows near the origin of the frame that ``T`` (3, 4) maps the camera to.

    ``lens`` holds fx, fy, cx, cy and the depth scale. Points within ``reach`` go to ``samples``, rays that pass within
    ``PASSING_M`` and end behind it to ``rays``, after the ``n`` and ``m`` that are there; there may be ``most_n`` and
    ``most_m``. Returned is how many there are then.
    """
    most = min(MOST_PIXELS, most_n - n)
    origin, u0, u1, v0, v1, stride = window_of(lens, T, reach, depth.shape[0], depth.shape[1], most)
    for v in range(v0, v1, stride):
        for u in range(u0, u1, stride):
            kind, x, y, z, length, along = look_at_pixel(depth[v, u], u, v, lens, origin, reach)
            if kind == NEAR and n < most_n:
                keep_pixel(T, x, y, z, length, lens, samples, n)
                n += 1
            elif kind == PASSES and m < most_m:
                view(T, x, y, 1.0, length, rays, m)
                place(T, along, rays, m)
                m += 1
    return n, m


@rule
def _ball(T, reach):
    """Return, for :func:`_may_be_near`, the origin's place in the sensor's frame, and two bounds (m²).

    They are wide enough for what rounding to float32 and a transform that is not quite rigid may change.
    """
    x = -(T[0, 0] * T[0, 3] + T[1, 0] * T[1, 3] + T[2, 0] * T[2, 3])
    y = -(T[0, 1] * T[0, 3] + T[1, 1] * T[1, 3] + T[2, 1] * T[2, 3])
    z = -(T[0, 2] * T[0, 3] + T[1, 2] * T[1, 3] + T[2, 2] * T[2, 3])
    squared = x * x + y * y + z * z
    wide = reach + 0.02 + 0.005 * np.sqrt(squared)
    wide2 = wide * wide
    return np.float32(x), np.float32(y), np.float32(z), np.float32(wide2), np.float32(squared - wide2)


@rule
def _may_be_near(flat, at, ball, knows):
    """Return a bit for each of the LANES points from ``flat[at]`` on: 0 for what is neither near nor passes near.

    Without a sensor that is what lies outside of a ball, and with one whose ray misses it: d² < r², where the square of
    the distance d of the ball's centre c from the ray through p is c² - (c·p)² / p².
    """
    cx, cy, cz, wide2, rest = ball
    px, py, pz = load_triples(flat, at)
    if knows:
        along = add(add(mul(px, fill(cx)), mul(py, fill(cy))), mul(pz, fill(cz)))
        squared = add(add(mul(px, px), mul(py, py)), mul(pz, pz))
        return below(sub(mul(squared, fill(rest)), fill(np.float32(TINY))), mul(along, along))
    dx, dy, dz = sub(px, fill(cx)), sub(py, fill(cy)), sub(pz, fill(cz))
    return below(add(add(mul(dx, dx), mul(dy, dy)), mul(dz, dz)), fill(wide2))


@rule
def look_at_point(px, py, pz, T, knows, reach):
    """Return what a point shows, its turned coordinates, the square of its distance from the sensor, and where along.

    It is where its ray is nearest to the origin, times the ray's length.
    """
    x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz
    y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz
    z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz
    ox, oy, oz = T[0, 3], T[1, 3], T[2, 3]
    squared = x * x + y * y + z * z
    wx, wy, wz = x + ox, y + oy, z + oz
    if wx * wx + wy * wy + wz * wz < reach * reach:
        return NEAR, x, y, z, squared, 0.0
    along = -(x * ox + y * oy + z * oz)
    distance2 = ox * ox + oy * oy + oz * oz
    if knows and 0.0 < along < squared and distance2 - along * along / squared < PASSING_M * PASSING_M:
        return PASSES, x, y, z, squared, along
    return FAR, x, y, z, squared, along


@rule
def keep_point(T, x, y, z, squared, knows, samples, n):
    """Write what :func:`look_at_point` told of a point that is near to samples[n]."""
    samples[n, 0], samples[n, 1], samples[n, 2] = x + T[0, 3], y + T[1, 3], z + T[2, 3]
    samples[n, 3], samples[n, 4], samples[n, 5] = 0.0, 0.0, 0.0
    samples[n, 6], samples[n, 7] = 0.0, UNKNOWN_SIGMA_M
    if knows:
        length = max(np.sqrt(squared), 1e-6)
        samples[n, 3], samples[n, 4], samples[n, 5] = x / length, y / length, z / length
        samples[n, 6] = DEPTH_SIGMA_M + DEPTH_SIGMA_PER_M * squared
        samples[n, 7] = PIXEL_SIGMA * length / CLOUD_FOCAL_PX


@rule
def keep_passing(T, x, y, z, squared, along, rays, m):
    """Write what :func:`look_at_point` told of a point whose ray passes by to rays[m]."""
    length = np.sqrt(squared)
    rays[m, 3], rays[m, 4], rays[m, 5] = x / length, y / length, z / length
    place(T, along / length, rays, m)


@bare_kernel
def gather_points(points, T, knows, reach, n, m, most_n, most_m, samples, rays):
    """Add what a cloud shows; ``T`` (3, 4) maps its frame, ``knows`` says whether the sensor is at its origin.

    When there is more than ``most_n`` or ``most_m``, every second one is kept, so the rest stays evenly spread.
    """
    first_n, first_m = n, m
    hits, passes, every_hit, every_pass = 0, 0, 1, 1
    step = max(1, (points.shape[0] + MOST_VISITS - 1) // MOST_VISITS)
    flat = points.reshape(-1)
    ball = _ball(T, reach)
    for first in range(0, points.shape[0], LANES):
        bits = np.uint32(0xFFFFFFFF)
        if first + LANES <= points.shape[0]:
            bits = _may_be_near(flat, 3 * first, ball, knows)
        while bits:
            i = first + lowest(bits)
            bits &= bits - np.uint32(1)
            if i % step or i >= points.shape[0]:
                continue
            px, py, pz = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
            kind, x, y, z, squared, along = look_at_point(px, py, pz, T, knows, reach)
            if kind == NEAR:
                hits += 1
                if hits % every_hit == 0:
                    if n == most_n:
                        n = _thin(samples, first_n, n)
                        every_hit *= 2
                    keep_point(T, x, y, z, squared, knows, samples, n)
                    n += 1
            elif kind == PASSES:
                passes += 1
                if passes % every_pass == 0:
                    if m == most_m:
                        m = _thin(rays, first_m, m)
                        every_pass *= 2
                    keep_passing(T, x, y, z, squared, along, rays, m)
                    m += 1
    return n, m


class Sensor(NamedTuple):
    """A depth image or a cloud of a frame as the loops read it."""

    readings: npt.NDArray[Any]
    """(height, width) uint16 of an image, (N, 3) float32 of a cloud; read only"""
    T: F64
    """(3, 4), maps the sensor's coordinates to the world"""
    lens: F64 | None
    """fx, fy, cx, cy and the depth scale; None of a cloud"""
    knows: bool
    """whether the sensor is at the origin of its coordinates"""


def lens_of(image: DepthImage) -> F64:
    """Return fx, fy, cx, cy and the depth scale, (5,)."""
    c = image.intrinsics
    return np.array([c.fx, c.fy, c.cx, c.cy, c.depth_scale])


def sensors_of(frame: Frame) -> list[Sensor]:
    """Return the images and the clouds of ``frame``."""
    sensors = [
        Sensor(read_only(image.depth), _rigid(image.T_world_camera), lens_of(image), True)
        for image in frame.depths
    ]
    for cloud in frame.clouds:
        knows = cloud.T_world_sensor is not None
        T = _rigid(np.eye(4) if cloud.T_world_sensor is None else cloud.T_world_sensor)
        sensors.append(Sensor(read_only(cloud.points), T, None, knows))
    return sensors


def gather(sensors: Sequence[Sensor], centre: F64, samples: F64, rays: F64) -> tuple[int, int]:
    """Fill ``samples`` (S, SAMPLE) and ``rays`` (R, RAY) with what was measured near ``centre`` (3,), world, metres.

    Returns how many of each there are. Every sensor has the same share of the room.
    """
    n = m = 0
    for left, sensor in zip(range(len(sensors), 0, -1), sensors, strict=True):
        T = sensor.T.copy()
        T[:, 3] -= centre
        most_n, most_m = n + (len(samples) - n) // left, m + (len(rays) - m) // left
        if sensor.lens is None:
            n, m = gather_points(
                sensor.readings, T, sensor.knows, REACH_M, n, m, most_n, most_m, samples, rays
            )
        else:
            n, m = gather_depth(sensor.readings, sensor.lens, T, REACH_M, n, m, most_n, most_m, samples, rays)
    return n, m


def _rigid(T_world_sensor: F64) -> F64:
    return np.ascontiguousarray(T_world_sensor[:3], dtype=np.float64)
