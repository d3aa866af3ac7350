"""The voxels of a region, and how they and their parts are numbered."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.data import F32, F64, I64
from headvox.errors import HeadvoxError
from headvox.fuse import Region

MOST_CELLS = 1 << 28  # a cell's number and its part fit an int32
MOST_BITS = 32  # and so do a part's x, y and z side by side


@dataclass(frozen=True, slots=True)
class Lattice:
    """The voxels of a region: ``shape`` cells of ``voxel_m``, the corner of cell 0, 0, 0 at ``origin`` (world, m).

    The origin is a whole number of voxels, so that the cells of two overlapping regions coincide.
    """

    origin: tuple[float, float, float]
    voxel_m: float
    shape: tuple[int, int, int]
    subdivision: int
    region: Region

    @classmethod
    def over(cls, region: Region, voxel_m: float, subdivision: int) -> Lattice:
        """Return the lattice that covers ``region``.

        Raises:
            HeadvoxError: more voxels than a grid can number.
        """
        (cx, cy, _), radius = region.centre, region.radius_m
        ox, oy, oz = (
            math.floor(v / voxel_m) * voxel_m for v in (cx - radius, cy - radius, region.min_height_m)
        )
        # The same shape wherever the centre lies, and a spare layer at the upper end: in float32 a point just below a
        # limit may round onto it.
        nx = ny = math.ceil(2 * radius / voxel_m) + 2
        nz = math.ceil((region.max_height_m - region.min_height_m) / voxel_m) + 2
        bits = sum((n * subdivision - 1).bit_length() for n in (nx, ny, nz))
        if nx * ny * nz > MOST_CELLS or bits > MOST_BITS:
            raise HeadvoxError(
                f"The region has {nx} x {ny} x {nz} voxels of {voxel_m:g} m: more than can be numbered.",
                "Set a smaller max_range_m, less height, or larger voxels.",
            )
        return cls((ox, oy, oz), voxel_m, (nx, ny, nz), subdivision, region)

    @property
    def part_m(self) -> float:
        """Edge of the smallest thing the grid can tell apart."""
        return self.voxel_m / self.subdivision

    @property
    def bits(self) -> npt.NDArray[np.int32]:
        """How many bits number the parts along y and along z: (2,). A part is packed as x, y, z into one number."""
        return np.array([(n * self.subdivision - 1).bit_length() for n in self.shape[1:]], np.int32)

    @property
    def odd(self) -> I64:
        """Whether cell 0, 0, 0 is an odd number of voxels from the world's origin, along each axis: (3,), 0 or 1."""
        return np.array([round(v / self.voxel_m) & 1 for v in self.origin])

    def limits(self) -> F32:
        """Return the region's limits in parts from the origin, as the kernels read them."""
        # In float64 up to the last step: a centre in earth coordinates, rounded to float32 first, is off by more
        # than the spare layer, and the kernels would write outside of the grid.
        region, scale = self.region, 1.0 / self.part_m
        return np.array(
            [
                *((region.centre[k] - self.origin[k]) * scale for k in range(3)),
                region.radius_m * region.radius_m * scale * scale,
                (region.min_height_m - self.origin[2]) * scale,
                (region.max_height_m - self.origin[2]) * scale,
            ],
            dtype=np.float32,
        )

    def centres(self, cells: npt.NDArray[Any]) -> F64:
        """Return the world centres (N, 3) of ``cells`` (N, 3)."""
        centres: F64 = (np.asarray(cells, dtype=np.float64) + 0.5) * self.voxel_m + np.array(self.origin)
        return centres
