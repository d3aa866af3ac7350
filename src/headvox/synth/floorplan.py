"""What blocks the way of people: a plan of small cells."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from headvox.data import F64
from headvox.synth.furniture import Item

CELL_M = 0.05


class FloorPlan:
    """Which 5 cm cells of a room's floor are ``taken`` by things, and which by ``people``, who may walk away.

    Points outside the room count as taken.
    """

    def __init__(self, x_m: float, y_m: float) -> None:
        """A room of ``x_m`` by ``y_m`` metres around the origin, empty."""
        self.origin = np.array([-x_m / 2.0, -y_m / 2.0])
        self.taken: npt.NDArray[np.bool_] = np.zeros((int(x_m / CELL_M), int(y_m / CELL_M)), np.bool_)
        self.people = self.taken.copy()

    def cells(self, xy: F64) -> npt.NDArray[np.int64]:
        """The cells (K, 2) under those of the points (N, 2) that are inside the room."""
        cells = np.floor((xy - self.origin) / CELL_M).astype(np.int64)
        return np.asarray(cells[((cells >= 0) & (cells < self.taken.shape)).all(axis=1)])

    def conflict(self, xy: F64) -> float:
        """Share (0..1) of the points (N, 2) that are over taken cells or outside."""
        i, j = self.cells(xy).T
        free = ~(self.taken[i, j] | self.people[i, j])
        return 1.0 - float(free.sum()) / max(len(xy), 1)

    def take(self, xy: F64, by_person: bool = False) -> None:
        """Mark the cells under the points (N, 2)."""
        i, j = self.cells(xy).T
        (self.people if by_person else self.taken)[i, j] = True

    def middle(self, cells: npt.NDArray[np.int64]) -> F64:
        """Floor points (N, 2) in the middle of cells (N, 2)."""
        return np.asarray(self.origin + (cells + 0.5) * CELL_M)

    def copy(self) -> FloorPlan:
        """A plan of its own."""
        other = FloorPlan(1.0, 1.0)
        other.origin, other.taken, other.people = self.origin.copy(), self.taken.copy(), self.people.copy()
        return other


def rectangle(low: F64, high: F64) -> F64:
    """Points (N, 2) that fill a rectangle closely enough for the floor plan."""
    x = np.linspace(low[0], high[0], int((high[0] - low[0]) / CELL_M * 1.5) + 2)
    y = np.linspace(low[1], high[1], int((high[1] - low[1]) / CELL_M * 1.5) + 2)
    return np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)


def footprint(thing: Item, x: float, y: float, yaw_rad: float) -> F64:
    """Floor points (N, 2) under the item's own rectangle once it is placed."""
    points = rectangle(thing.vertices[:, :2].min(axis=0), thing.vertices[:, :2].max(axis=0))
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.asarray(points @ np.array([[c, s], [-s, c]]) + np.array([x, y]))
