"""What a cascade may ask: groups of boxes about a candidate, and the values of their statistics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.data import I16, I32
from headvox.integral import Integral, sum_about
from headvox.machine.kernels import kernel
from headvox.masks.cascade import CHANNELS, STATISTICS, Box, Group, ring, statistics
from headvox.masks.compile import voxel_box

VOXEL_M, SUBDIVISION = 0.05, 2


def cube(edge: float) -> tuple[float, float, float]:
    """Return the size of a cube."""
    return (edge, edge, edge)


def slab(width: float, height: float, thick: float, weight: int = 1) -> Box:
    """Return a square plate about the vertical axis."""
    return Box((0.0, 0.0, height), (width, width, thick), weight)


GATE_GROUPS = (
    Group("crown", (slab(0.25, 0.05, 0.10),)),
    Group("beside", (slab(0.45, 0.05, 0.10), slab(0.25, 0.05, 0.10, -2))),
    Group("cap", (slab(0.35, 0.15, 0.10), slab(0.35, 0.05, 0.10, -1))),
    Group("top", (slab(0.15, 0.25, 0.10),)),
    Group("above", (slab(0.25, 0.30, 0.25),)),
    Group("brow", (slab(0.25, 0.15, 0.10), slab(0.15, 0.15, 0.10, -2))),
    Group("middle", (slab(0.15, 0.05, 0.10),)),
    Group("shell", (slab(0.25, 0.0, 0.25),)),
    Group("below", (slab(0.35, -0.05, 0.10),)),
)
"""What the gate asks; :mod:`headvox.evolve.gates` finds the limits."""


def _name(kind: str, size_m: float, height: float) -> str:
    return f"{kind}{round(size_m * 100)}_{round(height * 100):+d}"


def _rings(
    kind: str, radius: float, edge: float, heights: Sequence[float], channel: str = "occupied"
) -> list[Group]:
    return [Group(_name(kind, radius, h), ring(radius, float(h), cube(edge)), channel) for h in heights]


def _heights(low: float, high: float, step: float) -> list[float]:
    return [round(float(h), 2) for h in np.arange(low, high + 0.01, step)]


def _face(axis: int, sign: int, out: float, thick: float) -> Box:
    centre, size = [0.0, 0.0, 0.0], [2 * out - thick] * 3
    centre[axis], size[axis] = sign * out, thick
    return Box((centre[0], centre[1], centre[2]), (size[0], size[1], size[2]))


def occupied_groups() -> list[Group]:
    """Return boxes on the axis, rings about it, and shells of boxes about the candidate."""
    groups = []
    for radius, edge, heights in (
        (0.10, 0.10, _heights(-0.20, 0.20, 0.05)),
        (0.15, 0.10, _heights(-0.30, 0.20, 0.10)),
        (0.20, 0.15, _heights(-0.45, 0.25, 0.10)),
        (0.30, 0.15, _heights(-0.45, 0.15, 0.15)),
        (0.40, 0.20, _heights(-0.40, 0.20, 0.20)),
    ):
        groups += _rings("ring", radius, edge, heights)
    for radius in (0.05, 0.10, 0.15):
        groups += _rings("fine", radius, 0.05, _heights(-0.10, 0.15, 0.05))
    for edge, step in ((0.10, 0.05), (0.25, 0.15)):
        heights = _heights(-0.45, 0.30, step)
        groups += [Group(_name("axis", edge, h), (Box((0, 0, h), cube(edge)),)) for h in heights]
    for width in (0.15, 0.25, 0.35, 0.45, 0.65):
        groups += [
            Group(_name("slab", width, h), (slab(width, h, 0.10),)) for h in _heights(-0.45, 0.35, 0.10)
        ]
    groups += [Group(f"cube{round(e * 100)}", (Box((0, 0, 0), cube(e)),)) for e in (0.05, 0.15, 0.35, 0.45)]
    for out, thick in ((0.10, 0.05), (0.15, 0.05), (0.20, 0.10), (0.30, 0.10)):
        faces = tuple(_face(axis, sign, out, thick) for axis in range(3) for sign in (-1, 1))
        groups.append(Group(f"six{round(out * 100)}", faces))
    for out, edge in ((0.075, 0.15), (0.125, 0.15), (0.20, 0.20)):
        corners = [(out * a, out * b, out * c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]
        groups.append(
            Group(f"eight{round(out * 1000)}", tuple(Box(corner, cube(edge)) for corner in corners))
        )
    return groups


def seen_groups() -> list[Group]:
    """Return boxes on the axis and rings of small boxes, in the channels "empty" and "hidden"."""
    groups = []
    for channel in CHANNELS[1:]:
        heights = (-0.30, -0.15, 0.0, 0.15, 0.25, 0.40)
        groups += [
            Group(_name(f"{channel}_axis", 0.15, h), (Box((0, 0, h), cube(0.15)),), channel) for h in heights
        ]
        for radius, levels in (
            (0.10, (-0.10, 0.0, 0.10)),
            (0.15, (-0.20, -0.10, 0.05, 0.20)),
            (0.25, (-0.40, -0.20, 0.0, 0.10, 0.25)),
            (0.40, (-0.30, 0.0, 0.15)),
        ):
            groups += _rings(channel, radius, 0.10, levels, channel)
    return groups


@dataclass(frozen=True)
class Bank:
    """Groups of boxes in voxels of :data:`VOXEL_M`, and their statistics as columns of features."""

    groups: tuple[Group, ...]
    names: tuple[str, ...]
    """Of the features: group.statistic."""
    group_of: npt.NDArray[np.str_]
    """(F,) the group of each feature."""
    volumes: dict[str, float]
    """What a share of 1 of each feature is: in parts, or in cells of the channels that were seen."""
    boxes: I32
    start: I32
    """Group g has ``boxes[start[g]:start[g + 1]]``."""

    @classmethod
    def of(cls, groups: Sequence[Group]) -> Bank:
        """Return the bank of some groups."""
        names, volumes, boxes, start = [], {}, [], [0]
        for group in groups:
            mine = [voxel_box(box, VOXEL_M) for box in group.boxes]
            boxes += mine
            start.append(len(boxes))
            table = np.array(mine)
            cells = int(np.prod(table[:, 1::2] - table[:, 0::2], axis=1).sum())
            cells *= SUBDIVISION**3 if group.channel == "occupied" else 1
            for statistic in statistics(group):
                names.append(f"{group.name}.{statistic}")
                volumes[names[-1]] = cells if statistic == "sum" else cells / len(mine)
        return cls(
            tuple(groups), tuple(names), np.array([name.rpartition(".")[0] for name in names]), volumes,
            np.array(boxes, np.int32), np.array(start, np.int32),
        )  # fmt: skip

    def features(self, sums: npt.NDArray[Any]) -> I16:
        """Return the statistics (N, F) of the boxes' ``sums`` (N, B)."""
        columns = []
        for group, a, b in zip(self.groups, self.start[:-1], self.start[1:], strict=True):
            part = sums[:, a:b]
            if len(statistics(group)) > 1:
                part = np.sort(part, axis=1)
                columns += [part[:, 0], part[:, 2], part[:, -3], part[:, -1]]
            columns.append(part.sum(axis=1))
        return np.stack(columns, axis=1).astype(np.int16)


assert STATISTICS[-1] == "sum"
OCCUPIED, SEEN = Bank.of(occupied_groups()), Bank.of(seen_groups())
GATE = Bank.of([replace(group, name=group.name) for group in GATE_GROUPS])


@kernel
def _box_sums(S, cells, boxes, out):
    for i in range(cells.shape[0]):
        for b in range(boxes.shape[0]):
            out[i, b] = sum_about(S, cells[i, 0], cells[i, 1], cells[i, 2], boxes[b])


def sums_about(S: Integral, cells: I32, boxes: I32) -> I32:
    """Return the sums (N, B) over ``boxes`` (B, 6) about ``cells`` (N, 3) of the integral volume ``S``."""
    out = np.empty((len(cells), len(boxes)), np.int32)
    _box_sums(S, cells.astype(np.int32), boxes, out)
    return out
