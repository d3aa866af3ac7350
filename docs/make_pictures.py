"""Make the pictures of README and docs: what the detector says of the sample, and the cascades.

    python docs/make_pictures.py [--out docs/pictures] [--recording FOLDER]

``sample.gif`` shows every frame of a recording: the depth image of each camera with the heads drawn in, and all points
from above. ``cascade-NAME.png`` is the overview that ``headvox masks plot NAME`` draws. Needs the extra ``plot``.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import matplotlib as mpl
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import headvox
from headvox.data import DepthImage, Frame, Heads
from headvox.frames import inverse, transform, unproject
from headvox.masks import load_cascade, shipped_cascades
from headvox.plot_masks import plot_cascade

NEAR_M, FAR_M = 0.8, 5.0  # what the colours of depth span
LOW_M, HIGH_M = 0.0, 2.0  # what the colours of height span
SHADES = 48  # few colours make a small file
ABOVE_M = 6.8  # edge of the view from above
GROUND = (18, 20, 24)
RING = (255, 255, 255)
TEXT = (235, 238, 242)
GAP = 6


def palette(name: str, dark: float = 0.0) -> np.ndarray:
    """Return ``SHADES`` colours (SHADES, 3) uint8, the ends of the map left out by ``dark``."""
    shades = mpl.colormaps[name](np.linspace(dark, 1.0 - dark, SHADES))[:, :3]
    return (255 * shades).round().astype(np.uint8)


DEPTH_COLOURS = palette("turbo", 0.06)[::-1]
HEIGHT_COLOURS = palette("viridis")


def shade(values: np.ndarray, low: float, high: float, colours: np.ndarray) -> np.ndarray:
    """Return the colours of ``values``, equal steps from ``low`` to ``high``."""
    steps = np.clip((values - low) / (high - low) * SHADES, 0, SHADES - 1)
    return colours[steps.astype(np.int64)]


def picture_of_depth(image: DepthImage, heads: Heads) -> Image.Image:
    """Return a depth image in colours, dark where nothing came back, with a circle about every head."""
    metres = image.depth * image.intrinsics.depth_scale
    colours = shade(metres, NEAR_M, FAR_M, DEPTH_COLOURS)
    colours[metres == 0.0] = GROUND
    drawn = Image.fromarray(colours.astype(np.uint8))
    draw = ImageDraw.Draw(drawn)
    camera = image.intrinsics
    local = transform(inverse(image.T_world_camera), heads.centres)
    for (x, y, z), radius in zip(local, heads.radii, strict=True):
        if z < 0.2:
            continue
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        ring(draw, u, v, 1.25 * camera.fx * radius / z)
    label(draw, image.name)
    return drawn


def picture_from_above(frame: Frame, heads: Heads, edge: int) -> Image.Image:
    """Return all points from above, coloured by height, the highest in front; cameras and heads drawn in."""
    scale = edge / ABOVE_M
    places = np.array([image.T_world_camera[:3, 3] for image in frame.depths])
    middle = places.mean(axis=0)

    def pixel(points: np.ndarray) -> np.ndarray:
        east, north = points[..., 0] - middle[0], points[..., 1] - middle[1]
        return np.stack([edge / 2 + scale * east, edge / 2 - scale * north], axis=-1)

    canvas = np.full((edge, edge, 3), GROUND, np.uint8)
    points = np.concatenate([unproject(i.depth, i.intrinsics, i.T_world_camera) for i in frame.depths])
    points = points[points[:, 2] < HIGH_M + 0.3]
    points = points[np.argsort(points[:, 2], kind="stable")]
    u, v = pixel(points).astype(np.int64).T
    inside = (u >= 0) & (v >= 0) & (u < edge) & (v < edge)
    canvas[v[inside], u[inside]] = shade(points[inside, 2], LOW_M, HIGH_M, HEIGHT_COLOURS)
    drawn = Image.fromarray(canvas)
    draw = ImageDraw.Draw(drawn)
    for image in frame.depths:
        T, lens = image.T_world_camera, image.intrinsics
        sides = np.array([[(end - lens.cx) / lens.fx, 0.0, 1.0] for end in (0, lens.width)]) * 0.45
        corners = pixel(transform(T, np.concatenate([np.zeros((1, 3)), sides])))
        draw.polygon([tuple(corner) for corner in corners], outline=TEXT)
    for (u0, v0), radius in zip(pixel(heads.centres), heads.radii, strict=True):
        ring(draw, u0, v0, 1.35 * scale * radius)
    label(draw, "from above")
    return drawn


def ring(draw: ImageDraw.ImageDraw, u: float, v: float, radius: float) -> None:
    """Draw a light circle that shows on any ground."""
    for grow, colour, width in ((1.5, (0, 0, 0), 5), (0.0, RING, 2)):
        r = radius + grow
        draw.ellipse((u - r, v - r, u + r, v + r), outline=colour, width=width)


def label(draw: ImageDraw.ImageDraw, text: str) -> None:
    """Write a few words into the upper left corner."""
    draw.text((7, 5), text, fill=TEXT, font=ImageFont.load_default(14), stroke_width=2, stroke_fill=GROUND)


def picture(frame: Frame, heads: Heads) -> Image.Image:
    """Return the cameras' images below each other, and the view from above beside them."""
    views = [picture_of_depth(image, heads) for image in frame.depths]
    width, height = max(v.width for v in views), sum(v.height for v in views) + GAP * (len(views) - 1)
    sheet = Image.new("RGB", (width + GAP + height, height), GROUND)
    top = 0
    for view in views:
        sheet.paste(view, (0, top))
        top += view.height + GAP
    sheet.paste(picture_from_above(frame, heads, height), (width + GAP, 0))
    return sheet


def pictures(recording: Path) -> Iterator[Image.Image]:
    """Yield a picture of every frame of a depth recording, with the heads that the default settings find."""
    with closing(headvox.open_source(recording)) as source, closing(headvox.Detector()) as detector:
        for frame in source:
            if isinstance(frame, Frame):
                yield picture(frame, detector.detect_frame(frame))


def save_gif(sheets: list[Image.Image], path: Path, ms: int = 120) -> None:
    """Write an animation with one table of colours for all its frames, so that nothing flickers."""
    colours = np.concatenate(
        [DEPTH_COLOURS, HEIGHT_COLOURS, np.array([GROUND, RING, TEXT, (0, 0, 0)], np.uint8)]
    )
    table = Image.new("P", (1, 1))
    table.putpalette(colours.tobytes())
    frames = [sheet.quantize(palette=table, dither=Image.Dither.NONE) for sheet in sheets]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=ms, loop=0, optimize=False)


def save_small(drawn: Path, path: Path, width: int = 1100) -> Path:
    """Write a picture again, ``width`` pixels wide and with few colours, and return where."""
    with Image.open(drawn) as image:
        small = image.convert("RGB").resize(
            (width, width * image.height // image.width), Image.Resampling.LANCZOS
        )
    small.quantize(64, dither=Image.Dither.NONE).save(path, optimize=True)
    return path


def embedded_sample(spare: Path) -> Path:
    """Return the recording that ships with headvox, or make it in ``spare``."""
    sample = Path(headvox.__file__).parent / "assets" / "sample"
    if sample.is_dir():
        return sample
    from headvox.synth.record import make_sample

    return make_sample(spare / "sample")


def main() -> None:
    """Make all pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "pictures")
    parser.add_argument("--recording", type=Path, help="instead of the sample that ships with headvox")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="headvox-pictures-") as name:
        spare = Path(name)
        recording = args.recording or embedded_sample(spare)
        save_gif(list(pictures(recording)), args.out / "sample.gif")
        print(args.out / "sample.gif")
        for cascade in shipped_cascades():
            drawn = list(plot_cascade(load_cascade(cascade), spare / cascade))
            overview = next(path for path in drawn if path.name == "overview.png")
            print(save_small(overview, args.out / f"cascade-{cascade}.png"))


if __name__ == "__main__":
    main()
