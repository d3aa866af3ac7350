"""Pictures of the worst misses and false heads: the depth image about the place, and the points from side and above."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from headvox.data import F64, DepthImage, Frame
from headvox.evaluate.loop import Mishap
from headvox.evaluate.plots import save
from headvox.frames import inverse, transform, unproject

if TYPE_CHECKING:
    from matplotlib.axes import Axes

REACH_M = 0.7  # of what is shown about the place
DEEP_M = 0.6  # what is nearer or farther is shown as such, in the depth image
HEAD_M = 0.11
TRUE, UNCOUNTED, FOUND = "#2ca02c", "#888888", "#ff7f0e"


def picture_mishaps(title: str, mishaps: Sequence[Mishap], path: Path) -> None:
    """Draw a row for each mishap into a PNG file: what the camera saw, from the side, from above."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 3.6 * len(mishaps) + 0.5), layout="constrained")
    figure.suptitle(
        f"{title}   (green: true, grey: true but not counted, orange: found, +: here)", fontsize=10
    )
    panels = figure.subplots(len(mishaps), 3, squeeze=False)
    for (front, side, above), mishap in zip(panels, mishaps, strict=True):
        image = _best_view(mishap.frame, mishap.place)
        eye = mishap.place - np.eye(3)[0] if image is None else image.T_world_camera[:3, 3]
        _draw_depth(front, mishap, image)
        _draw_points(side, mishap, eye, from_above=False)
        _draw_points(above, mishap, eye, from_above=True)
        away = float(np.linalg.norm(mishap.place - eye))
        where = ", ".join(f"{v:.2f}" for v in mishap.place)
        front.set_title(
            f"frame {mishap.number}: ({where}) m" + (f", {away:.1f} m away" if image else ""), fontsize=9
        )
        often = f", here in {mishap.times} frames" if mishap.times > 1 else ""
        side.set_title(mishap.words + often, fontsize=9)
    save(figure, path)


def _best_view(frame: Frame, place: F64) -> DepthImage | None:
    """Return the image that shows the place, from the nearest camera; None where none does."""
    showing = []
    for image in frame.depths:
        pixel = _project(image, place[None])[0]
        inside = 0 <= pixel[0] < image.intrinsics.width and 0 <= pixel[1] < image.intrinsics.height
        if inside and pixel[2] > 0.1:
            showing.append((float(pixel[2]), image.name, image))
    return min(showing)[2] if showing else None


def _project(image: DepthImage, points: F64) -> F64:
    """Return column, row and depth (N, 3) of world points."""
    x, y, z = transform(inverse(image.T_world_camera), points).T
    safe = np.where(np.abs(z) < 1e-6, 1e-6, z)
    lens = image.intrinsics
    return np.stack([lens.fx * x / safe + lens.cx, lens.fy * y / safe + lens.cy, z], axis=1)


def _draw_depth(axes: Axes, mishap: Mishap, image: DepthImage | None) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    if image is None:
        axes.text(0.5, 0.5, "no depth image shows it", transform=axes.transAxes, ha="center", color="0.5")
        return
    u, v, z = _project(image, mishap.place[None])[0]
    half = image.intrinsics.fx * REACH_M / z
    metres = np.where(image.depth > 0, image.depth * image.intrinsics.depth_scale, np.nan)
    axes.set_facecolor("black")  # where nothing came back
    axes.imshow(metres, cmap="turbo_r", vmin=max(z - DEEP_M, 0.0), vmax=z + DEEP_M, interpolation="nearest")
    for centre, colour, _ in _heads(mishap):
        column, row, depth = _project(image, centre[None])[0]
        if depth > 0.1:
            _circle(axes, column, row, image.intrinsics.fx * HEAD_M / depth, colour)
    axes.plot([u], [v], "+", color="white", markersize=10)
    axes.set_xlim(u - half, u + half)
    axes.set_ylim(v + half, v - half)


def _draw_points(axes: Axes, mishap: Mishap, eye: F64, from_above: bool) -> None:
    """Draw the points about the place: with the viewer at the bottom (from above), or at the left (from the side)."""
    ahead = (mishap.place - eye) * [1.0, 1.0, 0.0]
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    left = np.array([-ahead[1], ahead[0], 0.0])
    up = np.array([0.0, 0.0, 1.0])
    across, along, deep = (-left, ahead, up) if from_above else (ahead, up, left)
    view = np.stack([across, along, deep], axis=1)
    points = (_points(mishap.frame) - mishap.place) @ view
    reach = REACH_M if from_above else 0.3  # a slice through the head is clearer than a shadow of everything
    near = points[(np.abs(points[:, :2]) < REACH_M).all(axis=1) & (np.abs(points[:, 2]) < reach)]
    near = near[:: max(len(near) // 20_000, 1)]
    axes.scatter(near[:, 0], near[:, 1], s=1.0, c=near[:, 2], cmap="viridis", linewidths=0)
    for centre, colour, score in _heads(mishap):
        x, y, z = (centre - mishap.place) @ view
        if max(abs(x), abs(y)) < REACH_M and abs(z) < REACH_M:
            _circle(axes, x, y, HEAD_M, colour)
            if score is not None:
                axes.annotate(f"{score:.1f}", (x + HEAD_M, y + HEAD_M), color=colour, fontsize=8)
    axes.plot([0.0], [0.0], "k+")
    axes.set_xlim(-REACH_M, REACH_M)
    axes.set_ylim(-REACH_M, REACH_M)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=7)
    axes.set_xlabel("from above, m" if from_above else "from the side, m", fontsize=8)


def _points(frame: Frame) -> F64:
    """Return all points of a frame in the world, (N, 3)."""
    parts = [unproject(image.depth, image.intrinsics, image.T_world_camera) for image in frame.depths]
    for cloud in frame.clouds:
        points = cloud.points[np.isfinite(cloud.points).all(axis=1)].astype(np.float64)
        parts.append(points if cloud.T_world_sensor is None else transform(cloud.T_world_sensor, points))
    return np.concatenate(parts)


def _heads(mishap: Mishap) -> list[tuple[F64, str, float | None]]:
    """Return centre, colour and score of every true and every found head."""
    true, found = mishap.true, mishap.found
    heads: list[tuple[F64, str, float | None]] = [
        (centre, TRUE if counts else UNCOUNTED, None)
        for centre, counts in zip(true.centres, mishap.counted, strict=True)
    ]
    return heads + [(c, FOUND, float(s)) for c, s in zip(found.centres, found.scores, strict=True)]


def _circle(axes: Axes, x: float, y: float, radius: float, colour: str) -> None:
    from matplotlib.patches import Circle

    axes.add_patch(Circle((x, y), radius, fill=False, color=colour, linewidth=1.8))
