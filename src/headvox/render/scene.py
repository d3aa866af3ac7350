"""All points of a frame seen by a camera that nobody has: from above, over the shoulders of the real ones."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image

from headvox.data import F64, DepthImage, Frame, Intrinsics
from headvox.frames import inverse, transform, unproject
from headvox.render.colours import FAINT, FLOOR, GROUND, HEIGHT, INK, shade
from headvox.render.heads import Overlay

LOW_M, HIGH_M = 0.0, 2.0  # what the colours of height span
DEEPEST_M, HEADROOM_M = -0.3, 2.0  # what is higher hides what is below
STAGE_M = 2.2  # half of the stage's edge: walls behind would hide what is before them
MOST_M = 6.0  # the same, where only the points tell
AHEAD_M = 2.4  # of a sensor: the middle of what it looks at
FIELD_DEG = 36.0
RISE_DEG = 42.0  # how steeply it looks down
ASIDE_DEG = 28.0  # how far it stands beside the real camera
FINER = 2
LARGEST_DOT = 7
SOME = 16  # every 16th point is enough to tell where to look
BESIDE_PX = 4  # the neighbours that a normal is made of
FROM_BEHIND = -0.1  # cosine from which on a surface is seen from behind: a wall that hides the room
DARKEN = 9.0  # how black an edge gets, a doubling of depth apart
FRUSTUM_M = 0.35


Stage = tuple[float, float, float, float]
"""x low, x high, y low, y high: metres, world."""


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """A camera to look at the scene with, and the part of the floor that is shown, with what stands on it."""

    camera: Intrinsics
    T_world_camera: F64
    stage: Stage


@dataclass(frozen=True, slots=True)
class Points:
    """Points of the world (N, 3), which way their surface faces (N, 3), and how far apart neighbours are, (N,) metres.

    What faces nowhere, (0, 0, 0), is not a surface that is known.
    """

    places: F64
    normals: F64
    spacing: F64

    def only(self, chosen: npt.NDArray[np.bool_]) -> Points:
        """Return some of the points."""
        return Points(self.places[chosen], self.normals[chosen], self.spacing[chosen])


def points_of(frame: Frame) -> Points:
    """Return the points of all sensors."""
    parts = []
    for image in frame.depths:
        places = unproject(image.depth, image.intrinsics, image.T_world_camera)
        depth = image.depth[image.depth > 0].astype(np.float64) * image.intrinsics.depth_scale
        points = Points(places, _normals(image, places), depth / image.intrinsics.fx)
        parts.append(
            points.only(np.any(points.normals, axis=1))
        )  # the others are edges, and what flies about them
    for cloud in frame.clouds:
        places = cloud.points[np.isfinite(cloud.points).all(axis=1)].astype(np.float64)
        if cloud.T_world_sensor is not None:
            places = transform(cloud.T_world_sensor, places)
        parts.append(Points(places, np.zeros_like(places), np.full(len(places), _spacing(places))))
    return Points(
        np.concatenate([part.places for part in parts]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.spacing for part in parts]),
    )


def _normals(image: DepthImage, places: F64) -> F64:
    """Return the normals, towards the camera, of the pixels that have a return."""
    rows, columns = image.depth.shape
    dense = np.full((rows, columns, 3), np.nan)
    dense[image.depth > 0] = places
    normals = np.zeros_like(dense)
    k = BESIDE_PX
    down, right = dense[2 * k :, k:-k] - dense[: -2 * k, k:-k], dense[k:-k, 2 * k :] - dense[k:-k, : -2 * k]
    normals[k:-k, k:-k] = np.cross(down, right)
    found: F64 = np.nan_to_num(normals[image.depth > 0])
    length = np.linalg.norm(found, axis=1, keepdims=True)
    return _divided(found, length)


def _spacing(places: F64) -> float:
    """Return about how far apart the points of a surface are: as if it were two squares as large as their box."""
    if len(places) == 0:
        return 0.0
    low, high = np.percentile(places, (2, 98), axis=0)
    return float(math.sqrt(2.0 * np.prod(np.sort(high - low)[1:]) / len(places)))


def viewpoint_for(frame: Frame, points: Points, width: int, height: int) -> Viewpoint:
    """Return a camera of ``width`` x ``height`` pixels that just sees the points on the stage, and the sensors."""
    stage = _stage(frame, points)
    places = _on_stage(points, stage).places[::SOME]
    low, high = np.percentile(places, (1, 99), axis=0) if len(places) else (np.zeros(3), np.zeros(3))
    places = places[((places >= low) & (places <= high)).all(axis=1)]
    sensors = np.array([image.T_world_camera[:3, 3] for image in frame.depths]).reshape(-1, 3)
    # Somebody may walk wherever there is anything.
    corners = np.concatenate(
        [places * (1.0, 1.0, 0.0) + (0.0, 0.0, z) for z in (0.0, HEADROOM_M)] + [sensors]
    )
    if len(places) == 0:
        corners = np.concatenate([corners, np.zeros((1, 3))])
    focal = 0.5 * height / math.tan(math.radians(0.5 * FIELD_DEG))
    camera = Intrinsics(width, height, focal, focal, 0.5 * width - 0.5, 0.5 * height - 0.5)
    return Viewpoint(camera, _framed(corners, _heading(frame), camera), stage)


def _stage(frame: Frame, points: Points) -> Stage:
    """Return the part of the floor to show: about where the sensors look, or else about the points."""
    if frame.depths:
        T = np.stack([image.T_world_camera for image in frame.depths])
        looked_at = T[:, :2, 3] + AHEAD_M * _unit(T[:, :2, 2])
        middle = looked_at.mean(axis=0)
        halves = np.full(2, STAGE_M)
        if len(T) > 1:
            halves = np.maximum(halves, np.abs(T[:, :2, 3] - middle).max(axis=0) + 0.3)
    else:
        places = points.places if len(points.places) else np.zeros((1, 3))
        low, high = np.percentile(places[:, :2], (2, 98), axis=0)
        middle, halves = 0.5 * (low + high), np.clip(0.55 * (high - low), 0.5, MOST_M)
    (x, y), (dx, dy) = middle.tolist(), halves.tolist()
    return x - dx, x + dx, y - dy, y + dy


def _unit(vectors: F64) -> F64:
    """Return ``vectors`` (N, 2) of length 1; one of none stays."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return _divided(vectors, np.where(length > 1e-3, length, 0.0))


def _divided(vectors: F64, lengths: F64) -> F64:
    """Return ``vectors`` by their ``lengths``; 0 where the length is."""
    unit: F64 = np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)
    return unit


def _heading(frame: Frame) -> float:
    """Return the heading to look in, radians from x towards y: as the sensors, or across if they face each other."""
    forward = np.array([image.T_world_camera[:2, 2] for image in frame.depths]).reshape(-1, 2)
    if len(forward) == 0:
        return math.radians(60.0)
    mean = forward.mean(axis=0)
    if np.linalg.norm(mean) > 0.3:
        return math.atan2(mean[1], mean[0]) + math.radians(ASIDE_DEG)
    return math.atan2(forward[0, 1], forward[0, 0]) + math.radians(90.0 - ASIDE_DEG)


def _framed(box: F64, heading: float, camera: Intrinsics) -> F64:
    """Return T_world_camera of a camera that looks along ``heading`` and down, so that ``box`` (N, 3) just fits in."""
    rise = math.radians(RISE_DEG)
    forward = np.array(
        [math.cos(heading) * math.cos(rise), math.sin(heading) * math.cos(rise), -math.sin(rise)]
    )
    right = np.array([math.sin(heading), -math.cos(heading), 0.0])
    R = np.stack([right, np.cross(forward, right), forward], axis=1)
    local = box @ R
    # Of all corners, each limits how near the camera may come: solve the two axes by themselves, take the farther.
    x_reach, y_reach = camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)
    x, x_back = _fit(local[:, 0], local[:, 2], x_reach)
    y, y_back = _fit(local[:, 1], local[:, 2], y_reach)
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = R @ np.array([x, y, min(x_back, y_back)])
    return T


def _fit(across: F64, along: F64, reach: float) -> tuple[float, float]:
    """Return the place across, and the farthest along, from where all points are within ``reach`` of the axis."""
    # |across - c| <= reach * (along - d): the tightest lower and upper lines meet at (c, d).
    upper, lower = (across - reach * along).max(), (across + reach * along).min()
    return float(0.5 * (upper + lower)), float((lower - upper) / (2 * reach))


def draw_scene(frame: Frame, points: Points, view: Viewpoint) -> Image.Image:
    """Return the points over a floor of metres, coloured by height, with the sensors that saw them."""
    picture = Image.new("RGB", (view.camera.width, view.camera.height), GROUND)
    floor = Overlay(view.camera, view.T_world_camera, 1.0)
    x_low, x_high, y_low, y_high = view.stage
    corners = [(x_low, y_low, 0.0), (x_high, y_low, 0.0), (x_high, y_high, 0.0), (x_low, y_high, 0.0)]
    floor.area(np.array(corners), FLOOR)
    for x in range(math.ceil(x_low), math.floor(x_high) + 1):
        floor.path(np.array([[x, y_low, 0.0], [x, y_high, 0.0]]), FAINT)
    for y in range(math.ceil(y_low), math.floor(y_high) + 1):
        floor.path(np.array([[x_low, y, 0.0], [x_high, y, 0.0]]), FAINT)
    floor.onto(picture)
    points = _on_stage(points, view.stage)
    sight = points.places - view.T_world_camera[:3, 3]
    facing = -(sight * points.normals).sum(axis=1) / np.linalg.norm(sight, axis=1)
    colours, covered = _splat(points.only(facing > FROM_BEHIND), view)
    dots = Image.fromarray(colours).resize(picture.size, Image.Resampling.BOX)
    mask = Image.fromarray(covered).resize(picture.size, Image.Resampling.BOX)
    picture.paste(dots, (0, 0), mask)
    sensors = Overlay(view.camera, view.T_world_camera, 1.0)
    for image in frame.depths:
        _frustum(sensors, image.intrinsics, image.T_world_camera, image.name)
    sensors.onto(picture)
    return picture


def _on_stage(points: Points, stage: Stage) -> Points:
    """Return the points over that part of the floor, and below the ceiling."""
    x, y, z = points.places.T
    x_low, x_high, y_low, y_high = stage
    shown = (x > x_low) & (x < x_high) & (y > y_low) & (y < y_high) & (z > DEEPEST_M) & (z < HEADROOM_M)
    return points.only(shown)


def _splat(points: Points, view: Viewpoint) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """Return every point as a square that fills the gap to its neighbours, nearest in front; and what is covered."""
    camera = view.camera
    width, height = camera.width * FINER, camera.height * FINER
    local = transform(inverse(view.T_world_camera), points.places)
    ahead = local[:, 2] > 0.2
    x, y, z = local[ahead].T
    u = ((camera.fx * x / z + camera.cx + 0.5) * FINER).astype(np.int64)
    v = ((camera.fy * y / z + camera.cy + 0.5) * FINER).astype(np.int64)
    dot = np.clip(1.5 * points.spacing[ahead] * camera.fx * FINER / z, 2, LARGEST_DOT).astype(np.int64)
    nearest = np.full(width * height, np.inf, np.float32)
    z = z.astype(np.float32)
    hits = []
    for row in range(int(dot.max(initial=0))):
        for column in range(int(dot.max(initial=0))):
            U, V = u + column - dot // 2, v + row - dot // 2
            here = np.flatnonzero((dot > max(row, column)) & (U >= 0) & (width > U) & (V >= 0) & (height > V))
            pixel = V[here] * width + U[here]
            np.minimum.at(nearest, pixel, z[here])
            hits.append((here, pixel))
    colour = shade(points.places[ahead, 2], LOW_M, HIGH_M, HEIGHT)
    canvas = np.full((width * height, 3), GROUND, np.uint8)
    for here, pixel in hits:
        front = z[here] <= nearest[pixel]
        canvas[pixel[front]] = colour[here[front]]
    deep = nearest.reshape(height, width)
    lit = canvas.reshape(height, width, 3) * _edges(deep)[..., None]
    return lit.astype(np.uint8), np.where(np.isfinite(deep), 255, 0).astype(np.uint8)


def _edges(depth: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return how bright each pixel is, (height, width) in (0, 1]: dark where its neighbours are nearer.

    Eye-dome lighting: C. Boucheny, Interactive Scientific Visualization of Large Datasets, 2009.
    """
    log = np.log2(np.where(np.isfinite(depth), depth, np.float32(1e6)))
    padded, reach = np.pad(log, 2 * FINER, mode="edge"), 2 * FINER
    nearer = np.zeros_like(log)
    rows, columns = log.shape
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        top, left = reach + down * FINER, reach + right * FINER
        nearer += np.maximum(log - padded[top : top + rows, left : left + columns], 0)
    bright: npt.NDArray[np.float32] = np.exp(-DARKEN * np.minimum(nearer / 4, 0.25)).astype(np.float32)
    return bright


def _frustum(overlay: Overlay, lens: Intrinsics, T_world_camera: F64, name: str) -> None:
    """Draw a sensor as the pyramid that it looks through."""
    ends = [
        ((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, 1.0)
        for u, v in ((0, 0), (lens.width, 0), (lens.width, lens.height), (0, lens.height))
    ]
    corners = transform(T_world_camera, np.array(ends) * FRUSTUM_M)
    eye = T_world_camera[:3, 3]
    for n in range(4):
        overlay.path(np.stack([eye, corners[n], corners[(n + 1) % 4]]), INK, 1.4)
    overlay.words(name, eye + np.array([0.0, 0.0, 0.16]))
