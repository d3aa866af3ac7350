"""Views as a worse sensor somewhere else would have seen them: turned, tilted, moved, cut off, with readings lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter, minimum_filter, zoom
from scipy.spatial.transform import Rotation

from headvox.data import F64, DepthImage, Intrinsics
from headvox.evolve.views import View
from headvox.frames import inverse, transform

MOVED_M = (0.05, 0.05, 0.2)  # upwards by more: poses are seldom right about the floor,
TILTED_RAD = 0.05  # nor about the vertical: standard deviation, about either level axis
SPOILT_SHARE = 0.7  # of the views; the others are turned and moved only
EDGE_M = 0.10  # between neighbouring pixels: the edge of something
FAR_M = 9.0  # what no reading counts as, beside an edge
HEAD_M = 0.11  # radius, in an image
CUT_AT = -0.6, 1.2  # radii outwards from a head's centre: where the border that cuts it lies
MOST_CUT = 0.4  # of an image that shows no head

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


def cut_off(view: View, rng: Rng) -> View:
    """Return ``view`` with a side of each image moved inwards: through the head that is nearest to one, if any is."""
    before = view.frame.depths
    after = tuple(_cut_off(image, view.heads.centres, rng) for image in before)
    whole, left = (
        np.max([_inside(image, view.heads.centres)[0] for image in images], axis=0)
        for images in (before, after)
    )
    left = np.divide(left, whole, out=np.zeros_like(left), where=whole > 0.0)
    heads = replace(view.heads, visible=view.heads.visible * left, clear=view.heads.clear & (left == 1.0))
    return View(view.number, replace(view.frame, depths=after), heads)


def _cut_off(image: DepthImage, centres: F64, rng: Rng) -> DepthImage:
    """Return the image with one side moved inwards: through the head that is nearest to one, or anywhere."""
    lens = image.intrinsics
    inside, gaps, radii = _inside(image, centres)
    if (inside == 1.0).any():
        head, side = np.unravel_index(np.where(inside[:, None] == 1.0, gaps, np.inf).argmin(), gaps.shape)
        cut = gaps[head, side] - rng.uniform(*CUT_AT) * radii[head]
    else:
        side = rng.integers(4)
        cut = rng.uniform(0.0, MOST_CUT) * (lens.width, lens.height)[side // 2]
    first = np.where(np.arange(4) == side, max(0, round(cut)), 0)
    left, right, top, bottom = first.tolist()
    depth = np.ascontiguousarray(image.depth[top : lens.height - bottom, left : lens.width - right])
    height, width = depth.shape
    smaller = replace(lens, width=width, height=height, cx=lens.cx - left, cy=lens.cy - top)
    return replace(image, depth=depth, intrinsics=smaller)


def _inside(image: DepthImage, centres: F64) -> tuple[F64, F64, F64]:
    """Return which share of each head is within the image, its centre's distance from each side, and its radius.

    (N,), (N, 4) from the left, right, upper and lower side, and (N,), in pixels.
    """
    lens: Intrinsics = image.intrinsics
    x, y, z = transform(inverse(image.T_world_camera), centres).T
    ahead = np.maximum(z, HEAD_M)
    u, v = lens.fx * x / ahead + lens.cx, lens.fy * y / ahead + lens.cy
    radii = lens.fx * HEAD_M / ahead
    gaps = np.stack([u, lens.width - 1 - u, v, lens.height - 1 - v], axis=1)
    share = np.clip(0.5 + 0.5 * (gaps / radii[:, None]).min(axis=1), 0.0, 1.0)
    return np.where(z > HEAD_M, share, 0.0), gaps, radii


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
