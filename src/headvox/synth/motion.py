"""What people do from moment to moment: walk about, stand, turn, sit down and stand up, look around.

Everything is drawn once, as a list of moments 1/30 s apart; a scene only looks moments up, so that frames can
be made in any order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from headvox.data import F64
from headvox.errors import HeadvoxError
from headvox.synth.floorplan import CELL_M, FloorPlan
from headvox.synth.makers import People
from headvox.synth.poses import Pose

Rng = np.random.Generator
Mask = npt.NDArray[np.bool_]

RATE_HZ = 30.0
STRIDE_M = 1.35  # two steps
PERSONAL_M = 0.65
TURN_RAD_S = 1.8
SPEED_UP_M_S2 = 1.2
WARM_UP = 60  # steps


@dataclass(frozen=True, slots=True)
class Moment:
    """How and where somebody is: hips above ``xy``, facing ``heading_rad``, lowest point at ``floor_z``."""

    pose: Pose
    xy: tuple[float, float]
    heading_rad: float
    floor_z: float = 0.0


def between(first: Pose, second: Pose, share: float) -> Pose:
    """A pose on the way from one to another, ``share`` 0..1; it takes the name of the nearer one."""
    names = ("pelvis", "chest", "head", "arms", "legs", "feet", "hands", "whole")
    mixed = {name: _mix(getattr(first, name), getattr(second, name), share) for name in names}
    return replace(first if share < 0.5 else second, **mixed)


def _mix(first: Any, second: Any, share: float) -> Any:
    if isinstance(first, tuple):
        return tuple(_mix(a, b, share) for a, b in zip(first, second, strict=True))
    return float((1.0 - share) * first + share * second)


def wander(rng: Rng, steps: int, spread: float, period_s: float) -> F64:
    """A smooth random signal (steps,) of standard deviation ``spread`` that changes within ``period_s``."""
    sigma = period_s * RATE_HZ / 4.0
    white = rng.standard_normal(steps + int(8 * sigma))
    smooth = ndimage.gaussian_filter1d(white, sigma, mode="wrap") * np.sqrt(2.0 * sigma * np.sqrt(np.pi))
    return np.asarray(spread * smooth[:steps])


def looking(rng: Rng, poses: Sequence[Pose]) -> list[Pose]:
    """The same poses with a head that looks around."""
    roll, pitch = wander(rng, len(poses), 0.06, 2.0), wander(rng, len(poses), 0.12, 2.0)
    yaw = np.clip(wander(rng, len(poses), 0.45, 2.5), -1.2, 1.2)
    return [
        replace(
            p, head=(p.head[0] + float(r), p.head[1] + float(q), float(np.clip(p.head[2] + y, -1.3, 1.3)))
        )
        for p, r, q, y in zip(poses, roll, pitch, yaw, strict=True)
    ]


@dataclass(frozen=True, slots=True)
class Stroll:
    """Where a walker is at every step: ``xy`` (T, 2) metres, ``heading_rad`` (T,), ``speed`` (T,) m/s."""

    xy: F64
    heading_rad: F64
    speed: F64


def stroll(
    rng: Rng, plan: FloorPlan, starts: F64, headings: F64, bystanders: F64, steps: int
) -> list[Stroll]:
    """Let people walk between random places of the free floor; they wait for, and go round, each other.

    ``starts`` (N, 2), ``headings`` (N,), ``bystanders`` (M, 2) people who stay where they are.
    """
    free = _roomy(plan)
    xy, heading, speed = starts.copy(), headings.copy(), np.zeros(len(starts))
    pace = rng.uniform(0.6, 1.3, len(starts))
    goals = starts.copy()
    paths = [Stroll(np.empty((steps, 2)), np.empty(steps), np.empty(steps)) for _ in starts]
    for step in range(steps):
        for k in range(len(xy)):
            others = np.concatenate([np.delete(xy, k, axis=0), bystanders])
            if np.hypot(*(goals[k] - xy[k])) < 0.25:
                goals[k] = _goal(rng, plan, free, xy[k], others)
            way = goals[k] - xy[k]
            off = (float(np.arctan2(way[1], way[0])) - heading[k] + np.pi) % (2.0 * np.pi) - np.pi
            heading[k] += float(np.clip(off, -TURN_RAD_S / RATE_HZ, TURN_RAD_S / RATE_HZ))
            ahead = np.array([np.cos(heading[k]), np.sin(heading[k])])
            wanted = pace[k] * max(0.0, float(np.cos(off))) ** 2 * min(1.0, float(np.hypot(*way)) / 0.4)
            tight = not _is_free(plan, free, xy[k])  # who starts close to a thing may leave it
            if _blocked(xy[k], ahead, others) or not (tight or _is_free(plan, free, xy[k] + 0.1 * ahead)):
                wanted, speed[k] = 0.0, min(speed[k], 0.3)
                if rng.uniform() < 0.05:
                    goals[k] = _goal(rng, plan, free, xy[k], others)
            speed[k] += float(
                np.clip(wanted - speed[k], -3.0 * SPEED_UP_M_S2 / RATE_HZ, SPEED_UP_M_S2 / RATE_HZ)
            )
            here = xy[k] + ahead * speed[k] / RATE_HZ
            if (tight or _is_free(plan, free, here)) and not _blocked(xy[k], ahead, others):
                xy[k] = here
            else:
                speed[k] = 0.0
            paths[k].xy[step], paths[k].heading_rad[step], paths[k].speed[step] = xy[k], heading[k], speed[k]
    return paths


def _roomy(plan: FloorPlan) -> Mask:
    """Cells with 30 cm around them that no thing takes; people give way to each other."""
    reach = round(0.3 / CELL_M)
    walled = np.pad(plan.taken, 1, constant_values=True)
    return np.asarray(~ndimage.binary_dilation(walled, iterations=reach)[1:-1, 1:-1])


def _is_free(plan: FloorPlan, free: Mask, *points: F64) -> bool:
    cells = plan.cells(np.reshape(points, (-1, 2)))
    return len(cells) == len(points) and bool(free[cells[:, 0], cells[:, 1]].all())


def _goal(rng: Rng, plan: FloorPlan, free: Mask, start: F64, others: F64) -> F64:
    """A free place that can be reached straight, past the ``others``; the start itself if there is none."""
    cells = np.argwhere(free)
    best = start
    for _ in range(25 if len(cells) else 0):
        goal = plan.middle(cells[int(rng.integers(len(cells)))])
        line = start + np.linspace(0.0, 1.0, 40)[:, None] * (goal - start)
        line = line[np.hypot(*(line - start).T) > 0.3]
        apart = np.linalg.norm(line[:, None] - others, axis=2) > PERSONAL_M
        farther = np.hypot(*(goal - start)) > np.hypot(*(best - start))
        if farther and apart.all() and _is_free(plan, free, *line):
            best = goal
            if np.hypot(*(best - start)) > 1.5:
                break
    return best


def _blocked(xy: F64, ahead: F64, others: F64) -> bool:
    way = others - xy
    distance = np.hypot(way[:, 0], way[:, 1])
    toward = way @ ahead
    return bool(
        ((distance < PERSONAL_M) & (toward > 0.2 * distance)).any()
        | ((distance < 0.5) & (toward > 0.0)).any()
    )


def walking(rng: Rng, people: People, base: Pose, path: Stroll) -> list[Moment]:
    """The moments of somebody who walks along a path and stands, in pose ``base``, where it pauses."""
    phase = float(rng.uniform(0.0, 2.0 * np.pi)) + 2.0 * np.pi * np.cumsum(path.speed) / RATE_HZ / STRIDE_M
    effort = np.clip(ndimage.gaussian_filter1d(path.speed, 4.0) / 0.7, 0.0, 1.0)
    poses = [
        between(base, people.walking_pose(float(p)), float(e)) for p, e in zip(phase, effort, strict=True)
    ]
    poses = [
        replace(p, posture="walking" if e > 0.3 else "standing") for p, e in zip(poses, effort, strict=True)
    ]
    return [
        Moment(pose, (float(x), float(y)), float(heading))
        for pose, (x, y), heading in zip(looking(rng, poses), path.xy, path.heading_rad, strict=True)
    ]


def staying(rng: Rng, moment: Moment, steps: int) -> list[Moment]:
    """The moments of somebody who stays and looks around."""
    return [replace(moment, pose=pose) for pose in looking(rng, [moment.pose] * steps)]


def turning(moment: Moment, steps: int, rad_per_s: float) -> list[Moment]:
    """The moments of somebody who turns on the spot."""
    turn = rad_per_s / RATE_HZ
    return [replace(moment, heading_rad=moment.heading_rad + turn * step) for step in range(steps)]


def rising(rng: Rng, sitting: Moment, standing: Pose, steps: int) -> list[Moment]:
    """The moments of somebody who sits, stands up in front of the seat, and sits down again."""
    up, down = 0.3 * steps + rng.uniform(-0.1, 0.1) * steps, 0.75 * steps
    ramp = RATE_HZ * 1.6
    time = np.arange(steps)
    share = np.clip((time - up) / ramp, 0.0, 1.0) * np.clip(1.0 - (time - down) / ramp, 0.0, 1.0)
    share = share * share * (3.0 - 2.0 * share)
    poses = looking(rng, [between(sitting.pose, standing, float(s)) for s in share])
    seat, front = np.array(sitting.xy), np.array(_in_front(sitting))
    return [
        replace(sitting, pose=pose, xy=tuple((seat + s * (front - seat)).tolist()))
        for pose, s in zip(poses, share, strict=True)
    ]


def _can_rise(plan: FloorPlan, sitting: Moment) -> bool:
    ahead = np.array([np.cos(sitting.heading_rad), np.sin(sitting.heading_rad)])
    knees = np.array(sitting.xy) + np.linspace(0.45, 0.6, 4)[:, None] * ahead
    return _is_free(plan, ~plan.taken, *knees)


def _in_front(sitting: Moment) -> tuple[float, float]:
    """Where somebody who sits will stand."""
    ahead = 0.32 * np.array([np.cos(sitting.heading_rad), np.sin(sitting.heading_rad)])
    return float(sitting.xy[0] + ahead[0]), float(sitting.xy[1] + ahead[1])


def live(
    rng: Rng, people: People, plan: FloorPlan, posed: Sequence[Moment], acts: Sequence[str], steps: int
) -> list[list[Moment]]:
    """Bring placed people to life. ``acts`` says who does what: "walk", "turn", "rise" or "stay".

    Walkers keep to the free floor of ``plan`` and out of each other's way; "rise" is for people who sit, and
    who stay when something stands in front of them.
    """
    acts = [
        "stay" if act == "rise" and not _can_rise(plan, moment) else act
        for act, moment in zip(acts, posed, strict=True)
    ]
    walkers = [k for k, act in enumerate(acts) if act == "walk"]
    place = np.array([moment.xy for moment in posed]).reshape(-1, 2)
    heading = np.array([moment.heading_rad for moment in posed])
    risen = [_in_front(moment) for moment, act in zip(posed, acts, strict=True) if act == "rise"]
    bystanders = np.concatenate([np.delete(place, walkers, axis=0), np.array(risen).reshape(-1, 2)])
    # They are on their way when the scene begins.
    paths = [
        Stroll(path.xy[WARM_UP:], path.heading_rad[WARM_UP:], path.speed[WARM_UP:])
        for path in stroll(rng, plan, place[walkers], heading[walkers], bystanders, steps + WARM_UP)
    ]
    lives = []
    for k, (moment, act) in enumerate(zip(posed, acts, strict=True)):
        if act == "walk":
            lives.append(walking(rng, people, people.sample_pose(rng, "standing"), paths[walkers.index(k)]))
        elif act == "rise":
            lives.append(rising(rng, moment, people.sample_pose(rng, "standing"), steps))
        elif act == "turn":
            lives.append(turning(moment, steps, float(rng.choice([-1.0, 1.0]) * rng.uniform(0.2, 0.8))))
        elif act == "stay":
            lives.append(staying(rng, moment, steps))
        else:
            raise HeadvoxError(f"Expected an act walk, turn, rise or stay, got {act!r}.", "Name one of them.")
    return lives


def sample_act(rng: Rng, posture: str) -> str:
    """What somebody who was placed in a posture may do next."""
    if posture == "walking":
        return "walk"
    if posture == "sitting" and rng.uniform() < 0.4:
        return "rise"
    if posture == "standing" and rng.uniform() < 0.3:
        return "turn"
    return "stay"
