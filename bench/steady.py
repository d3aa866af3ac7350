"""How steady is what a user gets? The whole chain on simulated D435i at 30 Hz: detector, pose fit, tracker, feedback.

    python bench/steady.py FOLDER [--people 3] [--seconds 4] [--workers 1]

People stand or sit before one camera, or between two that face each other, any side of the head towards them: first
as still as a statue, then looking around (the head turns on its neck; the generator knows neither breath nor sway).
Others walk between two cameras. The recordings go to FOLDER, and are used again when they are there already. Printed:

    found         share of the frames, by the bare detector; missed in a row: mean length of the gaps, and in brackets
                  what it would be if each miss were by itself
    bias          mm, of the mean position: what no filter takes away
    bare          rms jitter of the bare detections within a second, mm (an error that stays for longer does not count)
    stated        what their covariances say that the jitter is, mm
    r1, r10, r30  how alike the errors are 1, 10 and 30 frames apart (autocorrelation, 1 = the same)
    tracked       the same jitter of the tracks
    lag           how many frames a walking head's detections and tracks are behind
"""

from __future__ import annotations

import argparse
import sys
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from headvox.evaluate.scenarios import recording
from headvox.parallel.workers import Workers, add_flags, of_flags
from headvox.pipeline import Detector
from headvox.synth.motion import staying
from headvox.synth.portraits import portrait
from headvox.synth.presets import two_cameras
from headvox.synth.record import stamps, write_recording
from headvox.synth.scene import Scene
from headvox.tracking.tracker import Tracker

HZ = 30
STEADY = 0x57EAD
PLACES = {
    "one camera, 1.5 m": (1.5, 1), "one camera, 2.5 m": (2.5, 1), "one camera, 3.5 m": (3.5, 1),
    "two cameras, 2 m": (2.0, 2),
}  # fmt: skip
ACTS = ("still", "looking")
WALK = "two cameras, walking"
HIT_M = 0.15


@dataclass(frozen=True, slots=True)
class Trail:
    """One person through time: errors (T, 3) of detections and tracks in metres, NaN where there is none."""

    true: np.ndarray
    bare: np.ndarray
    tracked: np.ndarray
    stated_m2: np.ndarray


def scene_of(place: str, act: str, number: int, seconds: float) -> Scene:
    """Return a scene of ``seconds``; the same person in the same room for every act."""
    if place == WALK:
        return two_cameras(STEADY + number, duration_s=seconds)
    distance_m, cameras = PLACES[place]
    rng = np.random.default_rng([STEADY, list(PLACES).index(place), number])
    posture = "standing" if rng.random() < 0.7 else "sitting"
    seed = (STEADY, list(PLACES).index(place), number)
    scene = portrait(seed, distance_m, rng.uniform(-np.pi, np.pi), cameras, posture).scene
    if act == "looking":
        actor = scene.actors[0]
        moments = staying(rng, actor.moments[0], round(seconds * HZ))
        scene.actors = [replace(actor, moments=moments)]
    return scene


def follow(folder: Path) -> Trail:
    """Run the detector without and with a tracker over a recording of one person."""
    true, bare, tracked, stated = [], [], [], []
    nothing = np.full(3, np.nan)
    with closing(Detector()) as alone, closing(Detector()) as led:
        tracker = Tracker()
        for frame, truth in recording(folder).frames():
            person = int(np.argmin(truth.ids))
            place = truth.centres[person]
            heads = alone.detect_frame(frame)
            tracks = tracker.update(led.detect_frame(frame, tracker.expected(frame.stamp_ns)), frame)
            named = tracks.centres[tracks.ids > 0]
            hit = nearest(heads.centres, place)
            own = nearest(named, place)
            true.append(place)
            bare.append(nothing if hit is None else heads.centres[hit] - place)
            tracked.append(nothing if own is None else named[own] - place)
            stated.append(np.nan if hit is None else np.trace(heads.centre_covariances[hit]))
    return Trail(np.array(true), np.array(bare), np.array(tracked), np.array(stated))


def nearest(centres: np.ndarray, place: np.ndarray) -> int | None:
    away = np.linalg.norm(centres - place, axis=1)
    return int(away.argmin()) if len(away) and away.min() < HIT_M else None


def jitter_mm(errors: np.ndarray) -> list[float]:
    """Return the rms distance from the mean of each second but the first, in which a track is new."""
    seconds = [errors[k : k + HZ] for k in range(HZ, len(errors) - HZ + 1, HZ)]
    known = [second[np.isfinite(second[:, 0])] for second in seconds]
    return [1e3 * float(np.sqrt(np.var(some, axis=0).sum())) for some in known if len(some) >= HZ // 2]


def alike(errors: np.ndarray, frames: int) -> tuple[float, float]:
    """Return the sum of products of errors so far apart, and of squares, about their mean."""
    away = errors - np.nanmean(errors, axis=0)
    product = (away[frames:] * away[:-frames]).sum(axis=1)
    return float(np.nanmean(product)), float(np.nanmean((away**2).sum(axis=1)))


def gaps(found: np.ndarray) -> tuple[int, int]:
    """Return how many frames were missed, and in how many runs."""
    missed = ~found
    return int(missed.sum()), int((missed[1:] & ~missed[:-1]).sum() + missed[0])


def lag_frames(true: np.ndarray, errors: np.ndarray) -> list[float]:
    """Return how far behind each place along the way is, in frames, where somebody walks."""
    step = np.gradient(true[:, :2], axis=0)
    walks = (np.linalg.norm(step, axis=1) * HZ > 0.5) & np.isfinite(errors[:, 0])
    return (-(errors[walks, :2] * step[walks]).sum(1) / (step[walks] ** 2).sum(1)).tolist()


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else np.nan


def row(name: str, trails: list[Trail]) -> str:
    """Return a line of the table."""
    found = np.concatenate([np.isfinite(t.bare[:, 0]) for t in trails])
    missed, runs = np.sum([gaps(np.isfinite(t.bare[:, 0])) for t in trails], axis=0)
    length = f"{missed / runs:4.1f} ({1.0 / max(found.mean(), 1e-9):.1f})" if runs else "          "
    known = [t for t in trails if np.isfinite(t.bare[:, 0]).sum() > HZ]
    bias = rms([1e3 * float(np.linalg.norm(np.nanmean(t.bare, axis=0))) for t in known])
    bare = rms([mm for t in known for mm in jitter_mm(t.bare)])
    tracked = rms([mm for t in known for mm in jitter_mm(t.tracked)])
    stated = 1e3 * np.sqrt(np.nanmean(np.concatenate([t.stated_m2 for t in trails])))
    r = []
    for apart in (1, 10, 30):
        products, squares = zip(*(alike(t.bare, apart) for t in known), strict=True)
        r.append(sum(products) / sum(squares))
    lags = [np.median([lag for t in trails for lag in lag_frames(t.true, e(t))] or [np.nan]) for e in
            (lambda t: t.bare, lambda t: t.tracked)]  # fmt: skip
    behind = "" if np.isnan(lags[0]) else f"{lags[0]:7.2f} {lags[1]:5.2f}"
    return (
        f"{name:28s}{found.mean():6.2f} {length:11s}{bias:6.1f}{bare:7.1f}{stated:8.1f}"
        f"{r[0]:7.2f}{r[1]:6.2f}{r[2]:6.2f}{tracked:9.1f}{behind}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--people", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=4.0)
    add_flags(parser, usual=1)
    args = parser.parse_args()
    workers: Workers = of_flags(args)
    print(
        f"{'':28s} found missed in a row  bias   bare  stated     r1   r10   r30  tracked    lag", flush=True
    )
    jobs = [(place, act) for place in PLACES for act in ACTS] + [(WALK, "walking")]
    for place, act in jobs:
        trails = []
        for number in range(args.people):
            folder = args.folder / f"{place} {act} {number}".replace(",", "").replace(" ", "-")
            if not folder.is_dir():
                scene = scene_of(place, act, number, args.seconds)
                write_recording(folder, scene, stamps(round(args.seconds * HZ), HZ), workers)
            trails.append(follow(folder))
        print(row(place if place == WALK else f"{place}, {act}", trails), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
