"""Masks as data: what a cascade file says, in metres.

A *box* has a centre and a size, relative to the candidate. A *group* is one box or a ring of boxes about the vertical
axis; the sums of a ring are sorted, which makes its statistics independent of yaw without any search. All limits and
cuts are *shares*: the sum of the boxes divided by their volume, so a file says the same at every voxel size. On a parts
grid a share of 1 is a box filled with points; on a count grid it is the mean number of points a voxel.

:mod:`headvox.masks.read` reads these from files, :mod:`headvox.masks.compile` makes voxel offsets of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

CHANNELS = ("occupied", "empty", "hidden")
# smallest, 3rd smallest, 3rd largest, largest, all together
STATISTICS = ("min", "low", "high", "max", "sum")
SIDES = ("near", "far")  # of a spot: that where the surface is nearer to the camera, and the other
MEASURES = ("range", "rise", "height", "radius")
"""Of a candidate: how far its camera is (m), how much higher than that it is for each metre of these, how high above
z = 0 (m), and the radius of the sphere that fits it (m)."""


@dataclass(frozen=True, slots=True)
class Box:
    """A box about ``centre`` (m, from the candidate), ``size`` long (m), counted ``weight`` times."""

    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    weight: int = 1


@dataclass(frozen=True, slots=True)
class Group:
    """Boxes that are looked at together, in one channel."""

    name: str
    boxes: tuple[Box, ...]
    channel: str = "occupied"


@dataclass(frozen=True, slots=True)
class Condition:
    """Stage 1: a statistic of a group's sums must lie between two shares.

    ``rank`` 0 is the weighted sum, as a share of the volume of the boxes of positive weight; k is the kth smallest.
    """

    group: Group
    rank: int
    minimum: float
    maximum: float


@dataclass(frozen=True, slots=True)
class Mask:
    """Stage 2 of the paper: the sign of the weighted sum of the boxes is one vote."""

    name: str
    boxes: tuple[Box, ...]


@dataclass(frozen=True, slots=True)
class Votes:
    """Masks that vote at several yaws, and mirrored pairs of boxes whose difference costs ``asymmetry_cost``."""

    masks: tuple[Mask, ...]
    mirrored: tuple[tuple[Box, Box], ...]
    yaws_deg: tuple[float, ...]
    asymmetry_cost: float
    min_votes: int


# a leaf's weight, or (feature, cut, at most the cut, above it)
Tree = float | tuple[str, float, "Tree", "Tree"]


@dataclass(frozen=True, slots=True)
class Stage:
    """A part of a boosted sum of look-ups; a candidate whose sum so far is below ``keep`` is dropped."""

    name: str
    keep: float
    trees: tuple[Tree, ...]


@dataclass(frozen=True, slots=True)
class Spot:
    """A pair of places beside and above the candidate, as its camera sees it: ``side`` m to either side, ``up`` m."""

    name: str
    side: float
    up: float


@dataclass(frozen=True, slots=True)
class Relief:
    """The last look at what may be a head, pixel by pixel: trees change the score, by ``most`` at most.

    A cut is in metres: how much farther than the candidate the surface is at a spot, on its nearer or farther side; or
    it is of one of :data:`MEASURES`. After the ``first`` trees a candidate is given up that lacks more than ``reach``.
    """

    most: float
    spots: tuple[Spot, ...]
    trees: tuple[Tree, ...]
    first: int = 0
    reach: float = math.inf


@dataclass(frozen=True, slots=True)
class Verification:
    """What the pose fit may take from a score: ``misfit`` for each unit of misfit, ``radius`` for each metre off.

    The radius is off as far as it is from ``radius_m``. What these come to beyond ``free`` is lost, ``most`` at most,
    where the fit states the centre to less than ``sure_m`` (m, one standard deviation).
    """

    most: float
    sure_m: float
    free: float
    misfit: float
    radius: float
    radius_m: float


@dataclass(frozen=True, slots=True)
class Cascade:
    """A cascade as its file has it. Exactly one of ``votes`` and ``stages`` is there."""

    name: str
    summary: str
    voxel_m: float
    subdivision: int
    counting: bool
    conditions: tuple[Condition, ...]
    votes: Votes | None
    groups: tuple[Group, ...]
    stages: tuple[Stage, ...]
    min_score: float
    min_score_occupied: float
    tuned_on: tuple[str, ...]
    spacing: int = 1
    """1: every voxel is a candidate; 2: every other, as the black squares of a chess board are; 4: every fourth."""
    judge: tuple[Stage, ...] = ()
    """Stages that score the voxels about the peaks of ``stages`` anew."""
    relief: Relief | None = None
    """The last look, where depth images were seen."""
    verification: Verification | None = None
    """What the pose fit has to say, where poses are fitted."""

    @property
    def every_stage(self) -> tuple[Stage, ...]:
        """All stages, those that search and judge both once."""
        return self.stages + tuple(stage for stage in self.judge if stage not in self.stages)

    @property
    def sees(self) -> bool:
        """Whether some stage asks what the sensors saw to be empty or hidden."""
        used = {
            name.rpartition(".")[0] for stage in self.judge for tree in stage.trees for name, _ in cuts(tree)
        }
        return any(group.channel != "occupied" for group in self.groups if group.name in used)


def cuts(tree: Tree) -> Iterator[tuple[str, float]]:
    """Yield the cuts of a tree as (feature, share)."""
    if isinstance(tree, tuple):
        yield tree[0], tree[1]
        yield from cuts(tree[2])
        yield from cuts(tree[3])


def statistics(group: Group) -> tuple[str, ...]:
    """Return the statistics that a group offers: a single box has only its sum."""
    return STATISTICS if len(group.boxes) > 1 else ("sum",)


def ring(radius: float, height: float, size: tuple[float, float, float], count: int = 8) -> tuple[Box, ...]:
    """Return ``count`` boxes on a horizontal circle, the first in the direction of x."""
    angles = [2.0 * math.pi * k / count for k in range(count)]
    return tuple(Box((radius * math.cos(a), radius * math.sin(a), height), size) for a in angles)


def turned(box: Box, yaw_rad: float) -> Box:
    """Return ``box`` with its centre turned about the vertical axis. Boxes stay aligned with the axes."""
    x, y, z = box.centre
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return Box((c * x - s * y, s * x + c * y, z), box.size, box.weight)
