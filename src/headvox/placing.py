"""Where a frame is searched: the lattice about its sensors, and the rays of its cameras there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from headvox.check import origins_of
from headvox.compile_masks import CompiledCascade
from headvox.config import DetectorConfig
from headvox.data import DepthImage, Frame
from headvox.fuse import Region
from headvox.voxelize import Lattice, Rays


class Placing:
    """Lattices and rays, made anew only when a sensor moved."""

    def __init__(self, config: DetectorConfig) -> None:
        self.config = config
        self._lattice: Lattice | None = None
        self._rays: dict[str, tuple[DepthImage, Lattice, Rays]] = {}

    def lattice(self, frame: Frame, cascade: CompiledCascade) -> Lattice:
        """Return the lattice that ``cascade`` searches ``frame`` in; the same object while its region is the same.

        Raises:
            HeadvoxError: more voxels than a grid can number.
        """
        region = self._region(frame)
        if self._lattice is None or self._lattice.region != region:
            self._lattice = Lattice.over(region, cascade.voxel_m, cascade.source.subdivision)
        return self._lattice

    def _region(self, frame: Frame) -> Region:
        config, centre = self.config, self.config.centre
        if centre is None:
            origins = origins_of(frame)
            x, y, z = origins.mean(axis=0).tolist() if len(origins) else (0.0, 0.0, 0.0)
            centre = (x, y, z)
        return Region(centre, config.max_range_m, config.min_height_m, config.max_height_m)

    def rays(self, image: DepthImage, lattice: Lattice) -> Rays:
        """Return the rays of the pixels of ``image`` in ``lattice``."""
        known = self._rays.get(image.name)
        if known is not None:
            same, placed, rays = known
            if (
                placed is lattice
                and same.intrinsics == image.intrinsics
                and np.array_equal(same.T_world_camera, image.T_world_camera)
            ):
                return rays
        rays = Rays.of(image, lattice)
        self._rays[image.name] = (replace(image, T_world_camera=image.T_world_camera.copy()), lattice, rays)
        return rays
