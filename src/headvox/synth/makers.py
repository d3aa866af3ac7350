"""Who makes the people of a scene."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from headvox.synth import people
from headvox.synth.people import PosedBody
from headvox.synth.poses import Pose

Rng = np.random.Generator


class People(Protocol):
    """What a scene asks of a module that makes people: :mod:`.people`, or the quick :mod:`.mannequin`."""

    def sample_person(self, rng: Rng, child_share: float = ...) -> Any:
        """Draw a person."""
        ...

    def sample_pose(self, rng: Rng, posture: str | None = ...) -> Pose:
        """Draw a pose."""
        ...

    def walking_pose(self, phase_rad: float) -> Pose:
        """Return the pose at a phase of the gait."""
        ...

    def pose_person(
        self, person: Any, pose: Pose, xy: tuple[float, float], heading_rad: float, floor_z: float
    ) -> PosedBody:
        """Return the triangles of a person in a pose."""
        ...


def real_people() -> People:
    """The module that makes the realistic people."""
    return people
