"""The results of an evaluation: a plain record that prints, saves, compares, and meets limits or not."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from headvox.atomic import write_text
from headvox.commands.table import table
from headvox.errors import HeadvoxError
from headvox.evaluate.metrics import Group
from headvox.evaluate.scores import LESS, MORE, Scores

FORMAT, VERSION = "headvox-evaluation", 1


@dataclass(frozen=True, slots=True)
class Report:
    """The scores of several scenarios, and how they were made."""

    scores: tuple[Scores, ...]
    made: dict[str, Any] = field(default_factory=dict)
    """Versions, settings, rules, and what each cascade was tuned on."""

    def to_json(self) -> str:
        """Return everything as JSON."""
        content = {"format": FORMAT, "version": VERSION, "made": self.made}
        return json.dumps(content | {"scores": [asdict(s) for s in self.scores]}, indent=1, allow_nan=False)

    def save(self, path: Path) -> None:
        """Write the report as JSON; what stood there stays until the new one is complete."""
        write_text(path, self.to_json() + "\n")

    @staticmethod
    def load(path: Path) -> Report:
        """Read what :meth:`save` wrote.

        Raises:
            HeadvoxError: no such file, or something else in it.
        """
        wrong = HeadvoxError(f"{path}: expected a report of `headvox eval -o`.", "Check the path.")
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise HeadvoxError(f"{path}: {error.strerror or error}.", "Check the path.") from None
        except (ValueError, RecursionError):
            raise wrong from None
        if (
            not isinstance(content, dict)
            or content.get("format") != FORMAT
            or content.get("version") != VERSION
        ):
            raise wrong
        names = {entry.name for entry in fields(Scores)}
        try:
            scores = []
            for row in content["scores"]:
                row = {name: value for name, value in row.items() if name in names}
                row["groups"] = {key: [Group(**g) for g in several] for key, several in row["groups"].items()}
                scores.append(Scores(**row))
        except (TypeError, KeyError, AttributeError):
            raise wrong from None
        return Report(tuple(scores), content.get("made", {}))

    def table(self) -> str:
        """Return what a person wants to see first."""
        text = [table(DETECTION, [_detection(s) for s in self.scores])]
        text.append(table(ERRORS, [_errors(s) for s in self.scores]))
        turned = [_orientation(s) for s in self.scores if s.oriented]
        if turned:
            text.append(table(ORIENTATION, turned))
        tracked = [_tracking(s) for s in self.scores if s.hota is not None]
        if tracked:
            text.append(table(TRACKING, tracked))
        return "\n\n".join(text)

    def details(self) -> str:
        """Return recall and errors by distance, visible share and so on."""
        rows = [
            [s.scenario, s.detector, name, g.label, str(g.heads), _share(g.found / g.heads), _cm(g.centre_mean_m),
             _number(g.turn_mean_deg, 1)]
            for s in self.scores for name, groups in s.groups.items() for g in groups
        ]  # fmt: skip
        header = ("scenario", "detector", "by", "", "heads", "recall", "mean cm", "mean °")
        return table(header, rows) if rows else ""


DETECTION = (
    "detection", "detector", "tuned on", "frames", "heads", "found", "recall", "precision", "false/frame", "AP",
    "truncated, found",
)  # fmt: skip
ERRORS = (
    "centre and time", "detector", "mean cm", "median", "p90", "bias x y z", "scatter", "p50 ms", "p95", "p99",
    "jitter",
)  # fmt: skip
ORIENTATION = (
    "orientation", "detector", "stated", "flips", "mean °", "median", "p90", "yaw", "pitch", "roll",
)  # fmt: skip
TRACKING = (
    "tracking", "detector", "MOTA", "IDF1", "HOTA", "DetA", "AssA", "switches", "breaks", "hidden", "kept",
    "stated while hidden",
)  # fmt: skip


def _detection(s: Scores) -> list[str]:
    return [
        s.scenario, s.detector, s.tuned, str(s.frames), str(s.heads), str(s.found) if s.heads else "",
        _share(s.recall), _share(s.precision), _number(s.false_per_frame, 3), _number(s.average_precision, 3),
        f"{s.truncated}, {s.truncated_found}" if s.truncated else "",
    ]  # fmt: skip


def _errors(s: Scores) -> list[str]:
    bias = "" if s.centre_bias_m is None else " ".join(f"{100 * v:+.1f}" for v in s.centre_bias_m)
    return [
        s.scenario, s.detector, _cm(s.centre_mean_m), _cm(s.centre_median_m), _cm(s.centre_p90_m), bias,
        _cm(s.centre_scatter_m), _number(s.latency_p50_ms, 2), _number(s.latency_p95_ms, 2),
        _number(s.latency_p99_ms, 2), _number(s.latency_jitter_ms, 2),
    ]  # fmt: skip


def _orientation(s: Scores) -> list[str]:
    return [
        s.scenario, s.detector, f"{s.oriented} of {s.found}", str(s.flips), _number(s.turn_mean_deg, 1),
        _number(s.turn_median_deg, 1), _number(s.turn_p90_deg, 1), _number(s.yaw_mean_deg, 1),
        _number(s.pitch_mean_deg, 1), _number(s.roll_mean_deg, 1),
    ]  # fmt: skip


def _tracking(s: Scores) -> list[str]:
    return [
        s.scenario, s.detector, _number(s.mota, 3), _number(s.idf1, 3), _number(s.hota, 3),
        _number(s.detection_accuracy, 3), _number(s.association_accuracy, 3), str(s.switches),
        str(s.fragmentations), str(s.gaps), str(s.bridged), _share(s.coasted),
    ]  # fmt: skip


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _cm(value: float | None) -> str:
    return "" if value is None else f"{100 * value:.2f}"


def _share(value: float | None) -> str:
    """Per cent to one place, rounded towards the worse: 100 % means all."""
    return "" if value is None else f"{math.floor(1000 * value + 1e-9) / 10:.1f} %"


# ----------------------------------------------------------------------------------------- limits and comparison


@dataclass(frozen=True, slots=True)
class Limit:
    """A bound for one figure, in one scenario or in all."""

    figure: str
    bound: float
    scenario: str | None = None

    @staticmethod
    def parse(text: str) -> Limit:
        """Read ``recall=0.98`` or ``two-cameras:recall=0.98``.

        Raises:
            ValueError: not of that form, or no figure that has a better and a worse.
        """
        left, equals, right = text.partition("=")
        scenario, colon, figure = left.rpartition(":")
        if not equals or figure not in LESS + MORE:
            raise ValueError(f"expected FIGURE=NUMBER with one of {', '.join(MORE + LESS)}, got {text!r}")
        try:
            bound = float(right)
        except ValueError:
            bound = math.nan
        if not math.isfinite(bound):
            raise ValueError(f"expected a finite number after =, got {text!r}")
        return Limit(figure, bound, scenario if colon else None)

    def missed(self, report: Report) -> list[str]:
        """Return a line for each scenario that misses it, or one when none has such a figure."""
        asked = [s for s in report.scores if self.scenario in (None, s.scenario)]
        known = [(s, getattr(s, self.figure)) for s in asked if getattr(s, self.figure) is not None]
        if not known:
            return [f"{self.figure} was not measured{f' in {self.scenario}' if self.scenario else ''}"]
        sign, word = (1, "most") if self.figure in LESS else (-1, "least")
        return [
            f"{s.name}: {self.figure} is {value:.4g}, the limit is at {word} {self.bound:g}"
            for s, value in known
            if sign * value > sign * self.bound
        ]


def compare(old: Report, new: Report) -> str:
    """Return a table of what differs between two reports, scenario by scenario.

    Rows of the same scenario and detector go together; where each report has one detector only, its name may differ.

    Raises:
        HeadvoxError: they have no scenario in common.
    """
    one_each = all(len({s.detector for s in report.scores}) == 1 for report in (old, new))

    def key(scores: Scores) -> str:
        return scores.scenario if one_each else scores.name

    before = {key(s): s for s in old.scores}
    pairs = [(before[key(s)], s) for s in new.scores if key(s) in before]
    if not pairs:
        raise HeadvoxError("The two reports have no scenario in common.", "Run the same scenarios for both.")
    rows = []
    for a, b in pairs:
        for figure in (*MORE, *LESS, "frames", "heads"):
            was, now = getattr(a, figure), getattr(b, figure)
            if was != now:
                rows.append(
                    [
                        key(b),
                        figure,
                        _figure(was),
                        _figure(now),
                        _change(was, now),
                        _verdict(figure, was, now),
                    ]
                )
    header = ("scenario", "figure", "old", "new", "change", "")
    return table(header, rows) if rows else f"No figure differs in {len(pairs)} scenarios."


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _change(was: float | None, now: float | None) -> str:
    return "" if was is None or now is None else f"{now - was:+.4g}"


def _verdict(figure: str, was: float | None, now: float | None) -> str:
    if was is None or now is None or figure not in LESS + MORE:
        return ""
    return "better" if (now < was) == (figure in LESS) else "worse"
