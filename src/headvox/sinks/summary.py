"""The account of a run as tables for people."""

from __future__ import annotations

import numpy as np

from headvox.commands.table import table
from headvox.data import Heads
from headvox.run import UNTRACKED, Report

PERCENTILES = (50, 95, 99)


def summary(report: Report) -> str:
    """Return the heads of a run of one frame, the counts of any run, and what each stage took."""
    parts = [_counts(report), _times(report)]
    if report.frames == 1 and report.last is not None and len(report.last.heads):
        parts.insert(0, heads_table(report.last.heads))
    return "\n\n".join(part for part in parts if part)


def heads_table(heads: Heads) -> str:
    """Return a row a head, best score first: centre and radius in metres, the cascade's score."""
    rows = [
        [str(n), *(f"{v:.3f}" for v in head.centre), f"{head.radius:.3f}", f"{head.score:.2f}"]
        for n, head in enumerate(heads, 1)
    ]
    return table(["head", "x", "y", "z", "radius", "score"], rows)


def _counts(report: Report) -> str:
    hertz = report.frames / report.seconds if report.seconds > 0 else 0.0
    rows = [
        ["frames", str(report.frames)],
        ["bad frames", str(report.bad)],
        ["heads", str(report.heads)],
        ["frames with heads", str(report.frames_with_heads)],
        *([] if report.ids is None else [["heads with an id", str(report.ids)]]),
        *([UNTRACKED[what], str(count)] for what, count in report.untracked.items()),
        ["Hz, reading included", f"{hertz:.1f}"],
    ]
    return table([], rows)


def _times(report: Report) -> str:
    if not report.latency_ms:
        return ""
    times = {**report.stage_ms, "total": report.latency_ms}
    rows = [
        [stage, *(f"{v:.2f}" for v in np.percentile(np.array(ms), PERCENTILES))]
        for stage, ms in times.items()
    ]
    return table(["ms a frame", *(f"p{p}" for p in PERCENTILES)], rows)
