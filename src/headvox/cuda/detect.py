"""A detector's frames on the GPU: what is asked of the device, and heads of what it found."""

from __future__ import annotations

from collections.abc import Sequence

from headvox.assemble import as_heads, with_poses
from headvox.check import check_frame, nothing_in_range
from headvox.config import DetectorConfig
from headvox.cuda.device import Device
from headvox.cuda.readings import Asked, Found
from headvox.data import Expected, Frame, Heads
from headvox.keep import asks_cameras, least_before, least_score, slack_of
from headvox.lattice import Lattice
from headvox.machine.clock import Clock
from headvox.machine.threads import Threads
from headvox.masks.compile import CompiledCascade
from headvox.organise import Organiser
from headvox.placing import Placing
from headvox.relief import look_again
from headvox.suppress import AROUND, MOST_PEAKS
from headvox.verify import verify

DEVICE_STAGES = ("device", "host")
"""On a GPU all is one stage, from the upload to the download; what is left to the host is to make heads of it."""


class OnDevice:
    """What a detector does with frames on a GPU, by one cascade."""

    def __init__(
        self, config: DetectorConfig, cascade: CompiledCascade, organiser: Organiser, threads: Threads
    ) -> None:
        self.config, self.cascade = config, cascade
        self.candidates = 0
        """How many voxels of the last frame passed the gate."""
        self.device: Device | None = None
        """What searches, once there was a frame."""
        self._sees = cascade.source.sees  # asks every tree: not for every frame
        self._organiser, self._threads, self._placing = organiser, threads, Placing(config)

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
        organised = [self._organiser.organised(frame, slot) for slot, frame in enumerate(frames)]
        asked = [self._asked(frame, one) for frame, one in zip(organised, expected, strict=True)]
        found = self._device_for(asked[0].lattice).search(asked, self._placing.rays)
        clock.done("device")
        heads = [self._heads(*each) for each in zip(frames, asked, found, strict=True)]
        clock.done("host")
        return heads

    def _asked(self, frame: Frame, expected: Expected | None) -> Asked:
        """Return what the device is to do with ``frame``."""
        sees = asks_cameras(frame, self._sees)
        least = least_score(self.config, self.cascade.source, blind=self._sees and not sees)
        hopeful = least_before(least, self.cascade.relief, sees)
        lattice = self._placing.lattice(frame, self.cascade)
        return Asked(frame, lattice, sees, hopeful, slack_of(self.config, expected), expected)

    def _device_for(self, lattice: Lattice) -> Device:
        if self.device is None or self.device.shape != lattice.shape:
            around = AROUND[self.cascade.gate.spacing]
            self.device = Device(self.cascade, lattice.shape, around, MOST_PEAKS, self.config.refine)
        return self.device

    def _heads(self, frame: Frame, asked: Asked, found: Found) -> Heads:
        """Return the heads of a ``frame`` in which this was found."""
        self.candidates = found.candidates
        if not found.occupied:
            raise nothing_in_range(frame, asked.lattice.region)
        votes = self.cascade.votes
        yaws = None if votes is None else votes.yaws_rad[found.yaws]
        centres, radii, scores, poses = found.centres, found.radii, found.scores, found.poses
        least, relief, rule = asked.least, self.cascade.relief, self.cascade.source.verification
        common = (asked.slack, asked.expected, asked.lattice.voxel_m)
        if relief is not None and asked.sees:
            least += relief.most
            images = asked.frame.depths
            kept, scores = look_again(centres, radii, scores, images, relief, least, *common, self._threads)
            centres, radii, yaws = centres[kept], radii[kept], None if yaws is None else yaws[kept]
            poses = None if poses is None else poses.of(kept, centres)
        heads = as_heads(centres, radii, scores, least, yaws)
        if poses is None:
            return heads
        if rule is not None:
            heads, poses = verify(heads, poses, rule, least, *common)
        return with_poses(heads, poses)
