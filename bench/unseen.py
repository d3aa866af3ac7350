"""What does a cascade find in rendered views that nothing was chosen on, and of which heads?

    python bench/unseen.py FOLDER --seed 79 [--views 1500] [--cascade default] [--refine pose] [--clouds world]

Looks at the depth images among the first views of a seed, and prints markdown tables: which share of the heads is found
at so many false heads a frame; then, with the cascade's own threshold, by what is known of each head.
FOLDER keeps the views, which take a quarter of a second each to make. A seed is unseen once: whoever changes a cascade
after reading its tables takes another.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from headvox.config import DetectorConfig
from headvox.data import F64, Cloud, Frame
from headvox.evolve.check import LEAST_SCORE, Outcome, points_of, scores_in
from headvox.evolve.samples import RANGE_M, to_find
from headvox.evolve.views import KINDS, View, keep_view
from headvox.frames import inverse, placed, transform
from headvox.masks.read import load_cascade
from headvox.pipeline import Detector
from headvox.synth.scene import POSTURES

RATES = (0.01, 0.02, 0.05, 0.1, 0.2)  # false heads a frame
ORDINARY_POSTURES = ("standing", "walking", "sitting")
CLEAR_SHARE, CLEAR_M = 0.3, 4.0
RANGES_M, SHARES = (0.0, 1.0, 2.0, 3.0, 4.0, RANGE_M), (0.2, 0.4, 0.6, 0.8, 1.0)
FEWEST = 10  # heads, of which a share is told
TURNED = placed((0.0, 0.0, 0.0), (0.2, 0.4, 0.5, 0.7416198487095663))  # about no axis of a camera


@dataclass(frozen=True)
class Head:
    """A head to find: how much it scored, and what is known of it."""

    score: float
    posture: str
    hair: str
    visible: float
    range_m: float
    kind: str
    cameras: int
    image: str


@dataclass(frozen=True)
class Seen:
    """What a detector said of all views, and of those with nobody in them."""

    heads: list[Head]
    all: Outcome
    nobody: Outcome


def look(folder: Path, seed: int, views: int, detector: Detector, clouds: str | None) -> Seen:
    """Run ``detector`` over the depth images among the first ``views`` of ``seed``, or points in place of them."""
    heads: list[Head] = []
    false: list[F64] = []
    of_nobody: list[F64] = []
    for number in range(views):
        if KINDS[number % len(KINDS)] in ("bodies", "shell"):
            continue  # clouds
        view = keep_view(folder, seed, number)
        frame = frame_of(view, clouds)
        scores = None if frame is None else scores_in(view, detector, frame)
        if scores is None:
            continue
        wanted = np.flatnonzero(to_find(view)).tolist()
        heads += [_head(view, k, float(score)) for k, score in zip(wanted, scores[0], strict=True)]
        false.append(scores[1])
        if view.kind == "nobody":
            of_nobody.append(scores[1])
    return Seen(heads, _outcome([head.score for head in heads], false), _outcome([], of_nobody))


def frame_of(view: View, clouds: str | None) -> Frame | None:
    """Return what is looked at of ``view``; None where there are too few cameras."""
    frame = view.frame
    if clouds is None:
        return frame
    if clouds != "beside":
        return points_of(frame, in_world=clouds == "world")
    others = points_of(replace(frame, depths=frame.depths[1:]), in_world=False).clouds
    return (
        replace(frame, clouds=tuple(map(_as_of_a_lidar, others)), depths=frame.depths[:1]) if others else None
    )


def _as_of_a_lidar(cloud: Cloud) -> Cloud:
    """Return ``cloud`` in a turned frame, in which its points are on the rays of no pinhole camera."""
    assert cloud.T_world_sensor is not None
    points = transform(TURNED, cloud.points).astype(np.float32)
    return replace(cloud, points=points, T_world_sensor=cloud.T_world_sensor @ inverse(TURNED))


def _outcome(heads: list[float], false: list[F64]) -> Outcome:
    return Outcome(np.array(heads), np.concatenate([*false, np.empty(0)]), len(false))


def _head(view: View, k: int, score: float) -> Head:
    heads, images = view.heads, view.frame.depths
    eyes = [transform(inverse(image.T_world_camera), heads.centres[k : k + 1]) for image in images]
    lens = images[0].intrinsics
    return Head(
        score,
        POSTURES[heads.posture[k]],
        heads.hair[k] if heads.hair else "not noted",
        float(heads.visible[k]),
        min(float(np.linalg.norm(eye)) for eye in eyes),
        view.kind,
        len(images),
        f"{lens.width}x{lens.height}",
    )


def tables(seen: Seen, least: float) -> Iterator[str]:
    """Yield all that is printed, line by line; ``least`` is the cascade's own threshold."""
    false, of_nobody = (int((outcome.false >= least).sum()) for outcome in (seen.all, seen.nobody))
    rate = false / max(seen.all.frames, 1)
    yield f"{seen.all.frames} frames, {len(seen.heads)} heads; with {least:g}: {rate:.3f} false a frame,"
    yield f"{of_nobody} in the {seen.nobody.frames} with nobody"
    yield ""
    yield _row("", *(f"{rate:g} false" for rate in RATES), f"{least:g}")
    yield _row(*["---"] * (len(RATES) + 2))
    for name, chosen in GROUPS.items():
        scores = np.array([head.score for head in seen.heads if chosen(head)])
        shares = [_share(scores, seen.all.threshold(rate)) for rate in RATES]
        yield _row(f"{name} ({len(scores)})", *shares, _share(scores, least))
    for names in (
        [head.posture for head in seen.heads],
        [_between(head.range_m, RANGES_M, " m") for head in seen.heads],
        [_between(head.visible, SHARES, " seen") for head in seen.heads],
        [f"{head.cameras} cameras" if head.cameras > 1 else "1 camera" for head in seen.heads],
        [head.image for head in seen.heads],
        [head.hair for head in seen.heads],
    ):
        yield ""
        yield from _by(names, seen, least)


def _is_clear(head: Head) -> bool:
    return head.visible >= CLEAR_SHARE and head.range_m <= CLEAR_M


GROUPS: dict[str, Callable[[Head], bool]] = {
    "all heads": lambda head: True,
    "clear": _is_clear,
    "upright": lambda head: _is_clear(head) and head.posture in ORDINARY_POSTURES,
    "ordinary rooms": lambda head: _is_clear(head) and head.kind == "ordinary",
}


def _by(names: list[str], seen: Seen, least: float) -> Iterator[str]:
    """Yield a table with a column for each of ``names``, one a head."""
    scores, of = np.array([head.score for head in seen.heads]), np.array(names)
    columns = [name for name in sorted(set(names)) if (of == name).sum() >= FEWEST]
    yield _row(*(f"{name} ({int((of == name).sum())})" for name in columns))
    yield _row(*["---"] * len(columns))
    yield _row(*(_share(scores[of == name], least) for name in columns))


def _between(value: float, borders: tuple[float, ...], unit: str) -> str:
    k = int(np.clip(np.searchsorted(borders, value, "right") - 1, 0, len(borders) - 2))
    return f"{borders[k]:g}-{borders[k + 1]:g}{unit}"


def _share(scores: F64, least: float) -> str:
    return f"{100.0 * float((scores >= least).mean()):.1f} %" if len(scores) else ""


def _row(*columns: str) -> str:
    return f"| {' | '.join(columns)} |"


def main() -> None:
    """Look, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--views", type=int, default=1500)
    parser.add_argument("--cascade", default="default")
    parser.add_argument("--refine", default="pose", choices=("pose", "sphere"))
    parser.add_argument(
        "--clouds",
        choices=("world", "camera", "beside"),
        help="points instead of images, in the frame of one of these; or instead of all images but the first",
    )
    args = parser.parse_args()
    config = DetectorConfig(cascade=args.cascade, max_range_m=RANGE_M, refine=args.refine)
    cascade = load_cascade(args.cascade)
    least = cascade.min_score_occupied if args.clouds == "world" else cascade.min_score
    detector = Detector(replace(config, min_score=LEAST_SCORE))
    for line in tables(look(args.folder, args.seed, args.views, detector, args.clouds), least):
        print(line, flush=True)


if __name__ == "__main__":
    main()
