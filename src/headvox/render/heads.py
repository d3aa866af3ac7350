"""A head drawn into a picture: the edges of a box about it, its face filled, its id, and where it came from.

Everything is drawn through a pinhole camera, a real one or the one that looks at the whole scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from headvox.data import F64, Intrinsics, State, Track
from headvox.frames import inverse, placed, transform
from headvox.render.colours import GROUND, INK, PALE, RGB, of_head

SIZE_M = np.array([0.20, 0.16, 0.25])
"""Front to back, ear to ear, chin to crown: a little larger than a head, so that the points inside are seen."""
NEAR_M = 0.15  # what is nearer to the camera is not drawn
FINER = 2  # overlays are drawn that much larger, and made smaller: smooth lines
ABOVE_M = np.array([0.0, 0.0, 0.6 * SIZE_M[2]])  # where the id is written
CORNERS = np.array(list(product((-0.5, 0.5), repeat=3))) * SIZE_M
EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]
FACE = (4, 5, 7, 6)  # the corners with x > 0, in order around
NOSE = np.array([[0.5 * SIZE_M[0], 0.0, 0.0], [0.5 * SIZE_M[0] + 0.16, 0.0, 0.0]])


class Overlay:
    """A transparent picture to draw on in the world's coordinates, and to lay over another."""

    def __init__(self, camera: Intrinsics, T_world_camera: F64, scale: float) -> None:
        """``scale`` is pixels of the final picture per pixel of ``camera``."""
        self._camera, self._T_camera_world = camera, inverse(T_world_camera)
        self._scale = scale * FINER
        size = round(camera.width * scale) * FINER, round(camera.height * scale) * FINER
        self._layer = Image.new("RGBA", size, (*GROUND, 0))
        self._draw = ImageDraw.Draw(self._layer)

    def heads(self, tracks: Sequence[Track]) -> None:
        """Draw heads, the farthest first."""
        away = [-float(transform(self._T_camera_world, t.centre[None])[0, 2]) for t in tracks]
        for n in np.argsort(away, kind="stable"):
            self._head(tracks[n])

    def _head(self, track: Track) -> None:
        colour, lost = of_head(track.id), track.state == State.COASTING
        if np.isfinite(track.quaternion).all():
            self._box(track, colour, lost)
        else:
            self._ring(track, colour, lost)
        if track.id:
            self._name(str(track.id), track.centre + ABOVE_M, colour)

    def _box(self, track: Track, colour: RGB, lost: bool) -> None:
        T_world_head = placed(track.centre, track.quaternion)
        corners = self._pixels(transform(T_world_head, CORNERS))
        nose = self._pixels(transform(T_world_head, NOSE))
        if corners is None or nose is None:
            return
        self._blend([tuple(corners[n]) for n in FACE], (*colour, 50 if lost else 110))
        for a, b in EDGES:
            self.line(corners[[a, b]], PALE, 3.6)
        self.line(nose, PALE, 4.6)
        for a, b in EDGES:
            self.line(corners[[a, b]], colour, 1.0 if lost else 1.8)
        self.line(nose, colour, 1.4 if lost else 2.6)

    def _ring(self, track: Track, colour: RGB, lost: bool) -> None:
        middle = self._pixels(track.centre[None])
        if middle is None:
            return
        depth = transform(self._T_camera_world, track.centre[None])[0, 2]
        u, v = middle[0]
        for ink, width in ((PALE, 3.6), (colour, 1.0 if lost else 1.8)):
            r = 1.3 * track.radius * self._camera.fx * self._scale / depth + 0.5 * width * FINER
            self._draw.ellipse((u - r, v - r, u + r, v + r), outline=ink, width=round(width * FINER))

    def trail(self, places: F64, colour: RGB) -> None:
        """Draw where a head was, (N, 3) world, the oldest first and faintest."""
        pixels = self._pixels(places)
        if pixels is None or len(pixels) < 2:
            return
        for n in range(len(pixels) - 1):
            alpha = round(40 + 215 * (n + 1) / len(pixels))
            self._draw.line([*pixels[n], *pixels[n + 1]], fill=(*colour, alpha), width=round(2.2 * FINER))

    def path(self, places: F64, colour: RGB, width: float = 1.0) -> None:
        """Draw lines through ``places``, (N, 3) world."""
        pixels = self._pixels(places)
        if pixels is not None:
            self.line(pixels, colour, width)

    def area(self, places: F64, colour: RGB) -> None:
        """Fill the polygon through ``places``, (N, 3) world."""
        pixels = self._pixels(places)
        if pixels is not None:
            self._draw.polygon(pixels.reshape(-1).tolist(), fill=(*colour, 255))

    def line(self, pixels: F64, colour: RGB, width: float) -> None:
        """Draw lines through ``pixels``, (N, 2) of the layer."""
        self._draw.line(
            pixels.reshape(-1).tolist(), fill=(*colour, 255), width=round(width * FINER), joint="curve"
        )

    def words(self, text: str, at: F64) -> None:
        """Write a few words over a place of the world, (3,)."""
        pixels = self._pixels(at[None])
        if pixels is not None:
            self._text(text, pixels[0], 11, "ms")

    def note(self, text: str) -> None:
        """Write a few words into the lower right corner."""
        self._text(text, np.array(self._layer.size) - 8.0 * FINER, 12, "rs")

    def onto(self, picture: Image.Image) -> None:
        """Lay it over ``picture``, which is as large."""
        small = self._layer.resize(picture.size, Image.Resampling.BOX)
        picture.paste(small, (0, 0), small)

    def _name(self, text: str, at: F64, colour: RGB) -> None:
        pixels = self._pixels(at[None])
        if pixels is None:
            return
        (u, v), font = pixels[0], ImageFont.load_default(13 * FINER)
        half = 0.5 * font.getlength(text) + 4 * FINER
        bottom = max(v - 3 * FINER, 18 * FINER)  # a head at the upper border keeps its name
        top = bottom - 16 * FINER
        self._draw.rounded_rectangle(
            (u - half, top, u + half, bottom), 4 * FINER, (*colour, 255), (*PALE, 255), FINER
        )
        self._draw.text((u, 0.5 * (top + bottom)), text, (*PALE, 255), font, "mm")

    def _text(self, text: str, at: F64, size: int, anchor: str) -> None:
        font = ImageFont.load_default(size * FINER)
        u, v = at.tolist()
        self._draw.text(
            (u, v), text, (*INK, 255), font, anchor, stroke_width=2 * FINER, stroke_fill=(*GROUND, 255)
        )

    def _blend(self, polygon: list[tuple[float, ...]], colour: tuple[int, int, int, int]) -> None:
        """Fill a polygon over what is there, not instead of it."""
        glass = Image.new("RGBA", self._layer.size, (*colour[:3], 0))
        ImageDraw.Draw(glass).polygon(polygon, fill=colour)
        self._layer.alpha_composite(glass)

    def _pixels(self, places: F64) -> F64 | None:
        """Return where ``places`` (N, 3) are in the layer, (N, 2); None where any is behind the camera."""
        x, y, z = transform(self._T_camera_world, places).T
        if (z < NEAR_M).any():
            return None
        camera = self._camera
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        return (np.stack([u, v], axis=1) + 0.5) * self._scale
