"""Draws a cascade: each condition, mask or group in 3-D and in three sections, over a body for scale.

Needs the extra ``plot``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from headvox.commands.table import printable
from headvox.data import F64
from headvox.errors import HeadvoxError, MissingExtra
from headvox.masks.cascade import Cascade
from headvox.masks.pictures import GREEN, RED, Painted, Picture, influence_of_features, pictures_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, FAINT, SKIN = "#22262b", "#8b929a", "#cfd4da"
HEAD_M = (0.19, 0.15, 0.23)  # of an adult: front to back, ear to ear, chin to crown
# Neck, shoulders and chest: height from the head's centre, half depth, half width.
TRUNK_M = np.array(
    [
        (-0.06, 0.055, 0.055), (-0.15, 0.057, 0.057), (-0.185, 0.075, 0.09), (-0.215, 0.09, 0.165),
        (-0.25, 0.10, 0.215), (-0.31, 0.11, 0.232), (-0.42, 0.12, 0.225), (-0.55, 0.12, 0.215),
    ]
)  # fmt: skip
DOTS_PER_INCH = 110
MOST_BARS = 24
# Two axes of a section, the axis across it, its name, and what the axes are called.
SECTIONS = (
    (1, 2, 0, "from the front", "y, to the left (m)", "z, up (m)"),
    (0, 2, 1, "from the right side", "x, ahead (m)", "z, up (m)"),
    (0, 1, 2, "from above", "x, ahead (m)", "y, to the left (m)"),
)


def plot_cascade(cascade: Cascade, folder: Path) -> Iterator[Path]:
    """Draw ``cascade`` to PNG files in ``folder``, made if need be; yield each path once it is written.

    Raises:
        HeadvoxError: matplotlib is missing, or the folder cannot be written.
    """
    _need_matplotlib()
    pictures = list(pictures_of(cascade))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for picture in pictures:
            yield _save(draw(picture), folder / f"{picture.stem}.png")
        yield _save(contact_sheet(cascade, pictures), folder / "overview.png")
        if cascade.stages:
            yield _save(bar_chart(cascade), folder / "cuts.png")
    except OSError as error:
        raise HeadvoxError(
            f"Pictures in {folder}: {error.strerror or error}.", "Give a folder with -o."
        ) from None


def _need_matplotlib() -> None:
    try:
        import matplotlib
    except ImportError:
        raise MissingExtra("Pictures need matplotlib.", "plot") from None
    matplotlib.use("Agg")


def _save(figure: Figure, path: Path) -> Path:
    import matplotlib.pyplot as plt

    try:
        figure.savefig(path, dpi=DOTS_PER_INCH, facecolor="white")
    finally:
        plt.close(figure)
    return path


def draw(picture: Picture) -> Figure:
    """Return a figure with the 3-D view and the three sections through the candidate."""
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(13.0, 7.8))
    _write(figure, 0.03, 0.945, picture.title, fontsize=19, fontweight="bold", color=INK)
    _write(figure, 0.03, 0.9, picture.words, fontsize=12.5, color=INK)
    low, high = _extent(picture)
    solid = figure.add_axes((0.0, 0.01, 0.455, 0.87), projection="3d")
    _solid(solid, picture, low, high)
    places = ((0.5, 0.525, 0.21, 0.34), (0.765, 0.525, 0.21, 0.34), (0.5, 0.07, 0.21, 0.34))
    for section, place in zip(SECTIONS, places, strict=True):
        _section(figure.add_axes(place), section, picture, low, high)
    _legend(figure, picture)
    return figure


def _write(figure: Figure, x: float, y: float, text: str, **style: Any) -> None:
    figure.text(x, y, printable(text), parse_math=False, **style)


def _legend(figure: Figure, picture: Picture) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    keys: list[Any] = [Patch(facecolor=c, alpha=0.55, edgecolor=c, label=text) for c, text in picture.legend]
    keys += [
        Patch(facecolor=INK, alpha=0.25, label="solid: cut by the section"),
        Line2D([], [], color=INK, linestyle=(0, (3, 2)), linewidth=1.0, label="dashed: before or behind it"),
        Patch(facecolor=SKIN, edgecolor=FAINT, label="an adult: head 15 × 19 × 23 cm"),
        Line2D([], [], color=INK, marker="+", markersize=9, linestyle="", label="the candidate"),
    ]
    figure.legend(handles=keys, loc="upper left", bbox_to_anchor=(0.735, 0.425), frameon=False, fontsize=10.5)


def _extent(picture: Picture) -> tuple[F64, F64]:
    """Return the lowest and highest corner of what is shown: boxes, at least head and shoulders."""
    low, high = np.array([-0.26, -0.26, -0.36]), np.array([0.26, 0.26, 0.22])
    for painted in picture.boxes:
        centre, half = np.array(painted.box.centre), np.array(painted.box.size) / 2
        low, high = np.minimum(low, centre - half - 0.03), np.maximum(high, centre + half + 0.03)
    across = max(-low[:2].min(), high[:2].max())  # the same both ways: square from above
    low[:2], high[:2] = -across, across
    return low, high


def _solid(axes: Any, picture: Picture, low: F64, high: F64) -> None:
    _body(axes, low[2])
    for painted in picture.boxes:
        _block(axes, painted)
    axes.scatter([0], [0], [0], marker="+", s=60, color=INK, depthshade=False)
    for name, a, b in zip("xyz", low, high, strict=True):
        getattr(axes, f"set_{name}lim")(a, b)
        axis = getattr(axes, f"{name}axis")
        axis.set_major_locator(_ticks())
        axis.pane.set_facecolor("white")
        axis.pane.set_edgecolor("#e3e6ea")
        axis._axinfo["grid"].update(color="#eceef1", linewidth=0.6)
        axis.line.set_color("#c3c8ce")
    axes.tick_params(labelsize=8, colors=FAINT, pad=0)
    axes.set_xlabel("x, ahead (m)", fontsize=9, color=INK)
    axes.set_ylabel("y, to the left (m)", fontsize=9, color=INK)
    axes.set_zlabel("z, up (m)", fontsize=9, color=INK)
    axes.set_box_aspect(high - low, zoom=0.92)
    axes.view_init(elev=17, azim=-38)


def _ticks() -> Any:
    from matplotlib.ticker import MultipleLocator

    return MultipleLocator(0.2)


def _body(axes: Any, lowest: float) -> None:
    """Draw head, neck and shoulders as surfaces."""
    turn, rise = np.meshgrid(np.linspace(0, 2 * np.pi, 41), np.linspace(-np.pi / 2, np.pi / 2, 21))
    half = np.array(HEAD_M) / 2
    head = (
        half[0] * np.cos(turn) * np.cos(rise),
        half[1] * np.sin(turn) * np.cos(rise),
        half[2] * np.sin(rise),
    )
    heights = np.linspace(max(lowest, TRUNK_M[-1, 0]), TRUNK_M[0, 0], 30)
    depth, width = (np.interp(heights, TRUNK_M[::-1, 0], TRUNK_M[::-1, k])[:, None] for k in (1, 2))
    around = np.linspace(0, 2 * np.pi, 41)[None, :]
    trunk = (depth * np.cos(around), width * np.sin(around), np.repeat(heights[:, None], 41, axis=1))
    for surface in (head, trunk):
        axes.plot_surface(*surface, color=SKIN, alpha=0.28, linewidth=0, shade=True, rstride=1, cstride=1)
        axes.plot_wireframe(*surface, color=FAINT, alpha=0.25, linewidth=0.4, rstride=4, cstride=5)


def _block(axes: Any, painted: Painted) -> None:
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    centre, half = np.array(painted.box.centre), np.array(painted.box.size) / 2
    corners = np.array([centre + half * (x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    faces = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
    edges = ((0, 1), (0, 2), (0, 4), (1, 3), (1, 5), (2, 3), (2, 6), (3, 7), (4, 5), (4, 6), (5, 7), (6, 7))
    axes.add_collection3d(
        Poly3DCollection([corners[list(f)] for f in faces], facecolor=painted.face, alpha=0.16)
    )
    lines = Line3DCollection(
        [corners[list(e)] for e in edges], colors=painted.edge, linewidths=1.1, alpha=0.9
    )
    axes.add_collection3d(lines)


def _section(
    axes: Axes, section: tuple[int, int, int, str, str, str], picture: Picture, low: F64, high: F64
) -> None:
    """Draw a section through the candidate: cut boxes filled, others as dashed outlines."""
    from matplotlib.patches import Rectangle

    right, up, across, name, right_label, up_label = section
    _silhouette(axes, across)
    for painted in picture.boxes:
        centre, size = painted.box.centre, painted.box.size
        cut = abs(centre[across]) <= size[across] / 2 + 1e-9
        corner = (centre[right] - size[right] / 2, centre[up] - size[up] / 2)
        if cut:
            axes.add_patch(
                Rectangle(corner, size[right], size[up], facecolor=painted.face, alpha=0.32, zorder=3)
            )
        style: Any = {"linestyle": "-" if cut else (0, (3, 2)), "linewidth": 1.6 if cut else 0.9}
        axes.add_patch(
            Rectangle(corner, size[right], size[up], fill=False, edgecolor=painted.edge, zorder=4, **style)
        )
        if painted.label and cut:
            axes.text(corner[0] + 0.008, corner[1] + 0.008, painted.label, fontsize=8.5, color=INK, zorder=6)
    axes.plot([0], [0], "+", color=INK, markersize=9, zorder=7)
    axes.set_xlim(low[right], high[right])
    axes.set_ylim(low[up], high[up])
    axes.set_aspect("equal")
    axes.set_title(name, fontsize=11, color=INK, pad=5)
    axes.set_xlabel(right_label, fontsize=9, color=INK, labelpad=2)
    axes.set_ylabel(up_label, fontsize=9, color=INK, labelpad=2)
    axes.xaxis.set_major_locator(_ticks())
    axes.yaxis.set_major_locator(_ticks())
    axes.tick_params(labelsize=8, colors=FAINT, length=2)
    axes.grid(color="#eef0f2", linewidth=0.7)
    axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set_color("#d5d9de")


def _silhouette(axes: Axes, across: int) -> None:
    """Draw head, neck and shoulders as seen along one axis."""
    from matplotlib.patches import Ellipse, Polygon

    style: Any = {"facecolor": SKIN, "edgecolor": FAINT, "linewidth": 1.0, "alpha": 0.45, "zorder": 1}
    size = [HEAD_M[k] for k in range(3) if k != across]
    if across == 2:
        depth, width = 2 * TRUNK_M[5, 1:]
        axes.add_patch(Ellipse((0, 0), depth, width, **style))
    else:
        half = TRUNK_M[:, 2 if across == 0 else 1]
        outline = np.concatenate(
            [np.stack([-half, TRUNK_M[:, 0]], axis=1), np.stack([half, TRUNK_M[:, 0]], axis=1)[::-1]]
        )
        axes.add_patch(Polygon(outline, closed=True, **style))
    axes.add_patch(Ellipse((0, 0), size[0], size[1], **{**style, "alpha": 0.8}))


def contact_sheet(cascade: Cascade, pictures: Sequence[Picture]) -> Figure:
    """Return one figure with all ``pictures`` side by side, in 3-D and at one scale."""
    import matplotlib.pyplot as plt

    columns = min(6, max(3, math.ceil(math.sqrt(1.6 * len(pictures)))))
    rows = max(1, math.ceil(len(pictures) / columns))
    width, height = 3.0 * columns, 3.3 * rows + 0.9
    figure = plt.figure(figsize=(width, height))
    _write(figure, 0.3 / width, 1 - 0.45 / height, cascade.name, fontsize=19, fontweight="bold", color=INK)
    _write(
        figure,
        0.3 / width,
        1 - 0.75 / height,
        _clipped(cascade.summary, 28 * columns),
        fontsize=11,
        color=INK,
    )
    extents = [_extent(picture) for picture in pictures]
    low = np.min([low for low, _ in extents], axis=0) if extents else np.zeros(3)
    high = np.max([high for _, high in extents], axis=0) if extents else np.ones(3)
    for k, picture in enumerate(pictures):
        left, bottom = 3.0 * (k % columns) / width, 3.3 * (rows - 1 - k // columns) / height
        axes: Any = figure.add_axes((left, bottom - 0.1 / height, 3.0 / width, 3.0 / height), projection="3d")
        _solid(axes, picture, low, high)
        axes.set_axis_off()
        axes.set_box_aspect(high - low, zoom=1.28)
        _write(
            figure,
            left + 0.3 / width,
            bottom + 2.95 / height,
            _clipped(picture.title, 30),
            fontsize=12,
            color=INK,
        )
    return figure


def _clipped(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 1] + "…"


def bar_chart(cascade: Cascade) -> Figure:
    """Return a figure of the features that move the score most, in the colour of the way they move it."""
    import matplotlib.pyplot as plt

    channel = {group.name: group.channel for group in cascade.groups}
    ranked = sorted(influence_of_features(cascade).items(), key=lambda item: (-item[1].total, item[0]))
    shown = ranked[:MOST_BARS][::-1]
    figure, axes = plt.subplots(figsize=(11, 1.9 + 0.32 * len(shown)))
    totals = [influence.total for _, influence in shown]
    colours = [GREEN if influence.change >= 0 else RED for _, influence in shown]
    axes.barh(range(len(shown)), totals, color=colours, alpha=0.75, height=0.7)
    for y, (_, influence) in enumerate(shown):
        cuts = f"{influence.cuts} cut{'s' * (influence.cuts != 1)}, {influence.change:+.3g}"
        axes.text(influence.total, y, f"  {cuts}", va="center", fontsize=9, color=FAINT)
    names = [f"{_clipped(name, 40)}  ({channel[name.rpartition('.')[0]]})" for name, _ in shown]
    axes.set_yticks(
        range(len(shown)), [printable(name) for name in names], fontsize=10, color=INK, parse_math=False
    )
    axes.set_xlim(0, 1.18 * max([*totals, 1e-9]))
    axes.set_ylim(-0.6, len(shown) - 0.4)
    axes.set_xlabel("how far all its cuts together move the score", fontsize=10, color=INK)
    which = "all" if len(shown) == len(ranked) else f"the first {len(shown)}"
    title = (
        f"{_clipped(printable(cascade.name), 40)}: what moves the score, {which} of {len(ranked)} features"
    )
    axes.set_title(title, loc="left", fontsize=15, fontweight="bold", color=INK, pad=26, parse_math=False)
    note = "green: a larger value speaks for a head; red: against one"
    axes.text(0.0, 1.0, note, transform=axes.transAxes, fontsize=10.5, color=INK, va="bottom")
    axes.tick_params(axis="x", labelsize=9, colors=FAINT)
    axes.tick_params(axis="y", length=0)
    figure.set_layout_engine("constrained", w_pad=0.15, h_pad=0.12)
    axes.grid(axis="x", color="#eef0f2")
    axes.set_axisbelow(True)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    return figure
