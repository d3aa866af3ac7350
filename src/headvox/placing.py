"""Where a frame is searched: the lattice about its sensors, and the rays of its cameras there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from headvox.check import origins_of
from headvox.config import DetectorConfig
from headvox.data import F32, Cloud, DepthImage, Frame, Intrinsics
from headvox.fuse import Region
from headvox.masks.compile import CompiledCascade
from headvox.visibility import camera_table
from headvox.voxelize import Lattice, Rays, part_transform


class View(NamedTuple):
    """A depth camera in a lattice: its pixels there, and the cells in its image."""

    rays: Rays
    table: F32
    """see :func:`headvox.visibility.camera_table`"""


class Placing:
    """Lattices, views and transforms, made anew only when a sensor moved."""

    def __init__(self, config: DetectorConfig) -> None:
        self.config = config
        self._lattice: Lattice | None = None
        self._views: dict[str, tuple[Intrinsics, bytes, Lattice, View]] = {}
        self._transforms: dict[str, tuple[bytes | None, Lattice, F32]] = {}

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

    def view(self, image: DepthImage, lattice: Lattice) -> View:
        """Return where the camera of ``image`` sees the cells of ``lattice``."""
        lens, place = image.intrinsics, image.T_world_camera.tobytes()
        known = self._views.get(image.name)
        if known is None or known[:2] != (lens, place) or known[2] is not lattice:
            view = View(Rays.of(image, lattice), camera_table(image, lattice))
            known = self._views[image.name] = (lens, place, lattice, view)
        return known[3]

    def transform(self, cloud: Cloud, lattice: Lattice) -> F32:
        """Return (4, 4) from the frame of ``cloud`` to parts of ``lattice``."""
        T = cloud.T_world_sensor
        place = None if T is None else np.asarray(T, dtype=np.float64).tobytes()
        known = self._transforms.get(cloud.name)
        if known is None or known[0] != place or known[1] is not lattice:
            known = self._transforms[cloud.name] = (place, lattice, part_transform(cloud, lattice))
        return known[2]

    def rays(self, image: DepthImage, lattice: Lattice) -> Rays:
        """Return the rays of the pixels of ``image`` in ``lattice``."""
        return self.view(image, lattice).rays
