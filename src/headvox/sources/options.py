"""What a user can tell about a source that the source itself may not: topics, frames, where a sensor stands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from headvox.data import F64
from headvox.errors import HeadvoxError
from headvox.frames import OPTICAL

ASSUMED_HEIGHT_M = 1.2  # a desk, a tripod, a robot's mast
ASSUMED = (
    f"is taken to stand {ASSUMED_HEIGHT_M:g} m above the floor and to look level: "
    "say otherwise with --mount X Y Z ROLL PITCH YAW (metres, degrees; PITCH above 0 looks down)"
)


@dataclass(frozen=True, slots=True)
class SourceOptions:
    """What to read, and where it is."""

    topics: tuple[str, ...] = ()
    """Topics of a bag to read; by default those that sensors plainly are on."""
    frame: str | None = None
    """Frame of a bag's transforms that the heads are to be in; its z points up."""
    T_world_mount: F64 | None = None
    """Where that frame is, or the one sensor (x forward, y left, z up), in the world: see :func:`mount`."""
    extrinsics: str | None = None
    """A file that says where each camera stands, for live cameras: see docs/conventions.md."""
    rate_hz: float | None = None
    """How many clouds of a folder are a second; they have no stamps."""


def check_unused(options: SourceOptions | None, name: str) -> None:
    """Refuse options for a source that takes none.

    Raises:
        HeadvoxError: one of them is set.
    """
    # One by one: a matrix has no truth, so options cannot be compared as a whole.
    if options is not None and (
        options.topics
        or options.frame is not None
        or options.T_world_mount is not None
        or options.extrinsics is not None
        or options.rate_hz is not None
    ):
        raise HeadvoxError(
            f"{name}: --topic and --frame are for bags and live cameras, --mount for these and for files of clouds, "
            "--extrinsics for recordings and live cameras, --rate for folders of clouds only.",
            "Leave them out.",
        )


def check_stamped(options: SourceOptions, name: str) -> None:
    """Refuse a rate for a source that has stamps of its own.

    Raises:
        HeadvoxError: it is set.
    """
    if options.rate_hz is not None:
        raise HeadvoxError(f"{name}: --rate is for folders of clouds, this has stamps.", "Leave it out.")


def mount(x: float, y: float, z: float, roll_deg: float, pitch_deg: float, yaw_deg: float) -> F64:
    """Return T_world_mount (4, 4): turned about the fixed axes x, y, z in this order, as REP 103 has it, then moved."""
    roll, pitch, yaw = (math.radians(angle) for angle in (roll_deg, pitch_deg, yaw_deg))
    T = np.eye(4)
    T[:3, :3] = _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)
    T[:3, 3] = x, y, z
    return T


def assumed_mount() -> F64:
    """Return where a sensor of which nothing is known is taken to stand: :data:`ASSUMED` says it in words."""
    return mount(0.0, 0.0, ASSUMED_HEIGHT_M, 0.0, 0.0, 0.0)


def mounted(T_world_mount: F64, is_optical: bool) -> F64:
    """Return T_world_sensor (4, 4) of a sensor whose body is there; an optical frame is turned in the body."""
    return T_world_mount @ OPTICAL if is_optical else T_world_mount


def _about(axis: int, angle: float) -> F64:
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    R = np.eye(3)
    R[i, i] = R[j, j] = math.cos(angle)
    R[j, i] = math.sin(angle)
    R[i, j] = -math.sin(angle)
    return R


def listed(names: Sequence[str], most: int = 12) -> str:
    """Return names on one line; what is beyond ``most`` is counted."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return (", ".join(names[:most]) or "none") + more
