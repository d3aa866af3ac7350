"""One picture a frame: the depth images with the heads in them, and beside them the whole scene."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from headvox.data import F64, DepthImage, Frame, State, Track
from headvox.render.colours import DEPTH, GROUND, INK, NOTHING, PALE, of_head, shade
from headvox.render.heads import Overlay
from headvox.render.scene import Viewpoint, draw_scene, points_of, viewpoint_for
from headvox.sinks import Result

NEAR_M, FAR_M = 0.6, 6.0  # what the colours of depth span
TRAIL_S = 3.0
GAP = 8
TALL = 0.46  # of the width: how tall the sheet is, at most
LOWEST = 0.36
IMAGES = 0.48  # of the width: what the depth images take, at most


@dataclass(frozen=True, slots=True)
class Layout:
    """Where things are on a sheet: pixels."""

    size: tuple[int, int]
    cell: tuple[int, int]
    """Width and height of what a depth image gets."""
    columns: int
    scene: tuple[int, int, int, int]
    """Left, top, width and height of the scene."""


def layout(images: tuple[DepthImage, ...], width: int) -> Layout:
    """Return where the depth images and the scene go on a sheet of ``width``: the images as large as they can be."""
    if not images:
        height = _even(width * 0.62)
        return Layout((width, height), (0, 0), 0, (0, 0, width, height))
    aspect = max(image.intrinsics.width / image.intrinsics.height for image in images)
    best = (0.0, 1, 1)
    for columns in range(1, len(images) + 1):
        rows = -(-len(images) // columns)
        tall = (TALL * width - GAP * (rows - 1)) / rows
        wide = (IMAGES * width - GAP * (columns - 1)) / columns
        best = max(best, (min(tall, wide / aspect), -columns, rows))
    tall, columns, rows = best[0], -best[1], best[2]
    cell = int(tall * aspect), int(tall)
    height = _even(max(rows * (cell[1] + GAP) - GAP, LOWEST * width))
    left = columns * (cell[0] + GAP)
    return Layout((width, height), cell, columns, (left, 0, width - left, height))


def _even(length: float) -> int:
    """Return ``length`` in whole pixels, an even number: films need that."""
    return 2 * round(length / 2)


class Sheets:
    """Draws frames one after another, all from the viewpoint that the first one asks for."""

    def __init__(self, width: int) -> None:
        self._width = _even(width)
        self._layout: Layout | None = None
        self._view: Viewpoint | None = None
        self._trails: dict[int, deque[tuple[int, F64]]] = {}

    def follow(self, result: Result) -> None:
        """Remember where the heads of a frame are, whether or not it is drawn."""
        for track in result.rows():
            if track.id:
                self._trails.setdefault(track.id, deque()).append((result.stamp_ns, np.array(track.centre)))
        oldest = result.stamp_ns - round(1e9 * TRAIL_S)
        for trail in self._trails.values():
            while trail and trail[0][0] < oldest:
                trail.popleft()
        self._trails = {identity: trail for identity, trail in self._trails.items() if trail}

    def draw(self, frame: Frame, result: Result) -> Image.Image:
        """Return the picture of a frame, RGB, of the same size for all."""
        points, tracks = points_of(frame), list(result.rows())
        if self._layout is None or self._view is None:
            self._layout = layout(frame.depths, self._width)
            self._view = viewpoint_for(frame, points, *self._layout.scene[2:])
        where = self._layout
        sheet = Image.new("RGB", where.size, GROUND)
        for n, image in enumerate(frame.depths):
            drawn = draw_depth(image, tracks, where.cell)
            row, column = divmod(n, max(where.columns, 1))
            left, top = column * (where.cell[0] + GAP), row * (where.cell[1] + GAP)
            sheet.paste(drawn, (left, top + _spare(where, len(frame.depths)) // 2))
        scene = draw_scene(frame, points, self._view)
        overlay = Overlay(self._view.camera, self._view.T_world_camera, 1.0)
        for identity, trail in self._trails.items():
            overlay.trail(np.array([place for _, place in trail]), of_head(identity))
        for track in tracks:
            _plumb(overlay, track)
        overlay.heads(tracks)
        overlay.note(f"frame {result.frame}   {_count(result)}   grid 1 m")
        overlay.onto(scene)
        sheet.paste(scene, where.scene[:2])
        return sheet


def _count(result: Result) -> str:
    heads = len(result.heads)
    return f"{heads} head{'s' * (heads != 1)}"


def _spare(where: Layout, images: int) -> int:
    """Return how many rows of pixels the depth images leave free."""
    rows = -(-images // max(where.columns, 1))
    return max(where.size[1] - rows * (where.cell[1] + GAP) + GAP, 0)


def _plumb(overlay: Overlay, track: Track) -> None:
    """Draw a line from a head to the floor: it tells where in the room the head is."""
    if track.state == State.COASTING:
        return
    foot = np.array([track.centre[0], track.centre[1], 0.0])
    overlay.path(np.stack([track.centre, foot]), of_head(track.id), 0.6)
    around = np.linspace(0.0, 2.0 * np.pi, 25)
    ring = foot + 0.12 * np.stack([np.cos(around), np.sin(around), np.zeros(25)], axis=1)
    overlay.path(ring, of_head(track.id), 1.0)


def draw_depth(image: DepthImage, tracks: list[Track], cell: tuple[int, int]) -> Image.Image:
    """Return a depth image in colours, near red and far blue, with the heads drawn in, as large as fits ``cell``."""
    lens = image.intrinsics
    scale = min(cell[0] / lens.width, cell[1] / lens.height)
    colours = shade(image.depth * lens.depth_scale, NEAR_M, FAR_M, DEPTH)
    colours[image.depth == 0] = NOTHING
    size = round(lens.width * scale), round(lens.height * scale)
    drawn = Image.fromarray(colours).resize(
        size, Image.Resampling.BOX if scale < 1 else Image.Resampling.NEAREST
    )
    overlay = Overlay(lens, image.T_world_camera, scale)
    overlay.heads(tracks)
    overlay.onto(drawn)
    ImageDraw.Draw(drawn).text(
        (8, 6), image.name, PALE, ImageFont.load_default(14), stroke_width=2, stroke_fill=INK
    )
    return drawn
