"""Slow, obvious twins of the loops of the pose fit: one NumPy line a formula."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from headvox.data import Frame
from headvox.pose import align, nearby, residuals, trials
from headvox.pose import settle as settling
from headvox.pose import template as template_of


def gather(frame: Frame, centre, reach=nearby.REACH_M):
    """All points and passing rays of depth images whose windows need no stride, and of small clouds."""
    samples, rays = [], []
    for image in frame.depths:
        c, T = image.intrinsics, image.T_world_camera
        for v, u in np.argwhere(image.depth > 0):
            z = image.depth[v, u] * c.depth_scale
            ray = T[:3, :3] @ [(u - c.cx) / c.fx, (v - c.cy) / c.fy, 1.0]
            sigmas = nearby.DEPTH_SIGMA_M + nearby.DEPTH_SIGMA_PER_M * z**2, nearby.PIXEL_SIGMA * z / c.fx
            _enter(samples, rays, T[:3, 3] - centre, ray * z, sigmas, reach)
    for cloud in frame.clouds:
        T = np.eye(4) if cloud.T_world_sensor is None else cloud.T_world_sensor
        for point in cloud.points[np.isfinite(cloud.points).all(axis=1)]:
            away = T[:3, :3] @ point.astype(np.float64)
            far = np.linalg.norm(away)
            sigmas = nearby.DEPTH_SIGMA_M + nearby.DEPTH_SIGMA_PER_M * far**2
            sigmas = sigmas, nearby.PIXEL_SIGMA * far / nearby.CLOUD_FOCAL_PX
            if cloud.T_world_sensor is not None:
                _enter(samples, rays, T[:3, 3] - centre, away, sigmas, reach)
            elif np.linalg.norm(away - centre) < reach:
                samples.append([*(away - centre), 0, 0, 0, 0, nearby.UNKNOWN_SIGMA_M])
    return np.array(samples).reshape(-1, nearby.SAMPLE), np.array(rays).reshape(-1, nearby.RAY)


def _enter(samples, rays, start, away, sigmas, reach):
    length = np.linalg.norm(away)
    ray = away / length
    if np.linalg.norm(start + away) < reach:
        samples.append([*(start + away), *ray, *sigmas])
        return
    along = -start @ ray
    if 0 < along < length and np.linalg.norm(start + along * ray) < nearby.PASSING_M:
        rays.append([*(start + along * ray), *ray])


def even(count, most):
    used = min(count, most)
    return [(2 * s + 1) * count // (2 * used) for s in range(used)]


def distances(state, points, modes, template):
    """Distance, gradient, place in the head, sigma and modes of the points on the grid, and which those are."""
    R, scale = state[3:12].reshape(3, 3), np.exp(state[12])
    q = (points - state[:3]) @ R / scale
    cell = np.floor((q - template.low) / template.voxel_m).astype(int)
    inside = ((cell >= 0) & (cell < template.shape)).all(axis=1)
    at = np.ravel_multi_index(tuple(cell[inside].T), template.shape)
    voxels = template.voxels[at]
    wide, narrow = voxels.view("<i2").astype(np.float64), voxels.view("<i1").astype(np.float64)
    q = q[inside]
    middle = template.low + (cell[inside] + 0.5) * template.voxel_m
    gradient, sigma = template.gradient_unit * wide[:, 1:4], template.sigma_unit_m * narrow[:, 8]
    shape = (template.mode_units_m * narrow[:, 9:25])[:, :modes]
    value = template.distance_unit_m * wide[:, 0] + ((q - middle) * gradient).sum(axis=1)
    return value + shape @ state[13 : 13 + modes], gradient, q, sigma, shape, inside


def linearise(samples, rays, most, modes, k, upright, template, state):
    """Cost, A and b of the normal equations, and what is told."""
    R, scale = state[3:12].reshape(3, 3), np.exp(state[12])
    size = 7 + modes
    A, b, cost = np.zeros((size, size)), np.zeros(size), 0.0
    told = np.zeros(3)
    chosen = samples[even(len(samples), most[0])]
    passing = rays[even(len(rays), most[1])]
    near = passing[:, :3] - state[:3]
    near = near - (near * passing[:, 3:]).sum(axis=1, keepdims=True) * passing[:, 3:] + state[:3]
    each = min(1.0, residuals.INDEPENDENT / len(chosen))
    for points, kind in ((chosen[:, :3], "point"), (near, "ray")):
        value, g, q, sigma, shape, inside = distances(state, points, modes, template)
        e, variance = scale * value, (scale * sigma) ** 2
        J = np.hstack([-g, scale * np.cross(g, q), scale * (value - (g * q).sum(1))[:, None], scale * shape])
        if kind == "point":
            s = chosen[inside]
            variance = variance + (s[:, 6] * (g * (s[:, 3:6] @ R)).sum(axis=1)) ** 2 + s[:, 7] ** 2
            weight = np.full(len(e), each)
            turned = np.maximum((g * (s[:, 3:6] @ R)).sum(axis=1) - residuals.FACING_AWAY, 0.0)
            hidden = (residuals.BREADTH_M * turned) ** 2 / (residuals.CHORD_SIGMA_M**2 + s[:, 6] ** 2)
        else:
            hidden = np.zeros(len(e))
            weight = np.where(e < 0, residuals.RAY_WEIGHT, 0.0)
            told[residuals.CROSSED] = np.sum(e < 0)
        bare = e**2 / variance
        damp = 1 / (1 + bare / k**2)
        cost += np.sum(weight * (bare + hidden) / (1 + (bare + hidden) / k**2))
        if kind == "point":
            outside = k * k * np.sum(~inside)
            cost += each * outside
            told[residuals.COST] = ((bare * damp).sum() + outside) / 2
            told[residuals.ON_SURFACE] = np.sum(bare < k**2)
        w = np.where(damp < residuals.LEAST_DAMPING, 0.0, weight * damp**2 / variance)
        A += (J * w[:, None]).T @ J
        b += (J * w[:, None]).T @ e
    priors = [
        (np.vstack([R.T, np.zeros((size - 3, 3))]).T, state[:3], 1 / align.CENTRE_SIGMA_M**2),
        (np.eye(size)[6:7], state[12:13], 1 / align.SCALE_SIGMA**2),
        (np.eye(size)[7:], state[13 : 13 + modes], 1.0),
    ]
    if upright:
        up = R[2]
        turned = np.cross(np.eye(3), up)  # row i: how up[i] changes with a turn w is (up x w)[i]
        rows = np.zeros((2, size))
        rows[:, 3:6] = turned[:2]
        priors += [(rows[:1], up[:1], align.PITCH_SIGMA**-2), (rows[1:], up[1:2], align.ROLL_SIGMA**-2)]
    for J, e, w in priors:
        A += w * J.T @ J
        b += w * J.T @ e
        cost += w * e @ e
    return cost / 2, A, b, told


def move(state, step):
    """The state after a step, cut to a bearable length."""
    far, turn = np.linalg.norm(step[:3]), np.linalg.norm(step[3:6])
    step = step / max(1.0, far / align.LONGEST_STEP_M, turn / align.LARGEST_TURN_RAD)
    R = state[3:12].reshape(3, 3)
    x, y, z = step[3:6]
    new = state.copy()
    new[:3] += R @ step[:3]
    new[3:12] = (R @ expm(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))).reshape(9)
    new[12 : 6 + len(step)] += step[6:]
    new[12] = np.clip(new[12], -align.LARGEST_LOG_SCALE, align.LARGEST_LOG_SCALE)
    return new


def refine_one(samples, rays, turn, upright, template):
    """What a single start comes to: state, told."""
    modes = template_of.FINE_MODES
    state = np.zeros(residuals.STATE)
    state[3:12] = turn
    most = (trials.FINE_SAMPLES, trials.FINE_RAYS)
    for k in np.linspace(trials.FINE_K, trials.LAST_K, trials.FINE_STEPS):
        _, A, b, _ = linearise(samples, rays, most, modes, k, upright, template, state)
        state = move(state, -np.linalg.solve(A, b))
    cost, A, _, told = linearise(samples, rays, most, modes, trials.LAST_K, upright, template, state)
    return state, [*told, cost + 0.5 * np.linalg.slogdet(A)[1]]


def polish_one(samples, rays, state, upright, template):
    """What the last steps make of it: state, told but for the evidence, covariance of shift and turn."""
    most = (trials.POLISH_SAMPLES, trials.POLISH_RAYS)
    for _ in range(trials.POLISH_STEPS):
        _, A, b, _ = linearise(samples, rays, most, residuals.MODES, trials.LAST_K, upright, template, state)
        state = move(state, -np.linalg.solve(A, b))
    _, A, _, told = linearise(samples, rays, most, residuals.MODES, trials.LAST_K, upright, template, state)
    return state, told, np.linalg.inv(A)[:6, :6]


def recentre(centre, state, template):
    """Where the centre of a head of this shape is that is seen all around."""
    shift = template.centre_of_shape @ [1, *state[12:]]
    return centre + np.exp(state[12]) * state[3:12].reshape(3, 3) @ shift


def settle(work, count, best, centre, template):
    """What is stated of a mixture of states: centre, radius, its covariance, quaternion and its covariance."""
    states, evidence = work.states[:count], work.told[:count, residuals.EVIDENCE]
    R = states[best, 3:12].reshape(3, 3)
    odds = np.nan_to_num(np.exp((evidence[best] - evidence) / template.temperature))
    odds /= odds.sum()
    turns = Rotation.from_matrix(R.T @ states[:, 3:12].reshape(-1, 3, 3)).as_rotvec()
    shifts = states[:, :3] - states[best, :3]
    own = work.covariance
    centre_covariance = template.shift_factor * R @ own[:3, :3] @ R.T
    turn_covariance = template.turn_factor * own[3:, 3:]
    for share, turn, shift in zip(odds, turns, shifts, strict=True):
        centre_covariance = centre_covariance + share * np.outer(shift, shift)
        turn_covariance = turn_covariance + share * np.outer(turn, turn)
    quaternion = Rotation.from_matrix(R).as_quat()
    if turn_covariance[2, 2] >= settling.SURE_YAW_RAD**2:
        quaternion, turn_covariance = np.full(4, np.nan), np.full((3, 3), np.nan)
    radius = template.radius_m * np.exp(states[best, 12])
    return centre + states[best, :3], radius, centre_covariance, quaternion, turn_covariance
