"""A detector's frames on the GPU: what is asked of the device, and heads of what it found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from headvox.align import Scratch
from headvox.assemble import MOST_POSES, heads_at, with_poses
from headvox.check import check_frame, nothing_in_range, origins_of
from headvox.clock import Clock
from headvox.compile_masks import CompiledCascade
from headvox.config import DetectorConfig
from headvox.cuda.device import Device
from headvox.cuda.readings import Asked, Found
from headvox.data import F64, Expected, Frame, Heads
from headvox.keep import asks_cameras, keep, least_score, slack_of
from headvox.placing import Placing
from headvox.pose import fit_poses
from headvox.refine import MOST_PARTS, cells_about, fit_spheres
from headvox.suppress import AROUND, MOST_PEAKS
from headvox.threads import Threads
from headvox.voxelize import Lattice

I64 = npt.NDArray[np.int64]

DEVICE_STAGES = ("search", "refine")
"""All before the refinement is one stage, and includes the copies there and back."""


class OnDevice:
    """What a detector does with frames on a GPU, by one cascade."""

    def __init__(self, config: DetectorConfig, cascade: CompiledCascade, threads: Threads) -> None:
        self.config, self.cascade = config, cascade
        self.candidates = 0
        """How many voxels of the last frame passed the gate."""
        self.device: Device | None = None
        """What searches, once there was a frame."""
        self._sees = cascade.source.sees  # asks every tree: not for every frame
        self._threads, self._placing = threads, Placing(config)
        self._points = np.empty((MOST_PARTS, 3))
        self._scratch = [Scratch.new() for _ in range(threads.count if config.refine == "pose" else 0)]

    def detect(
        self, frames: Sequence[Frame], expected: Sequence[Expected | None], stage_ms: dict[str, float]
    ) -> list[Heads]:
        """Return the heads in each of up to ``BATCH`` frames, and note to ``stage_ms`` what it took.

        Raises:
            HeadvoxError: as :meth:`headvox.pipeline.Detector.detect_frame`; of several frames, the first.
            DeviceLost: the GPU failed.
        """
        for frame in frames:
            check_frame(frame)
        clock = Clock(stage_ms)
        asked = [self._asked(frame, one) for frame, one in zip(frames, expected, strict=True)]
        found = self._device_for(asked[0].lattice).search(asked, self._placing.rays)
        clock.done("search")
        heads = [self._refine(*each) for each in zip(asked, found, expected, strict=True)]
        clock.done("refine")
        return heads

    def _asked(self, frame: Frame, expected: Expected | None) -> Asked:
        """Return what the device is to do with ``frame``."""
        least = self._least_score(frame) - slack_of(self.config, expected)
        return Asked(
            frame, self._placing.lattice(frame, self.cascade), asks_cameras(frame, self._sees), least
        )

    def _least_score(self, frame: Frame) -> int:
        blind = self._sees and not asks_cameras(frame, self._sees)
        return least_score(self.config, self.cascade.source, blind)

    def _device_for(self, lattice: Lattice) -> Device:
        if self.device is None or self.device.shape != lattice.shape:
            around = AROUND[self.cascade.gate.spacing]
            self.device = Device(
                self.cascade, lattice.shape, around, MOST_PEAKS, cells_about(lattice.voxel_m)
            )
        return self.device

    def _refine(self, asked: Asked, found: Found, expected: Expected | None) -> Heads:
        """Return the heads of a frame that the device searched: from here on it is as on the CPU."""
        self.candidates = found.candidates
        if not found.occupied:
            raise nothing_in_range(asked.frame, asked.lattice.region)
        frame, lattice, least = asked.frame, asked.lattice, self._least_score(asked.frame)
        centres = lattice.centres(found.cells)
        slack = slack_of(self.config, expected)
        kept = keep(centres, found.scores, least, slack, expected, lattice.voxel_m)
        if not kept.any():
            return Heads()
        spheres = None if self.config.refine == "none" else self._fit_spheres(found, np.flatnonzero(kept))
        votes = self.cascade.votes
        yaws = None if votes is None else votes.yaws_rad[found.yaws[kept]]
        haired = len(origins_of(frame)) > 0
        heads = heads_at(centres[kept], found.scores[kept], least, spheres, haired, yaws)
        if self.config.refine != "pose":
            return heads
        return with_poses(
            heads, fit_poses(frame, heads.centres[:MOST_POSES], self._scratch, self._threads, expected)
        )

    def _fit_spheres(self, found: Found, peaks: I64) -> F64:
        """Return the spheres (N, 6) that fit the cells about these ``peaks``, numbers of what was found."""
        counting, subdivision = self.cascade.source.counting, self.cascade.source.subdivision
        spheres = np.empty((len(peaks), 6))
        middle = np.full((1, 3), found.patches.shape[1] // 2, np.int32)
        for sphere, patch in zip(spheres, found.patches[found.patch_of[peaks]], strict=True):
            fit_spheres(
                patch, middle, self.cascade.voxel_m, subdivision, counting, self._points, sphere[None]
            )
        return spheres
