"""The command ``headvox eval``: run, score, print, save, compare."""

from __future__ import annotations

import argparse
import os
import platform
import sys
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headvox import __version__
from headvox.commands.flags import (
    GOOD,
    LIMIT_MISSED,
    Parser,
    UsageError,
    add_settings,
    between,
    config_of,
    keep_input,
    seed_number,
    tracker_config_of,
    whole_number,
)
from headvox.commands.live import Live
from headvox.commands.table import file_name, printable
from headvox.parallel.workers import Workers, add_flags, of_flags
from headvox.sample import sample_folder
from headvox.writable import make_folder

if TYPE_CHECKING:
    from headvox.evaluate.match import Rules
    from headvox.evaluate.outcome import Outcome, Plan
    from headvox.evaluate.report import Limit, Report
    from headvox.evaluate.scenarios import Scenario
    from headvox.evaluate.scores import Scores

ALL = ("static", "rotation", "two-cameras", "sample")
REPORT = "report.json"
EXAMPLES = """\
what to evaluate:
  static        the shells of 44 heads, each under 100 random rotations
  rotation      a shell that turns by 12 degrees a second: every cloud, and every fifth
  two-cameras   people who walk between two simulated D435i, 4 m apart
  sample        the recording that ships with headvox
  all           these four
  peers         32 views of four bodies, see docs/evaluation.md
  PATH          a recording, or a folder of clouds, with heads.jsonl in it

examples:
  headvox eval recording                            how many heads are found, and how well
  headvox eval all recording -o report              everything, with plots and pictures
  headvox eval recording --limit recall=0.95 false_per_frame=0.05
  headvox eval recording --heads other.jsonl        another detector's results
  headvox eval compare old/report.json new/report.json

exit codes: 0 good, 1 an error that is explained, 2 wrong usage, 3 a limit missed, 130 Ctrl-C, 143 SIGTERM
"""


def main(argv: Sequence[str]) -> int:
    """Run ``headvox eval`` with these arguments and return the exit code."""
    if argv and argv[0] == "compare":
        return _compare(argv[1:])
    parser = _parser()
    args = parser.parse_intermixed_args(argv)
    try:
        return _report(args)
    except UsageError as error:
        parser.error(str(error))


def _compare(argv: Sequence[str]) -> int:
    parser = Parser("headvox eval compare", description="Show what differs between two reports.")
    for name in ("old", "new"):
        parser.add_argument(
            name, type=Path, metavar=f"{name.upper()}.json", help="report.json of `headvox eval -o`"
        )
    args = parser.parse_args(argv)
    from headvox.evaluate.report import Report, compare

    print(compare(Report.load(args.old), Report.load(args.new)))
    return GOOD


def _report(args: argparse.Namespace) -> int:
    from headvox.evaluate.outcome import evaluate, evaluate_all, pooled
    from headvox.evaluate.report import Report
    from headvox.evaluate.tracking import need_motmetrics
    from headvox.evaluate.truth import NO_ID

    plan = _plan(args)
    made = _made(plan, args)  # what is wrong with a cascade, or with the folder, is told now
    if args.output is not None:
        keep_input(args.output / REPORT, _inputs(args))
        make_folder(args.output)
    scores: list[Scores] = []
    recorded: dict[str, list[Outcome]] = {}
    with closing(Live(sys.stderr)) as live:
        if args.output is not None and not plan.pictures:
            live.tell(f"without matplotlib there will be {REPORT} alone: pip install 'headvox[plot]'")
        scenarios = _scenarios(args, live)
        if plan.tracker is not None and any(scenario.identified for scenario in scenarios):
            need_motmetrics()  # before hours of work, not after
        if args.scheduler is None:
            # One after the other, each told of as it goes: whoever times a detector has the machine to himself.
            outcomes: Iterable[tuple[Scenario, list[Outcome]]] = (
                (scenario, evaluate(scenario, plan, partial(_show, live, scenario))) for scenario in scenarios
            )
        else:
            told = f"of {len(scenarios)} recordings"
            outcomes = evaluate_all(
                scenarios, plan, of_flags(args), lambda count: live.show(f"{count} {told}")
            )
        for scenario, several in outcomes:
            _tell_bad(scenario, several[0], live)
            scores += [entry for outcome in several for entry in outcome.scores]
            if plan.pictures:
                _picture(scenario, several, plan.rules_of(scenario), args.output)
            for outcome in several:
                if scenario.recording and (outcome.run.samples[0].found.ids == NO_ID).all():
                    recorded.setdefault(outcome.scores[0].detector, []).append(outcome)
    scores += [row for row in (pooled(those, plan.rules) for those in recorded.values()) if row is not None]
    report = Report(tuple(scores), made)
    if args.output is not None:
        report.save(args.output / REPORT)
    print(report.to_json() if args.json else _text(report, args.details))
    missed = [line for limit in args.limit for line in limit.missed(report)]
    for line in missed:
        print(printable(f"headvox: limit missed: {line}"), file=sys.stderr)
    return LIMIT_MISSED if missed else GOOD


def _inputs(args: argparse.Namespace) -> list[str | Path | None]:
    """Return the files and folders that are read."""
    places = [what for what in args.what if what not in (*ALL, "all", "peers")]
    return [*places, args.heads, args.clouds, args.config]


def _plan(args: argparse.Namespace) -> Plan:
    from headvox.evaluate.match import Rules
    from headvox.evaluate.outcome import Plan
    from headvox.evaluate.plots import can_plot

    config = config_of(args)
    return Plan(
        configs=(config, *(replace(config, cascade=name) for name in args.against)),
        tracker=None if args.no_track else tracker_config_of(args),
        rules=Rules(args.radius, args.clear, args.count_truncated),
        heads=args.heads,
        name=args.name,
        pictures=args.output is not None and can_plot(),
    )


def _show(live: Live, scenario: Scenario, number: int) -> None:
    live.show(f"{scenario.name}: frame {number} of {scenario.length}")


def _tell_bad(scenario: Scenario, outcome: Outcome, live: Live) -> None:
    run = outcome.run
    if run.bad:
        what = f"{run.bad} of {len(run.samples)} frames could not be used: their heads are missed"
        live.note(f"headvox: {scenario.name}: {what}")


def _scenarios(args: argparse.Namespace, live: Live) -> list[Scenario]:
    """Return what was asked for, in the order given."""
    from headvox.evaluate import scenarios as known
    from headvox.evaluate.around import around
    from headvox.evaluate.keep import keep
    from headvox.sources.remote import is_remote

    asked = [name for what in args.what for name in (ALL if what == "all" else (what,))]
    made: list[Scenario] = []
    for what in dict.fromkeys(asked):
        if what == "static":
            made.append(known.static(args.identities, args.turns, args.seed))
        elif what == "rotation":
            made += [
                known.rotation(1, args.revolutions, args.seed),
                known.rotation(5, args.revolutions, args.seed),
            ]
        elif what == "two-cameras":
            if args.scheduler is not None:
                raise UsageError("two-cameras is made by --workers N of this machine, not by a --scheduler")
            workers = Workers(args.workers)
            made.append(known.two_cameras(args.walkers, args.frames, args.people, 100 + args.seed, workers))
        elif what == "sample":
            made.append(replace(known.recording(sample_folder()), synthetic=True))
        elif what == "peers":
            if args.clouds is None:
                raise UsageError("peers needs --clouds FOLDER, with the four meshes of the paper's authors")
            made.append(around(args.clouds))
        else:
            scenario = (
                known.remote_recording(what) if is_remote(what) else known.recording(Path(what), live.tell)
            )
            is_known = scenario.name in [other.name for other in made]
            made.append(replace(scenario, name=what) if is_known else scenario)
    if args.keep is not None:
        if len(made) != 1 or made[0].name not in ("two-cameras", "peers"):
            raise UsageError("--keep goes with exactly one of two-cameras and peers")
        made = [
            keep(made[0], args.keep, lambda k: live.show(f"{made[0].name}: frame {k} of {made[0].length}"))
        ]
    if args.name is not None and args.heads is None:
        raise UsageError("--name goes with --heads: it is what to call the detector of that file")
    if args.heads is not None and (len(made) != 1 or not (made[0].recording or made[0].rules)):
        raise UsageError("--heads goes with exactly one recording, or with peers")
    return made


def _made(plan: Plan, args: argparse.Namespace) -> dict[str, Any]:
    """Return how the report was made."""
    import numba
    import numpy

    from headvox.masks.read import load_cascade

    made = {
        "headvox": __version__,
        "python": platform.python_version(),
        "numpy": numpy.__version__,
        "numba": numba.__version__,
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "rules": asdict(plan.rules),
    }
    if args.heads is None:  # else nobody knows
        made["settings"] = [asdict(config) for config in plan.configs]
        made["tracker"] = None if plan.tracker is None else asdict(plan.tracker)
        made["tuned_on"] = {c.cascade: list(load_cascade(c.cascade).tuned_on) for c in plan.configs}
    return made


def _text(report: Report, details: bool) -> str:
    parts = [report.table()]
    if details:
        parts.append(report.details())
    for cascade, tuned_on in report.made.get("tuned_on", {}).items():
        words = tuned_on or ["not told"]
        parts.append("\n".join([f"{cascade} was tuned on", *(f"  {entry}" for entry in words)]))
    return "\n\n".join(part for part in parts if part)


def _picture(scenario: Scenario, outcomes: Sequence[Outcome], rules: Rules, folder: Path) -> None:
    """Draw what the detectors made of a scenario, and what went wrong there."""
    from headvox.evaluate.pictures import picture_mishaps
    from headvox.evaluate.plots import plot_scenario

    those = [(outcome.scores[0], outcome.run) for outcome in outcomes]
    plot_scenario(those, rules, folder / f"{file_name(scenario.name)}.png")
    for scores, run in those:
        for kind, mishaps in (("misses", run.misses), ("false", run.false)):
            if mishaps:
                stem = file_name(f"{scenario.name} {scores.detector} {kind}")
                picture_mishaps(f"{scores.name}: worst {kind}", mishaps, folder / f"{stem}.png")


# -------------------------------------------------------------------------------------------------- flags


def _parser() -> Parser:
    parser = Parser(
        "headvox eval",
        description="Measure how good the detector is, where the true heads are known.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.usage = "%(prog)s WHAT [WHAT ...] [flags]\n       %(prog)s compare OLD.json NEW.json"
    parser.add_argument("what", nargs="+", metavar="WHAT", help="see below")
    parser.add_argument(
        "--against", action="append", default=[], metavar="CASCADE", help="evaluate this one, too"
    )
    parser.add_argument(
        "--no-track", action="store_true", help="bare detections only, no second row with a tracker"
    )
    parser.add_argument(
        "-o", dest="output", type=Path, metavar="DIR", help="write report.json, plots and pictures"
    )
    parser.add_argument(
        "--json", action="store_true", help="print the whole report as JSON, and nothing else"
    )
    parser.add_argument(
        "--details", action="store_true", help="also by distance, visible share, views, posture"
    )
    parser.add_argument(
        "--limit", type=limit, nargs="+", action="extend", default=[], metavar="[WHAT:]FIGURE=NUMBER",
        help="exit with 3 when a figure of report.json is worse",
    )  # fmt: skip
    parser.add_argument(
        "--keep",
        type=Path,
        metavar="DIR",
        help="write the frames of two-cameras or peers, as a depth recording",
    )
    peers = parser.add_argument_group("another detector")
    peers.add_argument(
        "--heads", type=Path, metavar="FILE", help="its results, lines as `headvox run --json` has them"
    )
    peers.add_argument("--name", metavar="NAME", help="what to call it (the name of the file)")
    peers.add_argument("--clouds", type=Path, metavar="DIR", help="peers: folder of the four meshes")
    rules = parser.add_argument_group("what counts")
    rules.add_argument(
        "--radius",
        type=between(0.001, 10.0),
        default=0.15,
        metavar="M",
        help="found within this distance (0.15)",
    )
    rules.add_argument(
        "--clear", type=between(0.0, 10.0), default=0.0, metavar="M",
        help="a detection that is left over is no false head this near to a true one (0)",
    )  # fmt: skip
    rules.add_argument(
        "--count-truncated", action="store_true", help="heads cut by the image's border count, too"
    )
    scenes = parser.add_argument_group("size of the scenarios")
    for name, usual, text in (
        ("identities", 44, "static: how many heads"),
        ("turns", 100, "static: rotations of each"),
        ("walkers", 4, "two-cameras: scenes, each with people of its own"),
        ("frames", 60, "two-cameras: frames of each scene, 10 a second"),
        ("people", 1, "two-cameras: people at a time"),
    ):
        scenes.add_argument(
            f"--{name}", type=whole_number, default=usual, metavar="N", help=f"{text} ({usual})"
        )
    scenes.add_argument(
        "--revolutions",
        type=between(0.01, 100.0),
        default=1.0,
        metavar="R",
        help="rotation: how many turns, up to 100 (1)",
    )
    scenes.add_argument(
        "--seed", type=seed_number, default=0, metavar="N", help="another number, other heads and people (0)"
    )
    add_flags(parser)
    add_settings(parser)
    return parser


def limit(text: str) -> Limit:
    """Read a limit, for argparse."""
    from headvox.evaluate.report import Limit

    try:
        return Limit.parse(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
