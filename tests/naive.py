"""A slow and obvious twin of every stage, to hold the fast ones equal to.

Plain loops and plain sums. Nothing here is shared with the package but its data classes: cascades are read as their
file has them, in metres, and are turned into voxels by a rule of this file's own.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from fractions import Fraction
from itertools import product

import numpy as np

from headvox.data import Cloud, DepthImage, Frame
from headvox.fuse import Region
from headvox.masks.cascade import Box, Cascade, Condition, Group, Votes

DROPPED = -(2**40)
SCORE_UNIT = 1024
f32 = np.float32


# ------------------------------------------------------------------------------------------------------------- points


def inside(x, y, z, limits) -> bool:
    dx, dy, dz = x - limits[0], y - limits[1], z - limits[2]
    return bool(dx * dx + dy * dy + dz * dz < limits[3] and limits[4] <= z < limits[5])


def moved(T, x, y, z):
    """Return T (4, 4) applied to a point, in the type of both, summed as documented."""
    return tuple(T[k, 3] + (T[k, 0] * x + T[k, 1] * y + T[k, 2] * z) for k in range(3))


def fuse(clouds: list[Cloud], region: Region) -> np.ndarray:
    limits = [f32(v) for v in (*region.centre, region.radius_m**2, region.min_height_m, region.max_height_m)]
    kept = []
    with np.errstate(all="ignore"):
        for cloud in clouds:
            T = np.eye(4) if cloud.T_world_sensor is None else cloud.T_world_sensor
            for point in cloud.points:
                world = moved(T.astype(f32), *point)
                if inside(*world, limits):
                    kept.append(world)
    return np.array(kept, f32).reshape(-1, 3)


# ------------------------------------------------------------------------------------------------------------- voxels


@dataclass
class Lattice:
    """Voxels from ``origin`` on; ``limits`` is the region in parts of voxels from the origin, in float32."""

    origin: tuple[float, float, float]
    shape: tuple[int, int, int]
    part: float
    parts: int
    limits: list[np.float32]


def lattice_over(region: Region, voxel: float, subdivision: int) -> Lattice:
    lowest = (region.centre[0] - region.radius_m, region.centre[1] - region.radius_m, region.min_height_m)
    origin = tuple(math.floor(v / voxel) * voxel for v in lowest)
    across = math.ceil(2 * region.radius_m / voxel) + 2
    high = math.ceil((region.max_height_m - region.min_height_m) / voxel) + 2
    part = voxel / subdivision
    per_part = 1.0 / part
    limits = [f32((region.centre[k] - origin[k]) * per_part) for k in range(3)]
    limits.append(f32(region.radius_m * region.radius_m * per_part * per_part))
    limits.append(f32((region.min_height_m - origin[2]) * per_part))
    limits.append(f32((region.max_height_m - origin[2]) * per_part))
    return Lattice(origin, (across, across, high), part, subdivision, limits)


class Grid:
    """Which parts of which voxels hold points, and how many points a voxel holds."""

    def __init__(self, lattice: Lattice) -> None:
        self.lattice = lattice
        self.bits = np.zeros(lattice.shape, np.uint8)
        self.counts = np.zeros(lattice.shape, np.uint32)

    def enter(self, x, y, z) -> None:
        """Enter a point, in parts from the origin."""
        if inside(x, y, z, self.lattice.limits):
            # Rounding may put a point that is just within range a hair below the first cell.
            steps = [max(0, math.floor(v)) for v in (x, y, z)]
            voxel = tuple(step // self.lattice.parts for step in steps)
            a, b, c = (step % self.lattice.parts for step in steps)
            self.bits[voxel] |= 2 ** (4 * a + 2 * b + c)
            self.counts[voxel] += 1

    def enter_cloud(self, cloud: Cloud) -> None:
        T = np.eye(4) if cloud.T_world_sensor is None else np.array(cloud.T_world_sensor, dtype=np.float64)
        to_parts = T.copy()
        to_parts[:3, 3] -= self.lattice.origin
        to_parts[:3] /= self.lattice.part
        to_parts = to_parts.astype(f32)
        with np.errstate(all="ignore"):
            for point in cloud.points:
                self.enter(*moved(to_parts, *point))

    def enter_depth(self, image: DepthImage) -> None:
        camera, T, part = image.intrinsics, image.T_world_camera, self.lattice.part
        scale = camera.depth_scale / part
        t = [f32((T[k, 3] - self.lattice.origin[k]) / part) for k in range(3)]
        with np.errstate(all="ignore"):
            for v in range(camera.height):
                down = (v - camera.cy) / camera.fy
                for u in range(camera.width):
                    if image.depth[v, u] == 0:
                        continue
                    depth = f32(image.depth[v, u])
                    across = (u - camera.cx) / camera.fx
                    ray = [
                        f32((T[k, 0] * across + T[k, 2]) * scale) + f32(T[k, 1] * down * scale)
                        for k in range(3)
                    ]
                    self.enter(*(t[k] + depth * ray[k] for k in range(3)))

    def amounts(self, counting: bool) -> np.ndarray:
        """Return what an integral volume adds up, as int64."""
        return weights(self.counts if counting else self.bits)


def weights(cells: np.ndarray) -> np.ndarray:
    """Return the number of points of a count grid, or the number of bits of a parts grid."""
    if cells.dtype == np.uint8:
        return np.array([bin(value).count("1") for value in cells.ravel()], np.int64).reshape(cells.shape)
    return cells.astype(np.int64)


def integral_volume(cells: np.ndarray) -> np.ndarray:
    """Return S[x, y, z] = the sum of everything below x, y and z, modulo 2**32."""
    amount = weights(cells)
    S = np.zeros([n + 1 for n in cells.shape], np.uint32)
    for x in range(S.shape[0]):
        for y in range(S.shape[1]):
            for z in range(S.shape[2]):
                S[x, y, z] = int(amount[:x, :y, :z].sum()) % 2**32
    return S


def box_sum(amount: np.ndarray, box) -> int:
    """Return the sum of ``amount`` over x0 x1 y0 y1 z0 z1, half-open; nothing lies outside of the grid."""
    x0, x1, y0, y1, z0, z1 = (max(0, int(edge)) for edge in box)
    return int(amount[x0:x1, y0:y1, z0:z1].sum())


# -------------------------------------------------------------------------------------------------- metres to voxels


@functools.cache
def voxel_range(centre: float, size: float, voxel: float) -> tuple[int, int]:
    """Return the half-open range of voxels whose middle is nearest to ``centre``; of two, the one farther out."""
    count = max(1, round(size / voxel))
    wanted = Fraction(round(centre / voxel, 6))
    nearest = None
    for start in range(math.floor(wanted) - count - 2, math.ceil(wanted) + count + 3):
        middle = start + Fraction(count - 1, 2)
        rank = (abs(middle - wanted), -start if wanted >= 0 else start)
        if nearest is None or rank < nearest[0]:
            nearest = (rank, start)
    return nearest[1], nearest[1] + count


@functools.cache
def voxel_box(box: Box, voxel: float, yaw: float = 0.0) -> list[int]:
    x, y, z = box.centre
    if yaw:
        x, y = math.cos(yaw) * x - math.sin(yaw) * y, math.sin(yaw) * x + math.cos(yaw) * y
    edges = []
    for centre, size in zip((x, y, z), box.size, strict=True):
        edges += voxel_range(centre, size, voxel)
    return edges


def volume(box: list[int]) -> int:
    return (box[1] - box[0]) * (box[3] - box[2]) * (box[5] - box[4])


def about(cell, box) -> list[int]:
    return [int(cell[k // 2]) + edge for k, edge in enumerate(box)]


# --------------------------------------------------------------------------------------------------------------- gate


def condition_holds(amount: np.ndarray, cell, condition: Condition, voxel: float, unit: int) -> bool:
    boxes = [(voxel_box(box, voxel), box.weight) for box in condition.group.boxes]
    sums = [box_sum(amount, about(cell, box)) for box, _ in boxes]
    if condition.rank:
        got = sorted(sums)[condition.rank - 1]
        cells = sum(volume(box) for box, _ in boxes) * unit / len(boxes)
    else:
        got = sum(weight * total for (_, weight), total in zip(boxes, sums, strict=True))
        cells = sum(weight * volume(box) for box, weight in boxes if weight > 0) * unit
    return round(condition.minimum * cells, 6) <= got <= round(condition.maximum * cells, 6)


def is_candidate(cell, spacing: int, odd=(0, 0, 0)) -> bool:
    x, y, z = ((c + o) % 2 for c, o in zip(cell, odd, strict=True))
    return spacing == 1 or (spacing == 2 and (x + y + z) % 2 == 0) or (spacing == 4 and x == y == z)


def gate(amount: np.ndarray, cascade: Cascade, voxel: float, odd=(0, 0, 0)) -> np.ndarray:
    """Return the voxels that pass every condition, in the order of x, y, z."""
    unit = 1 if cascade.counting else cascade.subdivision**3
    passed = [
        (x, y, z)
        for x in range(amount.shape[0])
        for y in range(amount.shape[1])
        for z in range(amount.shape[2])
        if is_candidate((x, y, z), cascade.spacing, odd)
        and all(condition_holds(amount, (x, y, z), c, voxel, unit) for c in cascade.conditions)
    ]
    return np.array(passed, np.int32).reshape(-1, 3)


# --------------------------------------------------------------------------------------------------------------- vote


def score_by_votes(amount: np.ndarray, cell, votes: Votes, voxel: float) -> tuple[int, int]:
    """Return the score of the best yaw, in units of 1/1024, and which yaw that is."""
    best, best_yaw = -math.inf, 0
    for i, yaw in enumerate(math.radians(deg) for deg in votes.yaws_deg):
        sums = [
            sum(box.weight * box_sum(amount, about(cell, voxel_box(box, voxel, yaw))) for box in mask.boxes)
            for mask in votes.masks
        ]
        positive = sum(total > 0 for total in sums)
        score = float(positive - sum(total < 0 for total in sums))
        if votes.mirrored:
            unlike = 0.0
            for pair in votes.mirrored:
                a, b = (box_sum(amount, about(cell, voxel_box(box, voxel, yaw))) for box in pair)
                unlike += abs(a - b) / (a + b) if a + b else 0.0
            score -= votes.asymmetry_cost * (unlike / len(votes.mirrored))
        if positive >= votes.min_votes and score > best:
            best, best_yaw = score, i
    return (DROPPED if best == -math.inf else math.floor(best * SCORE_UNIT)), best_yaw


def group_sums(group: Group, amount: np.ndarray, cell, states, voxel: float) -> list[int]:
    boxes = [about(cell, voxel_box(box, voxel)) for box in group.boxes]
    if group.channel == "occupied":
        return [box_sum(amount, box) for box in boxes]
    return [count_in(states, box)[0 if group.channel == "empty" else 1] for box in boxes]


def feature(name: str, cascade: Cascade, amount: np.ndarray, cell, states, voxel: float) -> tuple[int, float]:
    """Return the statistic ``name`` and the volume that makes a share of it."""
    group_name, statistic = name.rsplit(".", 1)
    (group,) = [group for group in cascade.groups if group.name == group_name]
    sums = sorted(group_sums(group, amount, cell, states, voxel))
    parts = cascade.subdivision**3 if group.channel == "occupied" and not cascade.counting else 1
    cells = sum(volume(voxel_box(box, voxel)) for box in group.boxes) * parts
    if statistic == "sum":
        return sum(sums), cells
    return sums[{"min": 0, "low": 2, "high": -3, "max": -1}[statistic]], cells / len(sums)


def tree_leaf(tree, look) -> float:
    """Return the leaf that a tree leads to; ``look`` gives a feature and the volume of its boxes."""
    if not isinstance(tree, tuple):
        return tree
    name, cut, at_most, above = tree
    got, cells = look(name)
    return tree_leaf(at_most if got <= round(cut * cells, 6) else above, look)


def names_in(tree) -> set[str]:
    if not isinstance(tree, tuple):
        return set()
    return {tree[0]} | names_in(tree[2]) | names_in(tree[3])


def score_by_stages(
    amount: np.ndarray, cell, cascade: Cascade, voxel: float, states=None, judge=False
) -> int:
    """Return the score in units of 1/1024. Without ``states`` the first stage that needs them ends it."""
    seeing = {group.name for group in cascade.groups if group.channel != "occupied"}
    known = {}

    def look(name):
        if name not in known:
            known[name] = feature(name, cascade, amount, cell, states, voxel)
        return known[name]

    score = 0
    for stage in cascade.judge if judge else cascade.stages:
        needed = {name.rsplit(".", 1)[0] for tree in stage.trees for name in names_in(tree)}
        if states is None and needed & seeing:
            break
        score += sum(round(tree_leaf(tree, look) * SCORE_UNIT) for tree in stage.trees)
        if score < stage.keep * SCORE_UNIT:
            return DROPPED
    return score


# --------------------------------------------------------------------------------------------------------- visibility


class States:
    """Whether the cameras saw a cell empty ("empty"), have it behind a surface ("hidden"), or neither (None)."""

    def __init__(self, images, lattice: Lattice) -> None:
        self.images, self.lattice, self.known = images, lattice, {}
        voxel = lattice.part * lattice.parts
        self.tables = []
        for image in images:
            c = image.intrinsics
            K = np.array([[c.fx, 0.0, c.cx], [0.0, c.fy, c.cy], [0.0, 0.0, 1.0]])
            R_camera_world = image.T_world_camera[:3, :3].T
            t_camera_world = -R_camera_world @ image.T_world_camera[:3, 3]
            first = np.array(lattice.origin) + 0.5 * voxel
            per_cell = (K @ R_camera_world * voxel).astype(f32)
            constant = (K @ (R_camera_world @ first + t_camera_world)).astype(f32)
            self.tables.append((per_cell, constant))

    def of(self, cell) -> str | None:
        cell = tuple(int(c) for c in cell)
        if cell not in self.known:
            seen = [self.by(k, cell) for k in range(len(self.images))]
            self.known[cell] = "empty" if "empty" in seen else "hidden" if "hidden" in seen else None
        return self.known[cell]

    def by(self, k: int, cell) -> str | None:
        depth, camera = self.images[k].depth, self.images[k].intrinsics
        A, constant = self.tables[k]
        x, y, z = (f32(c) for c in cell)
        uz, vz, far = (A[i, 0] * x + A[i, 1] * y + A[i, 2] * z + constant[i] for i in range(3))
        if not far > f32(0.1):
            return None
        column = math.floor(uz / far + f32(0.5))
        row = math.floor(vz / far + f32(0.5))
        if not (0 <= column < camera.width and 0 <= row < camera.height) or depth[row, column] == 0:
            return None
        measured = f32(depth[row, column]) * f32(camera.depth_scale)
        margin = f32(0.03) + f32(0.004) * far * far
        if measured > far + margin:
            return "empty"
        return "hidden" if measured < far - margin else None


def count_in(states: States, box) -> tuple[int, int]:
    """Return how many cells of ``box`` are known-empty, and how many hidden."""
    x0, x1, y0, y1, z0, z1 = (int(edge) for edge in box)
    found = [states.of((x, y, z)) for x in range(x0, x1) for y in range(y0, y1) for z in range(z0, z1)]
    return found.count("empty"), found.count("hidden")


def count_seen(images, lattice: Lattice, cells, boxes) -> np.ndarray:
    states = States(images, lattice)
    rows = [[count_in(states, about(cell, box)) for box in boxes] for cell in cells]
    return np.array(rows, np.int32).reshape(len(cells), len(boxes), 2)


def see_place(image: DepthImage, place, sight: float) -> str:
    """Return what one camera saw about ``place``, by the nine pixels of a grid 7 cm wide to either side."""
    c, depth, T = image.intrinsics, image.depth, image.T_world_camera
    K = np.array([[c.fx, 0.0, c.cx], [0.0, c.fy, c.cy], [0.0, 0.0, 1.0]])
    T_camera_world = np.column_stack([T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]])
    A = K @ np.vstack([T_camera_world, [0.0, 0.0, 0.0, 1.0]])[:3]
    x, y, z = place
    uz, vz, far = (A[i, 0] * x + A[i, 1] * y + A[i, 2] * z + A[i, 3] for i in range(3))
    if not 0.1 < far <= sight:
        return "out of view"
    seen = []
    for i, j in product((-1, 0, 1), repeat=2):
        column = math.floor(uz / far + i * 0.07 * c.fx / far + 0.5)
        row = math.floor(vz / far + j * 0.07 * c.fy / far + 0.5)
        if 0 <= column < c.width and 0 <= row < c.height:
            measured = int(depth[row, column]) * c.depth_scale
            if measured == 0:
                seen.append("nothing")
            elif measured > far + 0.15:
                seen.append("beyond")
            else:
                seen.append("front" if measured < far - 0.25 else "about")
    returns = len(seen) - seen.count("nothing")
    if len(seen) < 5:
        return "out of view"
    if seen.count("beyond") >= 5 and seen.count("about") <= 1:
        return "empty"
    if returns < 5:
        return "no return"
    return "behind" if seen.count("front") > returns / 2 else "surface"


def see_places(images, places, sight: float) -> list[int]:
    order = ["out of view", "no return", "behind", "surface", "empty"]
    return [max([order.index(see_place(i, place, sight)) for i in images], default=0) for place in places]


# ----------------------------------------------------------------------------------------------------------- suppress


def best_of_each(cells: np.ndarray, scores, group: int, least) -> list[int]:
    """Return the first best of every ``group`` cells, without such as score too low or were best before."""
    best: dict[tuple[int, ...], int] = {}
    for first in range(0, len(cells), group):
        i = max(range(first, first + group), key=lambda k: scores[k])
        if scores[i] >= least:
            best.setdefault(tuple(cells[i].tolist()), i)
    return list(best.values())


def suppress(cells: np.ndarray, scores: np.ndarray, least: int, reach: int = 1) -> np.ndarray:
    """Return the candidates that beat every neighbour; of equal neighbours the first wins."""
    number = {tuple(cell): i for i, cell in enumerate(cells.tolist())}
    peaks = []
    for (x, y, z), i in number.items():
        around = [(x + a, y + b, z + c) for a, b, c in product(range(-reach, reach + 1), repeat=3)]
        others = [number[cell] for cell in around if cell in number and cell != (x, y, z)]
        if scores[i] >= least and all((scores[i], -i) > (scores[j], -j) for j in others):
            peaks.append(i)
    return np.array(peaks, np.int64)


def suppress_overlaps(centres: np.ndarray, scores: np.ndarray, distance: float) -> np.ndarray:
    kept = []
    for i in sorted(range(len(scores)), key=lambda i: (-scores[i], i)):
        if all(sum((centres[i][k] - centres[j][k]) ** 2 for k in range(3)) >= distance**2 for j in kept):
            kept.append(i)
    return np.array(kept, np.int64)


# ------------------------------------------------------------------------------------------------------------- refine


def parts_near(cells: np.ndarray, peak, voxel: float, subdivision: int) -> np.ndarray:
    """Return the middles of the occupied parts within 16 cm of a voxel's centre, and not 9 cm below it, from there."""
    points = []
    part = voxel / subdivision
    for cell in np.argwhere(cells):
        corner = (cell - np.array(peak) - 0.5) * voxel
        if np.abs(cell - np.array(peak)).max() > math.ceil(0.16 / voxel):
            continue
        for a in range(subdivision):
            for b in range(subdivision):
                for c in range(subdivision):
                    occupied = cells.dtype != np.uint8 or int(cells[tuple(cell)]) >> (4 * a + 2 * b + c) & 1
                    p = corner + (np.array([a, b, c]) + 0.5) * part
                    if occupied and p[0] * p[0] + p[1] * p[1] + p[2] * p[2] <= 0.16 * 0.16 and p[2] >= -0.09:
                        points.append(p)
    return np.array(points, np.float64).reshape(-1, 3)


def fit_sphere(points: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return centre, radius and rms: ten Gauss-Newton steps with Cauchy weights and Gaussian priors."""
    sigma, prior = 0.012, np.array([0.0, 0.0, 0.0, 0.093])
    stiffness = np.diag([(sigma / 0.05) ** 2] * 3 + [(sigma / 0.008) ** 2])
    x, rms = prior.copy(), 0.0
    for _ in range(10):
        away = points - x[:3]
        distance = np.maximum(np.sqrt((away**2).sum(axis=1)), 1e-6)
        residual = distance - x[3]
        weight = 1.0 / (1.0 + (residual / sigma) ** 2)
        J = np.column_stack([-away / distance[:, None], -np.ones(len(points))])
        A = stiffness + J.T @ (weight[:, None] * J)
        b = stiffness @ (prior - x) - J.T @ (weight * residual)
        x = x + np.linalg.solve(A, b)
        rms = math.sqrt((weight * residual**2).sum() / max(weight.sum(), 1e-9))
    return x[:3], x[3], rms


def fit_spheres(cells: np.ndarray, peaks, voxel: float, subdivision: int) -> np.ndarray:
    rows = []
    for peak in peaks:
        points = parts_near(cells, peak, voxel, subdivision)
        centre, radius, rms = fit_sphere(points)
        rows.append([*centre, radius, rms, len(points)])
    return np.array(rows, np.float64).reshape(-1, 6)


# ----------------------------------------------------------------------------------------------------------- all of it


def best_about(amount: np.ndarray, cells, cascade: Cascade, voxel: float) -> tuple[np.ndarray, list[int]]:
    """Return for each peak the voxel about it that the judge likes best, and its score; no voxel twice."""
    best = {}
    for cell in cells.tolist():
        steps = {1: 0, 2: 1, 4: 3}[cascade.spacing]  # to the voxels that were no candidates
        around = [d for d in product((-1, 0, 1), repeat=3) if sum(map(abs, d)) <= steps]
        about = [tuple(cell[k] + d[k] for k in range(3)) for d in around]
        scores = [score_by_stages(amount, c, cascade, voxel, judge=True) for c in about]
        if max(scores) > DROPPED:
            best.setdefault(about[scores.index(max(scores))], max(scores))
    return np.array(list(best), np.int32).reshape(-1, 3), list(best.values())


@dataclass
class Found:
    centres: np.ndarray
    scores: list[float]
    radii: list[float]
    candidates: int


def detect(frame: Frame, cascade: Cascade, region: Region, min_score: float | None = None) -> Found:
    """Return the heads in ``frame``, over the whole region: nothing is cropped, nothing is remembered."""
    voxel, counting = cascade.voxel_m, cascade.counting
    lattice = lattice_over(region, voxel, cascade.subdivision)
    grid = Grid(lattice)
    for cloud in frame.clouds:
        grid.enter_cloud(cloud)
    for image in frame.depths:
        grid.enter_depth(image)
    amount = grid.amounts(counting)
    candidates = gate(amount, cascade, voxel, [round(v / voxel) for v in lattice.origin])
    if cascade.votes is not None:
        scores = [score_by_votes(amount, cell, cascade.votes, voxel)[0] for cell in candidates]
    else:
        scores = [score_by_stages(amount, cell, cascade, voxel) for cell in candidates]
    scores = np.array(scores, np.int64)
    peaks = suppress(candidates, scores, DROPPED + 1, 2 if cascade.spacing == 4 else 1)

    seeing = {group.name for group in cascade.groups if group.channel != "occupied"}
    asks = {
        n.rsplit(".", 1)[0] for stage in cascade.judge for tree in stage.trees for n in names_in(tree)
    } & seeing
    sees = bool(asks) and bool(frame.depths) and not frame.clouds
    cells, scores = candidates[peaks], scores[peaks]
    if cascade.judge:
        cells, scores = best_about(amount, cells, cascade, voxel)
        if sees:
            states = States(frame.depths, lattice)
            scores = [score_by_stages(amount, cell, cascade, voxel, states, judge=True) for cell in cells]
    scores = np.array(scores, np.int64)
    if min_score is None:
        min_score = cascade.min_score if sees or not asks else cascade.min_score_occupied
    high = scores >= min_score * SCORE_UNIT
    cells, scores = cells[high], scores[high]
    spheres = fit_spheres(grid.counts if counting else grid.bits, cells, voxel, cascade.subdivision)
    middles = (cells + 0.5) * voxel + np.array(lattice.origin)
    placed = [c.T_world_sensor for c in frame.clouds if c.T_world_sensor is not None]
    placed += [image.T_world_camera for image in frame.depths]
    origins = np.array([T[:3, 3] for T in placed]).reshape(-1, 3)
    centres = middles + spheres[:, :3]
    if len(origins):
        centres[:, 2] -= 0.0135
    kept = suppress_overlaps(centres, scores, 0.18)
    return Found(
        centres[kept],
        [scores[k] / SCORE_UNIT for k in kept],
        [spheres[k, 3] for k in kept],
        len(candidates),
    )
