"""How well does the tracker keep people apart, and how smooth is it? On crowds that are simulated up to the detections.

    python bench/track.py [--people 2 4 6] [--hz 10 30] [--drop 0 10 30] [--runs 3] [--seconds 30]

People of different heights walk between places of a room of 4 m by 3 m, cross, stop, stand embraced for a while, and
leave the camera's view and come back. A coarse depth image of them (spheres on cylinders) tells who hides whom. The
detector is imitated: each head that is seen is found with the noise that `python bench/steady.py FOLDER` measured
(1.5 mm per m² on each axis, new in every frame, and 5 mm that stay while the head does; stated are 7 mm + 0.6 mm per
m²), is missed with the given probability (half of it in bursts: that is assumed, standing people were hardly missed
there), and of two heads closer than 18 cm one is found; now and then there is something that is no head. Printed for
each kind of crowd:

    MOTA, IDF1    by motmetrics, of everything that has an id, within 30 cm; hidden heads count neither way
    switches      of identity, a minute
    alone         MOTA of the bare detections, if every one were given its right id
    still (bare)  rms jitter within a second of people who have stood for 3 s (mm), of tracks and of bare detections
    halt (bare)   the same of those who have stood for 1 s
    lag           how many frames the track of a walking head is behind
    ms            a frame, median

Measure real frames with `headvox run RECORDING --json > found.jsonl; headvox eval RECORDING --heads found.jsonl`.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from headvox.data import DepthImage, Frame, Heads, Intrinsics, State
from headvox.evaluate.found import FoundHeads
from headvox.evaluate.match import Rules
from headvox.evaluate.metrics import Sample
from headvox.evaluate.tracking import score_tracks
from headvox.evaluate.truth import NO_ID, TrueHeads
from headvox.tracking.tracker import Tracker

CAMERA = Intrinsics(160, 90, 90.0, 90.0, 79.5, 44.5)
T_WORLD_CAMERA = np.array(
    [[0.0, -0.25881905, 0.96592583, -2.8], [-1, 0, 0, 0], [0, -0.96592583, -0.25881905, 2.2], [0, 0, 0, 1]]
)
HEAD_RADIUS_M, BODY_RADIUS_M = 0.1, 0.18
FINE_HZ = 60
RULES = Rules(radius_m=0.3)
FALSE_A_FRAME = 0.05
CLOSEST_M = 0.28
NOISE_M_M2 = 0.0015  # a detection's noise on each axis: new in every frame
BIAS_M, TURNS_M = 0.005, 0.5  # and what stays while the head does, and changes as it walks on so far
STATED_M, STATED_M_M2 = 0.007, 0.0006  # what the detector says that both are
SAME_HEAD_M = 0.18


@dataclass(slots=True)
class Person:
    """Where a head is, 60 times a second: ``path`` (T, 3) metres, and ``speed`` (T,) m/s."""

    path: np.ndarray
    speed: np.ndarray


def crowd(rng: np.random.Generator, count: int, seconds: float) -> list[Person]:
    """People who walk from place to place: pairs meet and stand embraced, some leave and come back, one only stands."""
    tours = []
    for k in range(count):
        inside = [rng.uniform((-1.2, -1.1), (1.8, 1.1)) for _ in range(6)]
        tour = [(rng.uniform(0, 3), place) for place in inside]
        middle = np.array([rng.uniform(0.0, 1.0), -0.6 + 0.6 * (k // 2)])
        tour[2] = (
            3.0,
            tours[-1][2][1] + np.array([0.0, 0.3]) if k % 2 else middle,
        )  # 30 cm from head to head
        if k % 3 == 0:
            tour[4] = (1.5, np.array([inside[4][0], 3.0]))  # out of view
        tours.append([(1e9, inside[0])] if count > 2 and k == count - 1 else tour)
    return stroll(rng, tours, round(seconds * FINE_HZ))


def stroll(rng: np.random.Generator, tours: list[list[tuple[float, np.ndarray]]], steps: int) -> list[Person]:
    """Let each go to the places of their tour in turn, and stay there for the seconds given with it, over and over."""
    count = len(tours)
    xy = np.array([tour[0][1] for tour in tours])
    speed, goal, wait = np.zeros(count), np.zeros(count, int), np.zeros(count)
    pace, phase = rng.uniform(0.6, 1.2, count), rng.uniform(0, 2 * np.pi, count)
    heights = rng.uniform(1.45, 1.85, count)
    people = [Person(np.empty((steps, 3)), np.empty(steps)) for _ in tours]
    for step in range(steps):
        before = xy.copy()
        for k, tour in enumerate(tours):
            way = tour[goal[k]][1] - xy[k]
            far = float(np.hypot(*way))
            if far < 0.05:
                wait[k] += 1 / FINE_HZ
                if wait[k] > tour[goal[k]][0]:
                    goal[k], wait[k] = (goal[k] + 1) % len(tour), 0.0
            speed[k] += np.clip(min(pace[k], 2.0 * far) - speed[k], -3.6 / FINE_HZ, 1.2 / FINE_HZ)
            if far > 1e-9:
                xy[k] += way / far * min(speed[k] / FINE_HZ, far)
        for k in range(count):
            for other in range(k):  # nobody walks through anybody
                way = xy[k] - xy[other]
                apart = max(float(np.hypot(*way)), 1e-6)
                if apart < CLOSEST_M:
                    push = way / apart * min(0.5 * (CLOSEST_M - apart), 1.0 / FINE_HZ)
                    xy[k] += push
                    xy[other] -= push
        moved = np.linalg.norm(xy - before, axis=1) * FINE_HZ
        phase += 2 * np.pi * moved / 1.35 / FINE_HZ
        for k, person in enumerate(people):
            ahead = (xy[k] - before[k]) / max(np.hypot(*(xy[k] - before[k])), 1e-9)
            sway = 0.025 * min(moved[k] / 1.2, 1.0)
            person.path[step, :2] = xy[k] + np.array([-ahead[1], ahead[0]]) * sway * np.sin(phase[k])
            person.path[step, 2] = heights[k] + sway * np.sin(2 * phase[k])
            person.speed[step] = moved[k]
    return people


def look(places: np.ndarray) -> tuple[DepthImage, np.ndarray]:
    """Return what the camera sees, and which share (N,) of each head it sees."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1)
    rays = rays @ T_WORLD_CAMERA[:3, :3].T
    eye = T_WORLD_CAMERA[:3, 3]
    far, owner = np.full(u.shape, 6.0), np.full(u.shape, -1)
    alone = np.zeros(len(places))
    for n, place in enumerate(places):
        head = _ball(rays, eye, place, HEAD_RADIUS_M)
        alone[n] = np.isfinite(head).sum()
        body = _pillar(rays, eye, place)
        for surface, label in ((head, n), (body, len(places))):
            nearer = surface < far
            far[nearer], owner[nearer] = surface[nearer], label
    shares = np.array([(owner == n).sum() for n in range(len(places))]) / np.maximum(alone, 1)
    shares[alone < 15] = 0.0  # out of view, or only just in it
    return DepthImage("front", np.round(far * 1000).astype(np.uint16), CAMERA, T_WORLD_CAMERA), shares


def _ball(rays: np.ndarray, eye: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    a, b = (rays**2).sum(-1), rays @ (centre - eye)
    rest = b**2 - a * (((centre - eye) ** 2).sum() - radius**2)
    hit = (rest > 0) & (b > 0)
    return np.where(hit, (b - np.sqrt(np.maximum(rest, 0))) / a, np.inf)


def _pillar(rays: np.ndarray, eye: np.ndarray, head: np.ndarray) -> np.ndarray:
    flat, way = rays[..., :2], head[:2] - eye[:2]
    a, b = (flat**2).sum(-1), flat @ way
    rest = b**2 - a * ((way**2).sum() - BODY_RADIUS_M**2)
    t = (b - np.sqrt(np.maximum(rest, 0))) / a
    height = eye[2] + t * rays[..., 2]
    return np.where((rest > 0) & (b > 0) & (height < head[2] - 0.22), t, np.inf)


@dataclass(slots=True)
class Outcome:
    """What came of one run."""

    mota: float
    idf1: float
    switches_a_minute: float
    alone: float
    ms: list[float]
    still_mm: list[float] = field(default_factory=list)
    still_bare_mm: list[float] = field(default_factory=list)
    halt_mm: list[float] = field(default_factory=list)
    halt_bare_mm: list[float] = field(default_factory=list)
    lag_frames: list[float] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Moment:
    """One frame of a crowd: what the tracker gets, and the truth.

    ``found`` are the people that the first of ``heads`` are, in their order; what comes after is no head. ``shares``
    (N,) is how much of each head the camera sees.
    """

    step: int
    frame: Frame
    heads: Heads
    found: list[int]
    places: np.ndarray
    shares: np.ndarray


def watch(rng: np.random.Generator, people: list[Person], hz: int, drop: float) -> Iterator[Moment]:
    """Imitate a detector."""
    count, steps = len(people), len(people[0].path)
    bias, burst = rng.normal(0, BIAS_M, (count, 3)), np.zeros(count, bool)
    for k in range(steps * hz // FINE_HZ):
        step = k * FINE_HZ // hz
        true = np.array([person.path[step] for person in people])
        image, shares = look(true)
        away = np.linalg.norm(true - T_WORLD_CAMERA[:3, 3], axis=1)
        speed = np.array([person.speed[step] for person in people])
        keep = np.exp(-speed / hz / TURNS_M)[:, None]
        bias = keep * bias + np.sqrt(1 - keep**2) * rng.normal(0, BIAS_M, (count, 3))
        # Half of the missing come in bursts of five frames on average.
        burst = np.where(burst, rng.random(count) > 0.2, rng.random(count) < 0.1 * drop / (1 - 0.5 * drop))
        missed = burst | (rng.random(count) < 0.5 * drop)
        measured = true + bias + (NOISE_M_M2 * away**2)[:, None] * rng.normal(size=(count, 3))
        found: list[int] = []
        for n in np.flatnonzero((shares > 0.5) & ~missed):
            if all(np.linalg.norm(measured[n] - measured[m]) >= SAME_HEAD_M for m in found):
                found.append(int(n))
        centres = [measured[n] for n in found]
        false = rng.poisson(FALSE_A_FRAME)
        centres.extend(rng.uniform((-1.2, -1.2, 0.8), (2.0, 1.2, 1.8), (false, 3)))
        frame = Frame(round(k * 1e9 / hz), depths=(image,))
        yield Moment(step, frame, heads_at(centres), found, true, shares)


def run(count: int, hz: int, drop: float, seconds: float, seed: int) -> Outcome:
    """Let a tracker follow a crowd."""
    rng = np.random.default_rng([seed, count, hz, round(100 * drop)])
    people = crowd(rng, count, seconds)
    return follow(people, watch(rng, people, hz, drop), hz, seconds)


def follow(people: list[Person], moments: Iterable[Moment], hz: int, seconds: float) -> Outcome:
    """Let a tracker follow people, and score it."""
    count = len(people)
    tracker, samples, bare, ms = Tracker(), [], [], []
    trails: dict[int, list[tuple[int, np.ndarray, np.ndarray]]] = {n: [] for n in range(count)}
    for moment in moments:
        frame, heads, true = moment.frame, moment.heads, moment.places
        begun = time.perf_counter()
        tracker.expected(frame.stamp_ns)
        tracks = tracker.update(heads, frame)
        ms.append(1e3 * (time.perf_counter() - begun))
        known = tracks.states != State.TENTATIVE
        truth = TrueHeads(
            frame.stamp_ns, true, np.full((count, 4), np.nan), np.arange(count), moment.shares < 0.5,
            np.zeros(count, bool), ({},) * count, {},
        )  # fmt: skip
        eye = T_WORLD_CAMERA[None, :3, 3]
        samples.append(Sample(frame.stamp_ns, as_found(tracks.centres[known], tracks.ids[known]), truth, eye))
        nobody = range(1000 + len(ms), 1000 + len(ms) + len(heads) - len(moment.found))
        ids = np.array([*moment.found, *nobody], np.int64)
        bare.append(Sample(frame.stamp_ns, as_found(heads.centres, ids), truth, eye))
        for n, measured in zip(moment.found, heads.centres, strict=False):
            near = np.linalg.norm(tracks.centres - true[n], axis=1)
            if len(near) and near.min() < 0.15 and known[near.argmin()]:
                trails[n].append((moment.step, tracks.centres[near.argmin()] - true[n], measured - true[n]))
    scores, alone = score_tracks(samples, RULES), score_tracks(bare, RULES)
    assert scores is not None
    assert alone is not None
    switches = 60.0 * (scores.switches or 0) / seconds
    outcome = Outcome(scores.mota or 0.0, scores.idf1 or 0.0, switches, alone.mota or 0.0, ms)
    for n, person in enumerate(people):
        measure_trail(outcome, person, trails[n], hz)
    return outcome


def measure_trail(
    outcome: Outcome, person: Person, trail: list[tuple[int, np.ndarray, np.ndarray]], hz: int
) -> None:
    """Add the jitter of a standing head, by second, to that of its kind, and the lag of a walking one."""
    if not trail:
        return
    steps, errors, measured = (np.array(column) for column in zip(*trail, strict=True))
    for start in range(FINE_HZ, int(steps[-1]), FINE_HZ):
        now = (steps >= start) & (steps < start + FINE_HZ)
        rests = person.speed[: start + FINE_HZ] < 1e-3
        if now.sum() < 0.6 * hz or not rests[start - FINE_HZ :].all():
            continue
        long = start >= 3 * FINE_HZ and bool(rests[start - 3 * FINE_HZ :].all())
        kept = (outcome.still_mm, outcome.still_bare_mm) if long else (outcome.halt_mm, outcome.halt_bare_mm)
        for mm, of in zip(kept, (errors, measured), strict=True):
            mm.append(1e3 * float(np.sqrt(np.var(of[now], axis=0).sum())))
    ahead = np.gradient(person.path[:, :2], 1 / FINE_HZ, axis=0)[steps]
    walking = person.speed[steps] > 0.5
    speed = np.linalg.norm(ahead, axis=1)
    behind = -(errors[:, :2] * ahead).sum(1)[walking] / speed[walking] ** 2 * hz
    outcome.lag_frames.extend(behind.tolist())


def heads_at(centres: list[np.ndarray]) -> Heads:
    """Return heads as the detector would, with the covariances that it states."""
    n = len(centres)
    places = np.array(centres).reshape(n, 3)
    sigma = STATED_M + STATED_M_M2 * ((places - T_WORLD_CAMERA[:3, 3]) ** 2).sum(axis=1)
    return Heads(
        places, np.full((n, 4), np.nan), np.full(n, HEAD_RADIUS_M), np.full(n, 5.0),
        sigma[:, None, None] ** 2 * np.eye(3),
    )  # fmt: skip


def as_found(centres: np.ndarray, ids: np.ndarray) -> FoundHeads:
    """Return what is to be scored; no id but what is given."""
    assert (ids != NO_ID).all()
    n = len(centres)
    return FoundHeads(centres, np.full((n, 4), np.nan), np.ones(n), ids)


def row(runs: list[Outcome]) -> str:
    """Return the figures of a line."""
    mota, idf1, switches, alone = (
        np.mean([getattr(r, name) for r in runs]) for name in ("mota", "idf1", "switches_a_minute", "alone")
    )
    jitters = []
    for name in ("still_mm", "still_bare_mm", "halt_mm", "halt_bare_mm"):
        mm = np.concatenate([getattr(r, name) for r in runs])
        jitters.append(f"{np.sqrt(np.mean(np.square(mm))):4.1f}" if len(mm) else "   -")
    still, still_bare, halt, halt_bare = jitters
    lag = np.concatenate([r.lag_frames for r in runs]).mean()
    ms = np.median(np.concatenate([r.ms for r in runs]))
    return (
        f"{mota:7.3f}{idf1:7.3f}{switches:10.2f}{alone:7.3f}      {still}  ({still_bare})     {halt}  ({halt_bare})"
        f"{lag:6.2f}{ms:7.3f}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--people", type=int, nargs="+", default=[2, 4, 6])
    parser.add_argument("--hz", type=int, nargs="+", default=[10, 30])
    parser.add_argument("--drop", type=float, nargs="+", default=[0, 10, 30], help="percent")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    print("people  Hz  drop   MOTA   IDF1  switches  alone  still mm  (bare)  halt mm  (bare)   lag     ms")
    for people in args.people:
        for hz in args.hz:
            for drop in args.drop:
                seeds = range(args.seed, args.seed + args.runs)
                runs = [run(people, hz, drop / 100, args.seconds, seed) for seed in seeds]
                print(f"{people:6d}{hz:4d}{drop:5.0f}%{row(runs)}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
