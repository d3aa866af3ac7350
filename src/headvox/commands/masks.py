"""The command ``headvox masks``: list, show, plot and search for cascades."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from headvox.commands.flags import GOOD, UsageError, add_command, seed_number, sentence, whole_number
from headvox.commands.table import file_name, printable, table
from headvox.errors import HeadvoxError
from headvox.parallel.workers import add_flags, of_flags

if TYPE_CHECKING:
    from headvox.commands.flags import Commands


def add_to(commands: Commands) -> None:
    """Add ``headvox masks`` to the command line."""
    text = "list, show, plot and search for cascades of masks"
    masks = commands.add_parser("masks", help=text, description=sentence(text))
    actions = masks.add_subparsers(title="commands", metavar="COMMAND", required=True)
    add_command(actions, "list", _masks_list, "list the cascades that ship with headvox")
    cascade = "name of a shipped cascade, or a cascade file"
    show = add_command(
        actions, "show", _masks_show, "show the conditions, groups and stages of a cascade as tables"
    )
    show.add_argument("cascade", metavar="CASCADE", help=cascade)
    plot = add_command(actions, "plot", _masks_plot, "draw each mask of a cascade to a PNG file")
    plot.add_argument("cascade", metavar="CASCADE", help=cascade)
    plot.add_argument(
        "-o", dest="output", type=Path, metavar="DIR", help="folder for the pictures (masks-NAME)"
    )
    search = add_command(actions, "evolve", _masks_evolve, "search for a cascade, with synthetic views")
    search.add_argument("--views", type=whole_number, default=10_000, metavar="N", help="how many (10000)")
    search.add_argument(
        "--seed", type=seed_number, default=0, metavar="S", help="of the views and the search (0)"
    )
    search.add_argument(
        "--rounds", type=whole_number, default=3, metavar="N", help="of hard negatives, at most (3)"
    )
    add_flags(search, 1)
    search.add_argument("--name", default="evolved", help="of the cascade (evolved)")
    search.add_argument(
        "--work",
        type=Path,
        default=Path("evolve"),
        metavar="DIR",
        help="keeps the views: a search goes on from there (evolve)",
    )
    search.add_argument("-o", dest="output", type=Path, metavar="FILE", help="the cascade file (NAME.toml)")


def _masks_list(args: argparse.Namespace) -> int:
    from headvox.masks.read import load_cascade, shipped_cascades

    cascades = [(name, load_cascade(name)) for name in shipped_cascades()]
    rows = [
        [name, "votes" if cascade.votes else "stages", f"{1e3 * cascade.voxel_m:g} mm", cascade.summary]
        for name, cascade in cascades
    ]
    print(table(["cascade", "second stage", "voxel", "summary"], rows))
    return GOOD


def _masks_show(args: argparse.Namespace) -> int:
    from headvox.masks.describe import describe_cascade
    from headvox.masks.read import load_cascade

    print(describe_cascade(load_cascade(args.cascade)))
    return GOOD


def _masks_plot(args: argparse.Namespace) -> int:
    from headvox.masks.plot import plot_cascade
    from headvox.masks.read import load_cascade

    cascade = load_cascade(args.cascade)
    folder = args.output or Path(f"masks-{file_name(cascade.name)}")
    for path in plot_cascade(cascade, folder):
        print(printable(str(path)), flush=True)
    return GOOD


def _masks_evolve(args: argparse.Namespace) -> int:
    from headvox.evolve.search import LEAST_VIEWS, Settings, evolve
    from headvox.evolve.write import write_cascade
    from headvox.writable import check_file

    if args.views < LEAST_VIEWS:
        raise UsageError(f"argument --views: expected at least {LEAST_VIEWS}, got '{args.views}'")
    out = args.output or Path(f"{args.name}.toml")
    if out.exists():
        raise HeadvoxError(f"{out}: exists already.", "Give another file with -o, or move it away.")
    check_file(out)
    settings = Settings(args.work, args.views, args.name, args.seed, args.rounds, of_flags(args))
    found = evolve(settings, lambda text: print(text, file=sys.stderr, flush=True))
    write_cascade(out, args.name, found)
    print(printable(str(out)))
    return GOOD
