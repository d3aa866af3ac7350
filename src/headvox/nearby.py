"""What the sensors measured near a candidate: surface points, and rays that pass by it.

Nothing is unprojected that does not belong to the candidate: of a depth image only the window that a ball about it
covers is read, every so many pixels. Coordinates are metres from the candidate, world axes.
"""

from __future__ import annotations

import numpy as np

from headvox.data import F64, Frame
from headvox.kernels import kernel, rule

REACH_M = 0.25
MOST_SAMPLES = 8192  # of one candidate, shared by all sensors
MOST_PIXELS = 4096  # of one image that are looked at for a candidate
MOST_VISITS = 1 << 17  # points of one cloud that are looked at for a candidate
SAMPLE = 8  # x y z, the unit ray from the sensor, sigma along the ray, sigma across
RAY = 6  # its point nearest to the candidate, its direction
PIXEL_SIGMA = 0.7  # a contour wanders by so many pixels
DEPTH_SIGMA_M = 0.0015  # at the sensor, and
DEPTH_SIGMA_PER_M = 0.0036  # times the distance squared: a D435i
CLOUD_FOCAL_PX = 450.0  # of the camera that a cloud is taken to come from
UNKNOWN_SIGMA_M = 0.002  # of points whose sensor nobody knows


@rule
def _view(T, x, y, z, length, out, at):  # type: ignore[no-untyped-def]
    """Write the unit direction of the sensor's ray x, y, z to out[at, 3:6]."""
    out[at, 3] = (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z) / length
    out[at, 4] = (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z) / length
    out[at, 5] = (T[2, 0] * x + T[2, 1] * y + T[2, 2] * z) / length


@rule
def _place(T, along, out, at):  # type: ignore[no-untyped-def]
    """Write the point ``along`` metres on the ray of out[at, 3:6] to out[at, :3]."""
    for i in range(3):
        out[at, i] = out[at, 3 + i] * along + T[i, 3]


@rule
def _thin(buffer, first, end):  # type: ignore[no-untyped-def]
    """Keep every second row of buffer[first:end]; return the new end."""
    kept = (end - first + 1) // 2
    for i in range(kept):
        for j in range(buffer.shape[1]):
            buffer[first + i, j] = buffer[first + 2 * i, j]
    return first + kept


@rule
def _window(middle, depth, reach, focal, centre, size):  # type: ignore[no-untyped-def]
    """Return the first and the last-but-one pixel, along one axis of an image, that a ball covers."""
    near, far = depth - reach, depth + reach
    if near < 0.05:
        return 0, size
    low, high = middle - reach, middle + reach
    first = min(low / near, low / far) * focal + centre
    last = max(high / near, high / far) * focal + centre
    return int(min(max(first, 0.0), size)), int(min(max(last + 2.0, 0.0), size))


@kernel
def gather_depth(depth, lens, T, reach, limit, samples, rays, counts):  # type: ignore[no-untyped-def]
    """Add what one depth image shows near the origin of the frame that ``T`` (3, 4) maps the camera to.

    ``lens`` holds fx, fy, cx, cy and the depth scale. Points within ``reach`` go to ``samples``, rays that pass
    within ``reach`` and end behind it to ``rays``; ``counts`` (2,) says how many there are of each, ``limit`` (2,)
    how many there may be.
    """
    fx, fy, cx, cy, scale = lens[0], lens[1], lens[2], lens[3], lens[4]
    # the origin in the camera's frame
    ox = -(T[0, 0] * T[0, 3] + T[1, 0] * T[1, 3] + T[2, 0] * T[2, 3])
    oy = -(T[0, 1] * T[0, 3] + T[1, 1] * T[1, 3] + T[2, 1] * T[2, 3])
    oz = -(T[0, 2] * T[0, 3] + T[1, 2] * T[1, 3] + T[2, 2] * T[2, 3])
    if oz < -reach:
        return
    u0, u1 = _window(ox, oz, reach, fx, cx, depth.shape[1])
    v0, v1 = _window(oy, oz, reach, fy, cy, depth.shape[0])
    most = max(1, min(MOST_PIXELS, limit[0] - counts[0]))
    stride = 1
    while ((u1 - u0 + stride - 1) // stride) * ((v1 - v0 + stride - 1) // stride) > most:
        stride += 1
    n, m = counts[0], counts[1]
    reach2, distance2 = reach * reach, ox * ox + oy * oy + oz * oz
    for v in range(v0, v1, stride):
        y = (v - cy) / fy
        for u in range(u0, u1, stride):
            raw = depth[v, u]
            if raw == 0:
                continue
            x = (u - cx) / fx
            z = raw * scale
            length = np.sqrt(x * x + y * y + 1.0)
            dx, dy, dz = x * z - ox, y * z - oy, z - oz
            if dx * dx + dy * dy + dz * dz < reach2:
                if n < limit[0]:
                    _view(T, x, y, 1.0, length, samples, n)
                    _place(T, z * length, samples, n)
                    samples[n, 6] = DEPTH_SIGMA_M + DEPTH_SIGMA_PER_M * z * z
                    samples[n, 7] = PIXEL_SIGMA * z / fx
                    n += 1
                continue
            along = (x * ox + y * oy + oz) / length  # where the ray is nearest to the origin
            if distance2 - along * along < reach2 and 0.0 < along < z * length and m < limit[1]:
                _view(T, x, y, 1.0, length, rays, m)
                _place(T, along, rays, m)
                m += 1
    counts[0], counts[1] = n, m


@kernel
def gather_points(points, T, knows, reach, limit, samples, rays, counts):  # type: ignore[no-untyped-def]
    """Add what a cloud shows; ``T`` (3, 4) maps its frame, ``knows`` says whether the sensor is at its origin.

    When there is more than ``limit`` lets through, every second one is kept, so the rest stays evenly spread.
    """
    ox, oy, oz = T[0, 3], T[1, 3], T[2, 3]
    reach2, distance2 = reach * reach, ox * ox + oy * oy + oz * oz
    first_n, first_m = counts[0], counts[1]
    n, m = first_n, first_m
    hits, passes, every_hit, every_pass = 0, 0, 1, 1
    for i in range(0, points.shape[0], max(1, (points.shape[0] + MOST_VISITS - 1) // MOST_VISITS)):
        px, py, pz = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz
        squared = x * x + y * y + z * z
        wx, wy, wz = x + ox, y + oy, z + oz
        if wx * wx + wy * wy + wz * wz < reach2:
            hits += 1
            if hits % every_hit == 0:
                if n == limit[0]:
                    n = _thin(samples, first_n, n)
                    every_hit *= 2
                samples[n, 0], samples[n, 1], samples[n, 2] = wx, wy, wz
                samples[n, 3], samples[n, 4], samples[n, 5] = 0.0, 0.0, 0.0
                samples[n, 6], samples[n, 7] = 0.0, UNKNOWN_SIGMA_M
                if knows:
                    length = max(np.sqrt(squared), 1e-6)
                    samples[n, 3], samples[n, 4], samples[n, 5] = x / length, y / length, z / length
                    samples[n, 6] = DEPTH_SIGMA_M + DEPTH_SIGMA_PER_M * squared
                    samples[n, 7] = PIXEL_SIGMA * length / CLOUD_FOCAL_PX
                n += 1
            continue
        along = -(x * ox + y * oy + z * oz)  # times the ray's length: where it is nearest to the origin
        if knows and 0.0 < along < squared and distance2 - along * along / squared < reach2:
            passes += 1
            if passes % every_pass == 0:
                if m == limit[1]:
                    m = _thin(rays, first_m, m)
                    every_pass *= 2
                length = np.sqrt(squared)
                rays[m, 3], rays[m, 4], rays[m, 5] = x / length, y / length, z / length
                _place(T, along / length, rays, m)
                m += 1
    counts[0], counts[1] = n, m


def gather(frame: Frame, centre: F64, samples: F64, rays: F64) -> tuple[int, int]:
    """Fill ``samples`` (S, SAMPLE) and ``rays`` (R, RAY) with what ``frame`` shows near ``centre`` (3,), metres.

    Returns how many of each there are. Every sensor has the same share of the room.
    """
    counts, room = np.zeros(2, np.int64), np.array([len(samples), len(rays)])
    left = len(frame.depths) + len(frame.clouds)
    for image in frame.depths:
        c = image.intrinsics
        lens = np.array([c.fx, c.fy, c.cx, c.cy, c.depth_scale])
        T, limit = _placed(image.T_world_camera, centre), counts + (room - counts) // left
        gather_depth(image.depth, lens, T, REACH_M, limit, samples, rays, counts)
        left -= 1
    for cloud in frame.clouds:
        knows = cloud.T_world_sensor is not None
        T = _placed(np.eye(4) if cloud.T_world_sensor is None else cloud.T_world_sensor, centre)
        limit = counts + (room - counts) // left
        gather_points(cloud.points, T, knows, REACH_M, limit, samples, rays, counts)
        left -= 1
    return int(counts[0]), int(counts[1])


def _placed(T_world_sensor: F64, centre: F64) -> F64:
    """Return (3, 4) float64 that maps the sensor's coordinates to metres from ``centre``."""
    T = np.array(T_world_sensor[:3], dtype=np.float64)
    T[:, 3] -= centre
    return T
