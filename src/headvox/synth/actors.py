"""People in a scene: who takes part, where they are put, and what they do.

Whoever sits or lies gets a chair, a sofa, a table or a bed of the right height with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from headvox.data import F64
from headvox.synth.floorplan import FloorPlan, footprint
from headvox.synth.furniture import Item, bed, chair, pick, sofa, table
from headvox.synth.makers import People
from headvox.synth.motion import RATE_HZ, Moment, live
from headvox.synth.people import PosedBody
from headvox.synth.room import ON_TABLES, Room

Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class Actor:
    """A person and their moments, one every 1/30 s (the last one lasts); ``cloth`` is an albedo, 0..1."""

    id: int
    person: Any
    moments: Sequence[Moment]
    cloth: float

    def body(self, people: People, stamp_ns: int) -> PosedBody:
        """Their triangles at a time."""
        step = min(round(stamp_ns * RATE_HZ * 1e-9), len(self.moments) - 1)
        moment = self.moments[step]
        return people.pose_person(self.person, moment.pose, moment.xy, moment.heading_rad, moment.floor_z)


def place_person(
    rng: Rng,
    people: People,
    room: Room,
    number: int,
    posture: str,
    reach_m: tuple[float, float] | None = None,
    beside: tuple[float, float] | None = None,
) -> Actor | None:
    """Put a person with what they sit or lie on where there is space; None when the room is too full.

    ``reach_m`` keeps them within so many metres of the room's middle, along x and y; ``beside`` looks near a
    place first.
    """
    person = people.sample_person(rng)
    reach_m = (0.47 * room.x_m, 0.47 * room.y_m) if reach_m is None else reach_m
    pose = people.sample_pose(rng, posture)
    body = people.pose_person(person, pose, (0.0, 0.0), 0.0, 0.0)
    furniture = _furniture(rng, body)
    lift = 0.0
    if posture == "lying" and furniture:
        lift = 0.98 * float(furniture[0][0].vertices[:8, 2].max())
    ground = body.vertices[:: max(1, len(body.vertices) // 400), :2]
    for attempt in range(25):
        at = rng.uniform(-1.0, 1.0, 2) * reach_m
        if beside is not None and attempt < 12:
            at = np.array(beside) + rng.normal(0.0, 0.5, 2)
        x, y = (float(n) for n in at)
        yaw = float(rng.uniform(-np.pi, np.pi))
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, s], [-s, c]])
        spots = [_shifted(at, turn, x, y) for _, at in furniture]
        places = [
            footprint(thing, px, py, yaw) for (thing, _), (px, py) in zip(furniture, spots, strict=True)
        ]
        if room.plan.conflict(np.concatenate([ground @ turn + (x, y), *places])) > 0.01:
            continue
        for (thing, _), (px, py) in zip(furniture, spots, strict=True):
            room.add(thing, px, py, yaw)
        room.plan.take(ground @ turn + (x, y), by_person=True)
        cloth = float(rng.uniform(0.03, 0.12) if rng.uniform() < 0.12 else rng.uniform(0.15, 0.9))
        return Actor(number, person, [Moment(pose, (x, y), yaw, lift)], cloth)
    return None


def _shifted(at: tuple[float, float], turn: F64, x: float, y: float) -> tuple[float, float]:
    px, py = np.array(at) @ turn
    return float(px) + x, float(py) + y


def _furniture(rng: Rng, body: PosedBody) -> list[tuple[Item, tuple[float, float]]]:
    """What this body sits or lies on, and where it stands from the body's own origin."""
    if body.posture == "lying":
        if rng.uniform() < 0.5:
            return []
        middle = (body.vertices.min(axis=0) + body.vertices.max(axis=0))[:2] / 2.0
        size = np.ptp(body.vertices, axis=0)
        couch = bed(rng)
        if size[1] > size[0]:
            couch = couch.placed(0.0, 0.0, np.pi / 2.0)
        return [(couch, (float(middle[0]), float(middle[1])))]
    if body.posture != "sitting":
        return []
    back, seat, knees = _sitting_measures(body)
    if seat < 0.12:
        return []  # on the floor
    kind = rng.uniform()
    if kind < 0.8:
        under = chair(rng, seat, back=bool(rng.uniform() < 0.8))
        things = [(under, (back + 0.22, 0.0))]
    else:
        things = [(sofa(rng, seat), (back + 0.3, 0.0))]
    if rng.uniform() < 0.35 and knees < 0.74:
        desk = table(rng, max(knees + 0.06, 0.68))
        at = (back + 0.45 - float(desk.vertices[:, 0].min()), 0.0)
        things.append((desk, at))
        for _ in range(int(rng.integers(0, 3))):
            spot = (at[0] + float(rng.uniform(-0.1, 0.25)), float(rng.uniform(-0.4, 0.4)))
            things.append((pick(rng, ON_TABLES).placed(0.0, 0.0, np.pi, desk.top()), spot))
    return things


def _sitting_measures(body: PosedBody) -> tuple[float, float, float]:
    """Of a body that sits at the origin and faces x: where its back ends, heights of seat and knees [m]."""
    trunk = body.vertices[np.abs(body.vertices[:, 1] - np.median(body.vertices[:, 1])) < 0.14]
    back = float(trunk[:, 0].min())
    behind = trunk[trunk[:, 0] < back + 0.25]
    front = body.vertices[body.vertices[:, 0] > body.vertices[:, 0].max() - 0.35]
    return back, float(behind[:, 2].min()), float(np.percentile(front[:, 2], 95))


def animated(
    rng: Rng, people: People, plan: FloorPlan, actors: list[Actor], acts: Sequence[str], duration_s: float
) -> list[Actor]:
    """The same people, doing what ``acts`` says (see :func:`.motion.live`)."""
    steps = max(1, round(duration_s * RATE_HZ))
    lives = live(rng, people, plan, [actor.moments[0] for actor in actors], acts, steps)
    return [replace(actor, moments=moments) for actor, moments in zip(actors, lives, strict=True)]
