"""Plots of an evaluation, one picture a scenario: errors, recall against distance, precision and recall, latency."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from headvox.data import F64
from headvox.evaluate.match import Rules
from headvox.evaluate.metrics import Rows, gather, match_frames
from headvox.evaluate.scores import Scores

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from headvox.evaluate.loop import Run

COLOURS = ("#1f6f8b", "#d1603d", "#6a4c93", "#5b8c5a", "#8a6d3b")
DOTS_PER_INCH = 110
RECALL_BINS_M = np.arange(0.0, 8.5, 0.5)


def can_plot() -> bool:
    """Return whether matplotlib is installed, which draws plots and pictures."""
    try:
        import_module("matplotlib")
    except ImportError:
        return False
    return True


def plot_scenario(runs: Sequence[tuple[Scores, Run]], rules: Rules, path: Path) -> None:
    """Draw what all detectors did on one scenario into a PNG file."""
    from matplotlib.figure import Figure

    rows = [gather(run.samples, match_frames(run.samples, rules), rules) for _, run in runs]
    figure = Figure(figsize=(13.0, 7.2), layout="constrained")
    panels = figure.subplots(2, 3).ravel()
    figure.suptitle(runs[0][0].scenario)
    _centre_errors(panels[0], runs, rows, rules)
    _axes_errors(panels[1], runs, rows)
    _recall_by_distance(panels[2], runs, rows)
    _precision_recall(panels[3], runs)
    _turns(panels[4], runs, rows)
    _latency(panels[5], runs)
    save(figure, path)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure).print_figure(str(path), dpi=DOTS_PER_INCH, facecolor="white")


def _centre_errors(
    axes: Axes, runs: Sequence[tuple[Scores, Run]], rows: Sequence[Rows], rules: Rules
) -> None:
    bins = np.linspace(0.0, 100.0 * rules.radius_m, 31)
    _histogram(axes, runs, [100.0 * np.linalg.norm(r.errors[r.found], axis=1) for r in rows], bins)
    _name(axes, "centre error", "cm", "heads")


def _axes_errors(axes: Axes, runs: Sequence[tuple[Scores, Run]], rows: Sequence[Rows]) -> None:
    """Mean and spread of the error along each world axis."""
    for k, ((scores, _), r) in enumerate(zip(runs, rows, strict=True)):
        errors = 100.0 * r.errors[r.found]
        if len(errors):
            at = np.arange(3) + 0.8 * (k + 0.5) / len(runs) - 0.4
            axes.errorbar(
                at, errors.mean(axis=0), errors.std(axis=0), fmt="o", capsize=4, color=_colour(k), label=scores.detector
            )  # fmt: skip
    axes.axhline(0.0, color="0.7", linewidth=1)
    axes.set_xticks(range(3), ("x", "y", "z"))
    _name(axes, "found minus true: mean and standard deviation", "world axis", "cm")


def _recall_by_distance(axes: Axes, runs: Sequence[tuple[Scores, Run]], rows: Sequence[Rows]) -> None:
    for k, ((scores, _), r) in enumerate(zip(runs, rows, strict=True)):
        heads, _ = np.histogram(r.distances, RECALL_BINS_M)
        found, _ = np.histogram(r.distances[r.found], RECALL_BINS_M)
        some = heads > 0
        middle = (RECALL_BINS_M[1:] + RECALL_BINS_M[:-1]) / 2
        axes.plot(middle[some], found[some] / heads[some], "o-", color=_colour(k), label=scores.detector)
        if k == 0:
            for x, count in zip(middle[some], heads[some], strict=True):
                axes.annotate(str(count), (x, 0.02), ha="center", color="0.5", fontsize=8)
    axes.set_xlim(left=0.0)
    axes.set_ylim(0.0, 1.05)
    _name(axes, "recall by distance (grey: heads)", "m to the nearest sensor", "recall")


def _precision_recall(axes: Axes, runs: Sequence[tuple[Scores, Run]]) -> None:
    for k, (scores, _) in enumerate(runs):
        if scores.curve:
            _, recall, precision, _ = np.array(scores.curve).T
            axes.plot(recall, precision, ".-", color=_colour(k), label=scores.detector)
        if scores.recall is not None and scores.precision is not None:
            axes.plot(
                [scores.recall],
                [scores.precision],
                "D",
                markersize=8,
                color=_colour(k),
                markeredgecolor="black",
            )
    axes.set_xlim(0.0, 1.05)
    axes.set_ylim(0.0, 1.05)
    _name(axes, "precision and recall (diamond: as set)", "recall", "precision")


def _turns(axes: Axes, runs: Sequence[tuple[Scores, Run]], rows: Sequence[Rows]) -> None:
    turns = [r.turns_deg[np.isfinite(r.turns_deg[:, 3]), 3] for r in rows]
    _histogram(axes, runs, turns, np.linspace(0.0, 180.0, 37))
    _name(axes, "orientation error", "degrees", "heads")


def _latency(axes: Axes, runs: Sequence[tuple[Scores, Run]]) -> None:
    for k, (scores, run) in enumerate(runs):
        latency = np.array([sample.found.latency_ms for sample in run.samples])
        latency = np.sort(latency[np.isfinite(latency)])
        if len(latency):
            axes.plot(
                latency,
                np.arange(1, len(latency) + 1) / len(latency),
                color=_colour(k),
                label=scores.detector,
            )
    axes.set_xlim(left=0.0)
    axes.set_ylim(0.0, 1.02)
    _name(axes, "latency", "ms", "share of the frames")


def _histogram(axes: Axes, runs: Sequence[tuple[Scores, Run]], values: Sequence[F64], bins: F64) -> None:
    for k, ((scores, _), some) in enumerate(zip(runs, values, strict=True)):
        if len(some):
            axes.hist(
                some, bins.tolist(), histtype="step", linewidth=1.8, color=_colour(k), label=scores.detector
            )


def _name(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8)
    else:
        axes.text(0.5, 0.5, "nothing to show", transform=axes.transAxes, ha="center", color="0.5")
        axes.set_xticks([])
        axes.set_yticks([])
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _colour(k: int) -> str:
    return COLOURS[k % len(COLOURS)]
