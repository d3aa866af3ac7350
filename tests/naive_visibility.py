"""The slow and obvious twin of visibility: whether cameras saw a cell or a place empty, or something before it."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
from naive_voxels import Lattice, about

from headvox.data import DepthImage

f32 = np.float32


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


def is_seen(states: States, boxes) -> bool:
    """Return whether a sixteenth of the cells in ``boxes`` was seen empty; those in two of them count twice."""
    counts = [np.array([count_in(states, box)[0], np.prod(np.diff(box)[::2])]) for box in boxes]
    empty, cells = sum(counts)
    return bool(empty / cells >= 1 / 16)


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
