"""The command ``headvox align``: where the cameras of a recording stand, by what they saw."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from headvox.atomic import write_text
from headvox.commands.flags import (
    GOOD,
    Parser,
    add_source_options,
    keep_input,
    place,
    source_options_of,
    whole_number,
)
from headvox.commands.live import Live
from headvox.commands.table import printable, table
from headvox.errors import HeadvoxError
from headvox.writable import check_file

if TYPE_CHECKING:
    from headvox.calibrate.floor import Floor
    from headvox.calibrate.rig import Placed
    from headvox.data import F64, DepthImage, Frame
    from headvox.sources import Source

MOST_FRAMES = 200
FLOOR_FRAMES = 8
EXAMPLES = """\
A floor has to be in view of every camera. With several cameras somebody has to walk about, for ten seconds or more,
where they all look.

examples:
  headvox align recording                          is the floor where the recording says?
  headvox align recording -o extrinsics.toml       write what was found
  headvox run recording --extrinsics extrinsics.toml
"""


@dataclass(frozen=True, slots=True)
class View:
    """What one camera showed: its images, where it was said to stand, and the floor that it sees."""

    name: str
    images: tuple[DepthImage | None, ...]
    T_world_camera: F64
    floor: Floor


def main(argv: Sequence[str]) -> int:
    """Run ``headvox align`` with these arguments and return the exit code."""
    args = _parser().parse_args(argv)
    from headvox.calibrate.floor import level
    from headvox.sources import open_source
    from headvox.sources.remote import fetched

    if args.output is not None:
        keep_input(args.output, [args.source])
        check_file(args.output)
    with closing(Live(sys.stderr)) as live:
        with (
            fetched(args.source) as path,
            closing(open_source(path, source_options_of(args), live.note)) as source,
        ):
            frames = spread_frames(source, args.frames, live.show)
        views = _views(frames)
        levels = {view.name: level(view.floor) for view in views}
        placed = _place_others(views, levels, live)
    found = _in_the_world(views, levels, placed)
    _tell(views, placed, found)
    if args.output is not None:
        write_text(args.output, extrinsics_text(found))
        print(f"\nwritten to {printable(str(args.output))}")
    return GOOD


def spread_frames(source: Source, most: int, show: Callable[[str], None]) -> list[Frame]:
    """Return at most ``most`` good frames, evenly over the source where its length is known; ``show`` is told.

    Raises:
        HeadvoxError: there is none with a depth image.
    """
    from headvox.data import BadFrame

    frames: list[Frame] = []
    bad, why = 0, ""
    step = max(1, -(-_about_length(source) // most))
    for number, frame in enumerate(source):
        show(f"reading frame {number + 1}")
        if isinstance(frame, BadFrame):
            bad, why = bad + 1, why or frame.reason
        elif number % step == 0 and frame.depths:
            frames.append(frame)
        if len(frames) == most:
            break
    if not frames and bad:
        raise HeadvoxError(
            f"{source.name}: {bad} of its frames are bad, and no other can be used.", f"The first: {why}"
        )
    if not frames:
        raise HeadvoxError(
            f"{source.name}: there are no depth images in it.", "Clouds alone cannot be aligned."
        )
    return frames


def _about_length(source: Source) -> int:
    """Return about how many frames there are, 0 where nobody knows."""
    from headvox.sources.bag import BagSource

    return source.most_readings if isinstance(source, BagSource) else source.length or 0


def _views(frames: list[Frame]) -> list[View]:
    from headvox.calibrate.floor import floor_of
    from headvox.frames import is_moving

    names = list(dict.fromkeys(image.name for frame in frames for image in frame.depths))
    views = []
    for name in names:
        images = tuple(
            next((image for image in frame.depths if image.name == name), None) for frame in frames
        )
        seen = [image for image in images if image is not None]
        if is_moving(image.T_world_camera for image in seen):
            raise HeadvoxError(
                f"{name}: the camera moves, and extrinsics are for cameras that stand still.",
                "Align a recording in which it stands still.",
            )
        some = seen[:: max(1, len(seen) // FLOOR_FRAMES)][:FLOOR_FRAMES]
        best = floor_of(some)
        if best is None:
            raise HeadvoxError(
                f"{name}: no floor is to be seen in {len(some)} of its images.",
                "Tilt the camera down, or move it back.",
            )
        views.append(View(name, images, seen[0].T_world_camera, best))
    return views


def _place_others(views: list[View], levels: dict[str, F64], live: Live) -> dict[str, Placed]:
    """Return where every camera but the first is for the first, by the heads that both see."""
    from headvox.calibrate.rig import place as place_camera

    if len(views) < 2:
        return {}
    heads = {view.name: _heads(view, levels[view.name], live) for view in views}
    placed = {}
    for view in views[1:]:
        names = f"{views[0].name} and {view.name}"
        placed[view.name] = place_camera(heads[views[0].name], heads[view.name], names)
    return placed


def _heads(view: View, T_level_camera: F64, live: Live) -> list[F64]:
    """Return the heads (N, 3) in each image of one camera, in its level frame."""
    from headvox.pipeline import Detector

    found = []
    with closing(Detector()) as detector:
        for number, image in enumerate(view.images):
            live.show(f"{view.name}: image {number + 1} of {len(view.images)}")
            centres = np.empty((0, 3))
            if image is not None:
                with suppress(HeadvoxError):  # an image without a return: nobody is seen in it
                    centres = detector.detect_depth(replace(image, T_world_camera=T_level_camera)).centres
            found.append(centres)
    return found


def _in_the_world(views: list[View], levels: dict[str, F64], placed: dict[str, Placed]) -> dict[str, F64]:
    """Return T_world_camera of each; the world stays as it was if the first camera's floor was right there."""
    from headvox.calibrate.floor import stated
    from headvox.frames import inverse

    first = views[0]
    T_world_level = np.eye(4)
    if stated(first.floor, first.T_world_camera).is_level:
        said = first.T_world_camera @ inverse(levels[first.name])
        yaw = np.arctan2(said[1, 0], said[0, 0])
        T_world_level[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        T_world_level[:2, 3] = said[:2, 3]
    found = {first.name: T_world_level @ levels[first.name]}
    for view in views[1:]:
        found[view.name] = T_world_level @ placed[view.name].T @ levels[view.name]
    return found


def _tell(views: list[View], placed: dict[str, Placed], found: dict[str, F64]) -> None:
    from headvox.calibrate.floor import PLAIN_SHARE, stated

    rows = []
    for view in views:
        told = stated(view.floor, view.T_world_camera)
        verdict = "right" if told.is_level else "WRONG" if view.floor.share >= PLAIN_SHARE else "unsure"
        rows.append(
            [
                view.name, f"{view.floor.height_m:.3f}", f"{100 * view.floor.share:.0f} %",
                f"{1e3 * view.floor.rms_m:.0f}", f"{told.tilt_deg:.1f}", f"{told.z_m:+.3f}", verdict,
            ]
        )  # fmt: skip
    head = ["floor", "below m", "of points", "rms mm", "as recorded: tilt °", "z m", ""]
    print(table(head, rows))
    if not placed:
        return
    rows = []
    for view in views[1:]:
        how, T, said = placed[view.name], found[view.name], view.T_world_camera
        turn = np.degrees(np.arccos(np.clip((np.trace(T[:3, :3].T @ said[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
        shift = 100.0 * np.sqrt(((T[:3, 3] - said[:3, 3]) ** 2).sum())
        rows.append(
            [
                view.name, str(how.pairs), f"{100 * how.rms_m:.1f}", f"{how.spread_m:.1f}",
                f"{100 * how.drop_m:+.1f}", f"{shift:.1f}", f"{turn:.1f}",
            ]
        )  # fmt: skip
    head = [f"beside {views[0].name}", "heads", "rms cm", "spread m", "higher cm", "from recorded: cm", "°"]
    print("\n" + table(head, rows))


def extrinsics_text(found: dict[str, F64]) -> str:
    """Return the extrinsics (T_world_camera (4, 4) by name) as the TOML that ``--extrinsics`` reads."""
    import json

    parts = []
    for name, T in found.items():
        rows = ",\n".join(f"  [{', '.join(f'{v:.6f}' for v in row)}]" for row in T)
        parts.append(f"[cameras.{json.dumps(name)}]\nT_world_camera = [\n{rows},\n]\n")
    return "\n".join(parts)


def _parser() -> Parser:
    parser = Parser(
        "headvox align",
        description="Tell where the cameras of a recording stand: the floor of each, and of several their places.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "source", type=place, metavar="SOURCE", help="a depth recording, or a bag with depth images"
    )
    parser.add_argument(
        "-o", dest="output", type=Path, metavar="FILE", help="write the extrinsics (TOML), for --extrinsics"
    )
    parser.add_argument(
        "--frames",
        type=whole_number,
        default=MOST_FRAMES,
        metavar="N",
        help=f"look at so many ({MOST_FRAMES})",
    )
    add_source_options(parser)
    return parser
