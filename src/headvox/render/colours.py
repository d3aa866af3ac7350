"""The colours of depth, of height, and of heads."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

U8 = npt.NDArray[np.uint8]
RGB = tuple[int, int, int]

GROUND: RGB = (255, 255, 255)
NOTHING: RGB = (52, 56, 64)
"""Where a depth image has no return."""
INK: RGB = (34, 38, 43)
FLOOR: RGB = (244, 245, 247)
FAINT: RGB = (218, 221, 226)
PALE: RGB = (250, 250, 250)

HEADS: tuple[RGB, ...] = (
    (230, 25, 75), (0, 110, 220), (0, 150, 70), (245, 130, 0), (145, 30, 180), (0, 165, 175), (200, 0, 140),
    (120, 80, 20),
)  # fmt: skip
"""By the id of a track; a head without one is drawn in INK."""

# Eleven colours of Matplotlib's maps (CC0), equal steps apart: near is red, far is blue; low is violet, high is yellow.
_TURBO = (
    (48, 18, 59), (69, 91, 205), (62, 156, 254), (24, 215, 203), (72, 248, 130), (164, 252, 60), (226, 220, 56),
    (254, 163, 49), (239, 89, 17), (194, 36, 3), (122, 4, 3),
)  # fmt: skip
_VIRIDIS = (
    (68, 1, 84), (72, 36, 117), (65, 68, 135), (53, 95, 141), (42, 120, 142), (33, 145, 140), (34, 168, 132),
    (68, 191, 112), (122, 209, 81), (189, 223, 38), (253, 231, 37),
)  # fmt: skip
SHADES = 28
"""Few colours make a small gif."""


def _map(anchors: tuple[RGB, ...], first: float, last: float) -> U8:
    """Return ``SHADES`` colours, (SHADES, 3), between two places of a map, 0 its beginning and 1 its end."""
    table = np.array(anchors, np.float64)
    places = np.linspace(first, last, SHADES) * (len(table) - 1)
    channels = [np.interp(places, np.arange(len(table)), table[:, k]) for k in range(3)]
    return np.stack(channels, axis=1).round().astype(np.uint8)


DEPTH = _map(_TURBO, 0.92, 0.06)
HEIGHT = _map(_VIRIDIS, 0.2, 0.97)
HEIGHT[:2] = (203, 207, 216)  # the floor is not what one looks at


def shade(values: npt.NDArray[np.floating], low: float, high: float, colours: U8) -> U8:
    """Return the colours (..., 3) of ``values`` (...), in equal steps from ``low`` to ``high``; beyond, the ends."""
    steps = np.clip((values - low) / (high - low) * len(colours), 0, len(colours) - 1)
    shaded: U8 = colours[steps.astype(np.int64)]
    return shaded


def of_head(identity: int) -> RGB:
    """Return the colour of the track with this id; 0 has none."""
    return HEADS[(identity - 1) % len(HEADS)] if identity > 0 else INK
