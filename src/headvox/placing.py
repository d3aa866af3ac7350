"""Where a frame is searched: the lattice about its sensors, and the rays of its cameras there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from headvox.check import origins_of
from headvox.config import DetectorConfig
from headvox.data import F32, F64, Cloud, DepthImage, Frame, Intrinsics
from headvox.fuse import Region
from headvox.lattice import Lattice
from headvox.masks.compile import CompiledCascade
from headvox.visibility import camera_table
from headvox.voxelize import Rays, part_transform

AHEAD_M, AHEAD_SHARE = 2.0, 0.4
"""How far before a sensor heads are plainly expected, metres; in a small region, as a share of its radius."""


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
        region = self.region(frame)
        if self._lattice is None or self._lattice.region != region:
            self._lattice = Lattice.over(region, cascade.voxel_m, cascade.source.subdivision)
        return self._lattice

    def region(self, frame: Frame) -> Region:
        """Return where ``frame`` is searched."""
        config, centre = self.config, self.config.centre
        if centre is None:
            origins = origins_of(frame)
            x, y, z = origins.mean(axis=0).tolist() if len(origins) else (0.0, 0.0, 0.0)
            centre = (x, y, z)
        return Region(centre, config.max_range_m, config.min_height_m, config.max_height_m)

    def unsearched(self, frame: Frame) -> str | None:
        """Return a line about the first sensor before which nobody looks; None if all is well, or the centre is set."""
        if self.config.centre is not None:
            return None
        region = self.region(frame)
        ahead = min(AHEAD_M, AHEAD_SHARE * region.radius_m)
        for image in frame.depths:
            away = image.T_world_camera[:3, 3] - region.centre
            if _length(away + ahead * image.T_world_camera[:3, 2]) > region.radius_m:
                return _unsearched(image.name, _length(away), f"{ahead:g} m ahead of it", region)
        for cloud in frame.clouds:
            if cloud.T_world_sensor is None:
                continue
            far = _length(cloud.T_world_sensor[:3, 3] - region.centre)  # where it looks is not known
            if far + ahead > region.radius_m:
                return _unsearched(cloud.name, far, f"{ahead:g} m behind it, as seen from there", region)
        return None

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


def _length(offset: F64) -> float:
    return float(np.sqrt((offset**2).sum()))


def _unsearched(name: str, far_m: float, where: str, region: Region) -> str:
    return (
        f"{name} stands {far_m:.1f} m from the mean of the sensors, and no head is sought farther than "
        f"{region.radius_m:g} m from that: not even {where}; set centre or max_range_m (--centre, --max-range)"
    )
