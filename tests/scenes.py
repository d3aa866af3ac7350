"""What the tests look at: small clouds, small depth images, small cascades. The same seed makes the same bytes."""

from __future__ import annotations

import numpy as np

from headvox.data import Cloud, DepthImage, Intrinsics
from headvox.frames import placed
from headvox.fuse import Region

STAGES = """
format = "headvox-cascade"
version = 1
name = "small"
summary = "rings and trees for the tests"
voxel_m = 0.05
subdivision = 2
occupancy = "parts"
min_score = 0.25
min_score_occupied = 0.5

[[gate]]
name = "shell"
boxes = [{ centre = [0, 0, 0], size = [0.25, 0.25, 0.25] }]
min = 0.02
max = 0.5

[[gate]]
name = "pair"
boxes = [{ centre = [0, 0, 0], size = [0.15, 0.15, 0.15] }, { centre = [0.0, 0.0, 0.1], size = [0.25, 0.15, 0.05] }]
min = 0.005

[[gate]]
name = "above"
ring = { radius = 0.2, height = 0.2, size = [0.15, 0.15, 0.15] }
rank = 8
max = 0.3

[[gate]]
name = "few"
ring = { radius = 0.15, height = -0.05, size = [0.1, 0.1, 0.15], count = 5 }
rank = 2
max = 0.4

[[group]]
name = "near"
ring = { radius = 0.10, height = 0.0, size = [0.10, 0.10, 0.10] }
[[group]]
name = "unused"
ring = { radius = 0.10, height = 0.3, size = [0.10, 0.10, 0.10] }
[[group]]
name = "free"
channel = "empty"
ring = { radius = 0.25, height = 0.05, size = [0.15, 0.15, 0.15], count = 6 }
[[group]]
name = "core"
boxes = [{ centre = [0, 0, -0.05], size = [0.15, 0.15, 0.2] }]
[[group]]
name = "shade"
channel = "hidden"
boxes = [{ centre = [0, 0, 0], size = [0.15, 0.15, 0.15] }]

[[stage]]
name = "a"
keep = -1.5
trees = [
  ["near.sum", 0.05, -1.0, ["near.min", 0.0, 0.1, 0.77]],
  ["near.max", 0.3, 0.3, ["near.low", 0.02, -0.2, 0.4]],
  0.125,
]
[[stage]]
name = "b"
keep = -0.6001
trees = [["core.sum", 0.1, 0.2, ["near.high", 0.15, 0.3, -0.5]], ["near.sum", 0.1, -0.3, 0.3]]
[[stage]]
name = "again"
at = "peaks"
keep = 0.2
trees = [
  ["near.sum", 0.05, -1.0, ["near.min", 0.0, 0.1, 0.77]],
  ["near.max", 0.3, 0.3, ["near.low", 0.02, -0.2, 0.4]],
  ["core.sum", 0.1, 0.2, ["near.high", 0.15, 0.3, -0.5]],
]
[[stage]]
name = "c"
at = "peaks"
trees = [["free.sum", 0.3, -0.7, ["free.min", 0.1, 0.2, 0.5]], ["shade.sum", 0.2, -0.3, ["free.max", 0.9, 0.1, 0.6]]]
"""

VOTES = """
format = "headvox-cascade"
version = 1
name = "small votes"
summary = "masks that vote, for the tests"
voxel_m = 0.05
occupancy = "count"
min_score = 0.5

[[gate]]
name = "shell"
boxes = [{ centre = [0, 0, 0], size = [0.25, 0.25, 0.25] }]
min = 0.1
[[gate]]
name = "outer"
ring = { radius = 0.2, height = 0.1, size = [0.15, 0.15, 0.15], count = 4 }
rank = 1
max = 1.5

[votes]
min_votes = 1
asymmetry_cost = 1.2
yaws_deg = [0.0, 45.0, 90.0, 120.0]
mirrored = [
  [{ centre = [0, 0.1, 0], size = [0.15, 0.1, 0.15] }, { centre = [0, -0.1, 0], size = [0.15, 0.1, 0.15] }],
  [{ centre = [0.4, 0, 0], size = [0.6, 0.6, 0.6] }, { centre = [-0.4, 0, 0], size = [0.6, 0.6, 0.6] }],
]
[[votes.mask]]
name = "cross"
boxes = [
  { centre = [0, 0, 0], size = [0.3, 0.05, 0.05] },
  { centre = [0, 0, 0], size = [0.05, 0.3, 0.05], weight = 2 },
  { centre = [0.15, 0.15, 0.1], size = [0.1, 0.1, 0.1], weight = -1 },
]
[[votes.mask]]
name = "stick"
boxes = [
  { centre = [0, 0, 0.0], size = [0.2, 0.2, 0.2] },
  { centre = [0.1, 0, -0.2], size = [0.1, 0.15, 0.15], weight = -2 },
]
"""


def region(radius: float = 0.6, low: float = -0.3, high: float = 0.5, centre=(0.0, 0.0, 0.0)) -> Region:
    return Region(centre, radius, low, high)


def turn(rng: np.random.Generator) -> np.ndarray:
    """Return a random rotation (3, 3)."""
    return placed(np.zeros(3), rng.normal(size=4))[:3, :3].copy()


def pose(rng: np.random.Generator, reach: float = 0.3) -> np.ndarray:
    """Return a random rigid transform (4, 4)."""
    T = np.eye(4)
    T[:3, :3] = turn(rng)
    T[:3, 3] = rng.uniform(-reach, reach, 3)
    return T


def shell(rng: np.random.Generator, centre, radius: float, count: int) -> np.ndarray:
    """Return points (count, 3) on a sphere."""
    n = rng.normal(size=(count, 3))
    return (np.array(centre) + radius * n / np.linalg.norm(n, axis=1, keepdims=True)).astype(np.float32)


def bust(rng: np.random.Generator, centre, count: int = 600) -> np.ndarray:
    """Return points on a head about ``centre`` and on the shoulders below it."""
    shoulders = (
        shell(rng, (0, 0, 0), 1.0, count) * np.array([0.12, 0.22, 0.1]) + np.array(centre) - [0, 0, 0.25]
    )
    return np.concatenate([shell(rng, centre, 0.095, count), shoulders]).astype(np.float32)


def messy_cloud(rng: np.random.Generator, count: int = 400, spread: float = 0.7) -> np.ndarray:
    """Return points all about the origin, some on the borders of cells, some NaN, infinite or huge."""
    points = rng.uniform(-spread, spread, (count, 3)).astype(np.float32)
    on_border = rng.random(count) < 0.3
    points[on_border] = np.round(points[on_border] / 0.025) * np.float32(0.025)
    for value in (np.nan, np.inf, -np.inf, 1e30, -1e30, 3.4e38, 0.0, -0.0):
        rows = rng.integers(0, count, 3)
        points[rows, rng.integers(0, 3, 3)] = value
    return points


def clouds(rng: np.random.Generator) -> list[Cloud]:
    """Return three clouds: one in the world, two turned and moved."""
    return [
        Cloud("world", messy_cloud(rng)),
        Cloud("left", messy_cloud(rng), pose(rng)),
        Cloud("right", bust(rng, (0.1, 0.0, 0.1), 150), pose(rng, 0.1)),
    ]


def looking_along_x(x: float, y: float, z: float) -> np.ndarray:
    """Return T_world_camera of a camera at x, y, z that looks along the world's x axis."""
    T = np.eye(4)
    T[:3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T[:3, 3] = x, y, z
    return T


def image_of_spheres(
    rng: np.random.Generator,
    T_world_camera: np.ndarray,
    spheres: list[tuple[float, float, float, float]],
    wall_m: float = 2.2,
    width: int = 48,
    height: int = 40,
    focal: float = 40.0,
    name: str = "camera",
) -> DepthImage:
    """Return what a camera sees of spheres (x, y, z, radius; world) before a wall, with holes in it."""
    camera = Intrinsics(width, height, focal, focal * 1.01, width / 2 - 0.3, height / 2 + 0.2, 0.001)
    depth = np.zeros((height, width), np.uint16)
    T_camera_world = np.linalg.inv(T_world_camera)
    for v in range(height):
        for u in range(width):
            ray = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
            nearest = wall_m
            for x, y, z, radius in spheres:
                centre = (T_camera_world @ np.array([x, y, z, 1.0]))[:3]
                along = ray @ centre
                rest = along**2 - (ray @ ray) * (centre @ centre - radius**2)
                if rest > 0 and along > np.sqrt(rest):
                    nearest = min(nearest, (along - np.sqrt(rest)) / (ray @ ray))
            depth[v, u] = round(nearest / camera.depth_scale)
    depth[rng.random(depth.shape) < 0.05] = 0
    depth[rng.random(depth.shape) < 0.01] = 65535
    return DepthImage(name, depth, camera, T_world_camera)
