"""The command ``headvox synth``: heads, scenes and recordings with their truth, into a folder."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headvox.commands.flags import Parser, between, seed_number, sentence, whole, whole_number
from headvox.commands.live import Live
from headvox.commands.table import printable, table
from headvox.parallel.workers import add_flags, of_flags

if TYPE_CHECKING:
    from headvox.synth.scene import Scene

MOST_PEOPLE = 6
MOST_POINTS = 1_000_000  # to spread them takes 5 KB for each
SENSORS = ("d435i", "d435i-small", "kinect", "ideal")
EXAMPLES = """\
examples:
  headvox synth heads -o heads                   44 bald heads as clouds of 9,000 points
  headvox synth scene --people 3 -o room         a depth recording with true heads; then: headvox run room
  headvox synth two-cameras --people 3 -o rig    two cameras that face each other, as in the paper
  headvox synth scene --sensor lidar -o clouds   a folder of clouds

A command that was stopped goes on where it was when it is given again. The same --seed gives the same bytes,
whoever does the work.
"""

Told = Callable[[int], None]


def main(argv: Sequence[str]) -> int:
    """Run ``headvox synth`` with these arguments and return the exit code."""
    args = _parser().parse_args(argv)
    args.command(args)
    return 0


def _heads(args: argparse.Namespace) -> None:
    from headvox.synth.heads import make_heads

    with _Progress("head", args.count) as progress:
        make_heads(args.out, args.count, args.points, args.metric, args.seed, of_flags(args), progress)
    _tell(args.out, [("heads", str(args.count)), ("points of each", str(args.points))], progress)


def _scene(args: argparse.Namespace) -> None:
    if args.sensor == "lidar":
        if args.hz is not None or args.cameras is not None:
            args.parser.error("--sensor lidar takes no --hz and no --cameras: one LiDAR, 30 clouds a second")
        from headvox.synth.presets import lidar

        _record(args, partial(lidar, count=args.people))
        return
    from headvox.synth.presets import room

    device = None if args.sensor == "any" else _device(args.sensor)
    _record(args, partial(room, count=args.people, cameras=args.cameras or 1, device=device))


def _preset(args: argparse.Namespace) -> None:
    from headvox.synth import presets

    lens_of_sensor = {"ideal": "d435i"}
    flags: dict[str, Any] = {"mode": lens_of_sensor.get(args.sensor, args.sensor)}
    flags["sensor"] = _device(args.sensor)[1]
    if args.preset == "two-cameras":
        doing = (("walking", "walk"), ("sitting", "stay"), ("standing", "turn"))
        some = [doing[k % len(doing)] for k in range(args.people)]
        flags |= {"postures": [posture for posture, _ in some], "acts": [act for _, act in some]}
    _record(args, partial(presets.PRESETS[args.preset.replace("-", "_")], **flags))


def _sample(args: argparse.Namespace) -> None:
    from headvox.synth.record import SAMPLE_FRAMES, make_sample

    with _Progress("frame", SAMPLE_FRAMES) as progress:
        make_sample(args.out, workers=of_flags(args), on_done=progress)
    _tell(args.out, [("frames", str(SAMPLE_FRAMES))], progress)


def _device(sensor: str) -> Any:
    """Intrinsics and imperfections of a kind of camera."""
    from headvox.synth.camera import IDEAL, d435i, kinect
    from headvox.synth.mounts import lens

    made = {"kinect": kinect, "ideal": lambda: IDEAL}.get(sensor, d435i)()
    return lens("d435i" if sensor == "ideal" else sensor), made


def _record(args: argparse.Namespace, stage: Callable[..., Scene]) -> None:
    from headvox.synth.record import cloud_stamps, stamps, write_clouds, write_recording

    is_lidar = args.sensor == "lidar"
    times = cloud_stamps(args.frames) if is_lidar else stamps(args.frames, args.hz or 10.0)
    with _Progress("frame", args.frames) as progress:
        progress.live.show("people take their places")
        scene = stage(seed=args.seed, duration_s=times[-1] * 1e-9 + 0.1)
        write = write_clouds if is_lidar else write_recording
        write(args.out, scene, times, of_flags(args), progress)
    seen_by = ", ".join(camera.name for camera in scene.cameras) or "a LiDAR"
    rows = [("frames", str(args.frames)), ("people", str(len(scene.actors))), ("seen by", seen_by)]
    _tell(args.out, rows, progress)


class _Progress:
    """The live line; called with how many things are done."""

    def __init__(self, thing: str, count: int) -> None:
        self.live = Live(sys.stderr, count)
        self.seconds = 0.0
        self._thing, self._count = thing, count
        self._begun = time.perf_counter()

    def __call__(self, done: int) -> None:
        self.seconds = time.perf_counter() - self._begun
        left = self.seconds / done * (self._count - done)
        self.live.show(f"{self._thing} {done}/{self._count}  about {left:.0f} s left")

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *error: object) -> None:
        self.live.close()


def _tell(folder: Path, rows: list[tuple[str, str]], progress: _Progress) -> None:
    files = [path for path in folder.rglob("*") if path.is_file()]
    megabytes = sum(path.stat().st_size for path in files) / 1e6
    rows = [
        ("folder", printable(str(folder))),
        *rows,
        ("size", f"{megabytes:.1f} MB in {len(files)} files"),
        ("time", f"{progress.seconds:.1f} s"),
    ]
    print(table([], [list(row) for row in rows]))


# -------------------------------------------------------------------------------------------------- flags


def _parser() -> Parser:
    parser = Parser(
        "headvox synth",
        description="Make people, heads and recordings, and know exactly where every head is.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    kinds = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    heads = _kind(
        kinds, "heads", _heads, "the paper's data set: bald heads as clouds of evenly spread points"
    )
    heads.add_argument("--count", type=whole_number, default=44, metavar="N", help="how many people (44)")
    heads.add_argument(
        "--points", type=whole(1, MOST_POINTS), default=9000, metavar="N", help="of each cloud (9000)"
    )
    heads.add_argument(
        "--metric", action="store_true", help="keep real sizes; else all have 64 mm between the eyes"
    )
    _add_making(heads)

    scene = _kind(kinds, "scene", _scene, "a depth recording of people who move in a furnished room")
    _add_people(scene, 3)
    scene.add_argument("--cameras", type=whole(1, 8), metavar="N", help="how many, anywhere in the room (1)")
    _add_recording(scene, (*SENSORS, "any", "lidar"))
    for name, text in (
        ("walk", "a depth recording of one person who walks about"),
        ("turn", "a depth recording of one person who turns on the spot, 12 degrees a second"),
        ("crowd", "a depth recording of six people"),
        ("two-cameras", "a recording of the paper's rig: two cameras 4 m apart that face each other"),
    ):
        preset = _kind(kinds, name, _preset, text)
        preset.set_defaults(preset=name)
        if name == "two-cameras":
            _add_people(preset, 1)
        _add_recording(preset, SENSORS)

    sample = _kind(kinds, "sample", _sample, "the sample recording that ships with headvox")
    _add_making(sample, seeded=False)
    return parser


def _kind(
    kinds: argparse._SubParsersAction[Parser],
    name: str,
    function: Callable[[argparse.Namespace], None],
    text: str,
) -> Parser:
    parser = kinds.add_parser(name, help=text, description=sentence(text))
    parser.add_argument("-o", dest="out", type=Path, required=True, metavar="DIR", help="a new folder")
    parser.set_defaults(command=function, parser=parser)
    return parser


def _add_people(parser: argparse.ArgumentParser, usual: int) -> None:
    text = f"how many, up to {MOST_PEOPLE} ({usual})"
    parser.add_argument("--people", type=whole(0, MOST_PEOPLE), default=usual, metavar="N", help=text)


def _add_recording(parser: argparse.ArgumentParser, sensors: Sequence[str]) -> None:
    text = "which sort of sensor (d435i)"
    if "any" in sensors:
        text += "; any: another one for each camera, from clean to terrible"
    parser.add_argument("--sensor", choices=sensors, default="d435i", help=text)
    parser.add_argument("--frames", type=whole(1, 1_000_000), default=100, metavar="N", help="how many (100)")
    parser.add_argument("--hz", type=between(0.01, 1000.0), metavar="HZ", help="frames a second (10)")
    _add_making(parser)


def _add_making(parser: argparse.ArgumentParser, seeded: bool = True) -> None:
    if seeded:
        parser.add_argument(
            "--seed", type=seed_number, default=0, metavar="N", help="another number, others (0)"
        )
    add_flags(parser)
