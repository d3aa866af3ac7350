"""Views as a worse sensor somewhere else would have seen them: turned, tilted, moved, with readings lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter, minimum_filter, zoom
from scipy.spatial.transform import Rotation

from headvox.data import DepthImage
from headvox.evolve.views import View
from headvox.frames import transform

MOVED_M = (0.05, 0.05, 0.2)  # upwards by more: poses are seldom right about the floor,
TILTED_RAD = 0.05  # nor about the vertical: standard deviation, about either level axis
SPOILT_SHARE = 0.7  # of the views; the others are turned and moved only
EDGE_M = 0.10  # between neighbouring pixels: the edge of something
FAR_M = 9.0  # what no reading counts as, beside an edge

Rng = np.random.Generator
Mask = npt.NDArray[np.bool_]


def spoil(view: View, rng: Rng) -> View:
    """Return ``view`` turned about the vertical, tilted and moved a little, most of its images with readings lost."""
    turned, tilted = rng.uniform(0.0, 2.0 * np.pi), rng.normal(0.0, TILTED_RAD, 2)
    eye, T = view.frame.depths[0].T_world_camera[:3, 3], np.eye(4)  # tilted about where it stands
    T[:3, :3] = (Rotation.from_euler("z", turned) * Rotation.from_rotvec([*tilted, 0.0])).as_matrix()
    T[:3, 3] = Rotation.from_euler("z", turned).apply(eye) - T[:3, :3] @ eye
    T[:3, 3] += rng.uniform(-1.0, 1.0, 3) * MOVED_M
    images = tuple(replace(image, T_world_camera=T @ image.T_world_camera) for image in view.frame.depths)
    if rng.random() < SPOILT_SHARE:
        images = tuple(_lose_readings(image, rng) for image in images)
    heads = replace(view.heads, centres=transform(T, view.heads.centres))
    return View(view.number, replace(view.frame, depths=images), heads)


def _lose_readings(image: DepthImage, rng: Rng) -> DepthImage:
    """Cut off what is far, and take out patches along edges, patches anywhere, and single pixels: each now and then."""
    depth = image.depth.copy()
    far = depth * np.float32(image.intrinsics.depth_scale)
    if rng.random() < 0.3:
        depth[far > rng.uniform(2.5, 6.0)] = 0
    if rng.random() < 0.5:
        width, size, level = int(rng.integers(1, 5)), int(rng.integers(8, 24)), rng.uniform(-0.3, 0.8)
        depth[_edges(far, width) & (_waves(depth.shape, size, rng) > level)] = 0
    if rng.random() < 0.3:
        size, level = int(rng.integers(6, 30)), rng.uniform(0.9, 1.6)
        depth[_waves(depth.shape, size, rng) > level] = 0
    if rng.random() < 0.2:
        depth[rng.random(depth.shape) < rng.uniform(0.02, 0.15)] = 0
    return replace(image, depth=depth)


def _edges(far: npt.NDArray[np.float32], width: int) -> Mask:
    """Return the pixels within ``width`` of a jump in depth."""
    nearest = minimum_filter(np.where(far > 0.0, far, FAR_M), 3)
    edges: Mask = maximum_filter(maximum_filter(far, 3) - nearest > EDGE_M, 2 * width + 1)
    return edges


def _waves(shape: tuple[int, ...], size: int, rng: Rng) -> npt.NDArray[np.float32]:
    """Return smooth noise of about unit strength, ``size`` pixels from crest to trough."""
    rough = rng.normal(size=(shape[0] // size + 3, shape[1] // size + 3)).astype(np.float32)
    smooth: npt.NDArray[np.float32] = zoom(rough, size, order=1)[: shape[0], : shape[1]]
    return smooth
