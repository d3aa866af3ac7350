"""The detector: a frame in, heads out. :meth:`Detector._detect` is the whole flow, one line a stage."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.assemble import MOST_POSES, as_heads, best_apart, with_poses
from headvox.check import check_frame, check_kind, knows_an_origin, nothing_in_range
from headvox.config import DetectorConfig, given_or_default
from headvox.cuda.detect import DEVICE_STAGES, OnDevice
from headvox.cuda.device import BATCH, DeviceLost, use_device
from headvox.data import F64, I32, I64, Cloud, DepthImage, Expected, Frame, Heads
from headvox.errors import HeadvoxError
from headvox.frames import as_rigid
from headvox.gate import gate_columns, list_passed, shape_of_passed
from headvox.integral import integrate, set_corners
from headvox.keep import Judged, asks_cameras, keep, least_before, least_score, shift_of_unseen, slack_of
from headvox.machine.clock import Clock
from headvox.machine.kernels import read_only
from headvox.machine.threads import Threads, new_blocks
from headvox.machine.turns import Turns
from headvox.masks.compile import SCORE_UNIT, compile_cascade
from headvox.masks.read import load_cascade
from headvox.memory import Memory, Stages
from headvox.organise import Organiser
from headvox.placing import Placing
from headvox.pose.fit import fit_poses
from headvox.refine import fit_spheres
from headvox.relief import look_again
from headvox.slabs import shares_of
from headvox.suppress import AROUND, MOST_PEAKS, PEAK_REACH, best_of_each, local_maxima
from headvox.verify import verify
from headvox.visibility import count_states, look_about, not_seen
from headvox.vote import DROPPED, vote_masks, vote_stages
from headvox.voxelize import NO_BOX, empty, join_boxes, mark_depth, mark_points

Loop = tuple[Callable[..., None], tuple[Any, ...]]

STAGES = ("voxelize", "integral", "gate", "vote", "suppress", "judge", "refine")
FEW = 128
"""Candidates that are scored before a second thread would have begun, and"""
FEW_PEAKS = 16
"""peaks that are looked at in the images by then."""


class Detector:
    """Finds heads in point clouds and depth images.

    A detector keeps its working memory between frames, so it is not for two threads at once: give each its own. A call
    while another thread's is under way raises HeadvoxError. A copy, or what was pickled, is made anew from ``config``.
    ``stage_ms`` holds what each stage of the last frame took. ``backend`` goes before that of ``config``; ``note`` is
    told what a user should know, by default as a Python warning.

    Raises:
        HeadvoxError: a cascade that is not there or cannot be read, or a back end that this machine has not.

    >>> import numpy as np
    >>> detector = Detector()
    >>> len(detector.detect(np.random.default_rng(0).uniform(-1, 1, (100, 3)).astype(np.float32)))
    0
    """

    def __init__(
        self,
        config: DetectorConfig | None = None,
        *,
        backend: str | None = None,
        note: Callable[[str], None] | None = None,
    ) -> None:
        self._config = given_or_default(config, DetectorConfig)
        if backend is not None:
            self._config = replace(self._config, backend=backend)
        self._note = note or _warn
        self.cascade = compile_cascade(load_cascade(self._config.cascade), self._config.voxel_m)
        self.on_device = use_device(self._config.backend)
        """Whether frames are looked at on a GPU; it ends when the GPU fails."""
        self.device: OnDevice | None = None
        """What looks at them there, once there was a frame."""
        self.stage_ms = dict.fromkeys(DEVICE_STAGES if self.on_device else STAGES, 0.0)
        self.candidates = 0
        """How many voxels of the last frame passed the gate."""
        self._alone = Turns(("This Detector is at work in another thread.", "Give each thread its own."))
        self._threads = Threads(self._config.threads)
        self._organiser = Organiser(self._threads)
        self._placing = Placing(self._config)
        self._most_sensors = 0
        self._memory: Memory | None = None
        if (
            not self.on_device
        ):  # so that the first frame takes no longer than others: all regions have one shape
            self._memory_for(Frame(0))
        self._looked_at: tuple[Memory, I32, I64] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Say how to make another one: working memory and threads are of this one."""
        return partial(type(self), note=self._note), (self._config,)

    # ------------------------------------------------------------------------------------------- the public calls

    @property
    def config(self) -> DetectorConfig:
        """The settings that it was made with: others take another detector."""
        return self._config

    @config.setter
    def config(self, _: object) -> None:
        raise HeadvoxError(
            "The settings of a Detector are fixed when it is made.", "Make a new one: Detector(config)."
        )

    def detect(self, points: npt.NDArray[np.float32], T_world_sensor: npt.ArrayLike | None = None) -> Heads:
        """Return the heads in ``points``, (N, 3) float32 in metres, NaN where invalid.

        The points are in the world frame (z up), or in the frame that ``T_world_sensor`` (4, 4) places there.

        Raises:
            HeadvoxError: wrong shape or dtype, a transform that is not rigid, or no point within range.
        """
        T = None if T_world_sensor is None else as_rigid(T_world_sensor, "T_world_sensor")
        return self.detect_frame(Frame(0, clouds=(Cloud("points", points, T),)))

    def detect_depth(self, images: DepthImage | Sequence[DepthImage]) -> Heads:
        """Return the heads in one depth image, or in those of several cameras at one moment.

        Raises:
            HeadvoxError: an image that does not fit its camera, a transform that is not rigid, or no return in range.
        """
        return self.detect_frame(
            Frame(0, depths=tuple(images) if isinstance(images, Sequence) else (images,))
        )

    def detect_frame(self, frame: Frame, expected: Expected | None = None) -> Heads:
        """Return the heads in everything that the sensors saw at one moment.

        Within the reach of where a head is ``expected``, one that scores a little too low (``score_slack``) is kept
        too, and marked as not sure.

        Raises:
            HeadvoxError: no reading, or one of the wrong shape or dtype, a transform that is not rigid, intrinsics or a
                stamp that are no numbers, something else than Expected, or nothing within range.
        """
        if expected is not None:
            check_kind(expected, Expected, "detect_frame: expected")
        with self._alone:
            if self.on_device:
                heads = self._detect_together([frame], [expected])[0]
            else:
                with self._threads.awake():
                    heads = self._detect(frame, expected)
            self._tell_of_unsearched(frame)
            return heads

    def detect_batch(self, frames: Iterable[Frame]) -> list[Heads]:
        """Return the heads in each of ``frames``, as :meth:`detect_frame` does; on a GPU, several go at once.

        Raises:
            HeadvoxError: as :meth:`detect_frame`; of several, the first, and nothing is returned of the others.
        """
        found, left = [], iter(frames)
        with self._alone:
            while part := list(islice(left, BATCH)):
                found += self._detect_together(part, [None] * len(part))
                for frame in part:
                    self._tell_of_unsearched(frame)
        return found

    def candidates_of_last_frame(self) -> tuple[F64, F64]:
        """Return what passed the gate of the last frame, and what the second stage gave it; for pictures and tuning.

        These are copies, made by this call, which has to come before the next frame; a detector that is not asked does
        nothing for it. A GPU keeps them to itself: there are none.

        Returns:
            The centres of the voxels, (N, 3) metres, world, and their scores (N,), NaN where the second stage dropped
            one. The scores are those by which the peaks are found: what is said of heads comes from a closer look.
        """
        with self._alone:
            if self._looked_at is None:
                return np.empty((0, 3)), np.empty(0)
            memory, survivors, scores = self._looked_at
            centres = memory.centres(survivors)
            return centres, np.where(scores > DROPPED, scores / SCORE_UNIT, np.nan)

    def close(self) -> None:
        """End the detector's threads; what is asked of it later runs in the thread that asks."""
        with self._alone:
            self._threads.close()

    def _tell_of_unsearched(self, frame: Frame) -> None:
        """Tell once of a sensor before which nobody looks. Only a frame of more sensors than any before is asked."""
        sensors = len(frame.depths) + len(frame.clouds)
        if sensors <= self._most_sensors:
            return
        self._most_sensors = sensors
        told = self._placing.unsearched(frame)
        if told is not None:
            self._most_sensors = sys.maxsize
            self._note(told)

    def _detect_together(self, frames: Sequence[Frame], expected: Sequence[Expected | None]) -> list[Heads]:
        """Return the heads in up to :data:`BATCH` frames: at once on a GPU; without, or when it fails, one by one."""
        if self.on_device:
            self.device = self.device or OnDevice(self._config, self.cascade, self._organiser, self._threads)
            try:
                heads = self.device.detect(frames, expected, self.stage_ms)
                self.candidates = self.device.candidates
                return heads
            except DeviceLost as error:
                self._note(
                    f"the GPU failed ({error}): this frame is done again, and all further ones, on the CPU"
                )
                self.on_device, self.device = False, None
                self.stage_ms = dict.fromkeys(STAGES, 0.0)
        return [self.detect_frame(frame, one) for frame, one in zip(frames, expected, strict=True)]

    # -------------------------------------------------------------------------------------------------- the stages

    def _detect(self, frame: Frame, expected: Expected | None) -> Heads:
        """Return the heads in ``frame``, stage by stage, on the CPU."""
        check_frame(frame)
        clock, given = Clock(self.stage_ms), frame
        frame = self._organiser.organised(given)
        memory = self._memory_for(frame)
        occupied = self._voxelize(frame, memory)
        if occupied[3] < 0:
            raise nothing_in_range(given, memory.lattice.region)
        clock.done("voxelize")
        S = memory.volume_about(memory.candidates_about(occupied), self._threads.count)
        survivors = self._gate(S, occupied, memory, clock)
        clock.done("gate")
        scores = self._vote(S, survivors, memory)
        clock.done("vote")
        self._looked_at = (memory, survivors, scores)
        peaks = self._suppress(S, survivors, scores, memory)
        clock.done("suppress")
        judged = self._judge(frame, S, survivors, scores, peaks, memory, expected)
        clock.done("judge")
        heads = self._refine(frame, judged, memory, expected)
        clock.done("refine")
        return heads

    def _voxelize(self, frame: Frame, memory: Memory) -> I64:
        """Enter every reading into the grid; return its lowest and highest occupied cell, below 0 if there is none."""
        lattice, boxes, counting = memory.lattice, memory.boxes, self.cascade.source.counting
        boxes[:] = NO_BOX
        memory.make_room_for_width(max((image.depth.shape[1] for image in frame.depths), default=0))
        common = (memory.limits, memory.bits, lattice.shape, lattice.subdivision - 1, counting)
        clouds = [
            (read_only(cloud.points), self._placing.transform(cloud, lattice)) for cloud in frame.clouds
        ]
        images = [(read_only(image.depth), self._placing.rays(image, lattice)) for image in frame.depths]
        blocks = new_blocks(len(clouds) + len(images))
        dirty, memory.dirty = memory.dirty, None

        # All that the loops need is made before, so that no thread waits for the GIL while another makes it.
        calls = []
        for grid, marking, box in zip(memory.grids, memory.marking, boxes, strict=True):
            loops: list[Loop] = [(empty, (memory.used(grid, dirty),))]
            for (points, T), taken in zip(clouds, blocks, strict=False):
                loops.append((mark_points, (points, taken, T, *common, *marking.for_points(), box, grid)))
            for (depth, rays), taken in zip(images, blocks[len(clouds) :], strict=True):
                pixels = (depth, taken, rays.column, rays.row, rays.t)
                loops.append((mark_depth, (*pixels, *common, *marking.for_depth(depth.shape[1]), box, grid)))
            calls.append((loops,))
        self._threads.run(_run_loops, calls)
        join_boxes(boxes)
        occupied: I64 = boxes[0]
        memory.dirty = (max(int(occupied[0]), 0), int(occupied[3]) + 1)
        if occupied[3] < 0:
            memory.dirty = (0, 0)
        return occupied

    def _gate(self, S: npt.NDArray[Any], occupied: I64, memory: Memory, clock: Clock) -> I32:
        """Fill the integral volume ``S``, and return the voxels of it that pass the gate."""
        region = memory.region
        shape = shape_of_passed(region)
        passed = memory.passed[: math.prod(shape)].reshape(shape)
        set_corners(S, self.cascade.gate.boxes, memory.gate_corners)
        cells = (memory.grids, memory.lattice.shape, occupied)
        counting, odd = self.cascade.source.counting, memory.odd + memory.first
        gate = (*memory.gate, self.cascade.gate.spacing, odd, memory.gate_corners)
        slabs = memory.slabs.each
        sums = [
            (*cells, memory.first + slab.shift, counting, row, S[slab.slices])
            for slab, row in zip(slabs, memory.row, strict=False)
        ]
        gates = [
            (S[slab.slices], region, slab.first, *gate, taken, passed[slab.first : slab.end])
            for slab, taken in zip(slabs, new_blocks(len(slabs)), strict=True)
        ]
        summed = [False] * len(slabs)

        def search(own: int) -> None:
            integrate(*sums[own])
            summed[own] = True
            if own == 0:
                clock.done("integral")
            # First the slab that the thread has added up, which is in its own cache; then what others still have.
            for slab in (*range(own, len(slabs)), *range(own)):
                if summed[slab]:
                    gate_columns(*gates[slab])

        self._threads.run(search, [(own,) for own in range(len(slabs))])
        self.candidates = list_passed(passed, region, memory.survivors)
        if self.candidates > len(memory.survivors):
            memory.survivors = np.empty((2 * self.candidates, 3), np.int32)
            list_passed(passed, region, memory.survivors)
        return memory.survivors[: self.candidates]

    def _vote(self, S: npt.NDArray[Any], survivors: I32, memory: Memory) -> I64:
        memory.make_room(len(survivors))
        scores = memory.scores[: len(survivors)]
        votes = self.cascade.votes
        if memory.search is not None:
            search = memory.search
            set_corners(S, search.compiled.boxes, search.corners)
            self._score(S, survivors, memory.unseen, search, search.occupied, memory, scores)
        elif votes is not None:
            table = (votes.boxes, votes.weights, votes.start, votes.masks, votes.pairs)

            def vote(_: int, low: int, high: int) -> None:
                limits = (votes.asymmetry_cost, votes.min_votes)
                vote_masks(S, *memory.slabs[1:], survivors, low, high, *table, *limits, scores, memory.yaws)

            self._threads.run(vote, shares_of(len(survivors), self._threads.count))
        return scores

    def _score(
        self, S: npt.NDArray[Any], cells: I32, seen: I32, stages: Stages, span: tuple[int, int], memory: Memory,
        scores: I64,
    ) -> None:  # fmt: skip
        """Write the score of each of ``cells`` by some of the ``stages``: from the first to the second of ``span``."""
        common = (*span, *stages.tables, stages.corners, memory.alive)
        calls = [
            (S, *memory.slabs[1:], cells, seen, low, high, *common, *stages.memory[part], scores)
            for part, low, high in shares_of(len(cells), 1 if len(cells) < FEW else self._threads.count)
        ]
        self._threads.run(vote_stages, calls)

    def _suppress(self, S: npt.NDArray[Any], survivors: I32, scores: I64, memory: Memory) -> I64:
        shape = (
            S.shape[0] - len(memory.slabs.seams) * memory.slabs.overlap - 1,
            S.shape[1] - 1,
            S.shape[2] - 1,
        )
        index = memory.index[: math.prod(shape)].reshape(shape)
        reach = PEAK_REACH[self.cascade.gate.spacing]
        peaks = memory.peaks[: local_maxima(survivors, scores, DROPPED + 1, reach, index, memory.peaks)]
        if len(peaks) > MOST_PEAKS:  # a frame of noise: what follows must not take forever
            peaks = np.sort(peaks[np.argsort(-scores[peaks], kind="stable")[:MOST_PEAKS]])
        return peaks

    def _judge(
        self, frame: Frame, S: npt.NDArray[Any], survivors: I32, scores: I64, peaks: I64, memory: Memory,
        expected: Expected | None,
    ) -> Judged:  # fmt: skip
        """Look closer at the peaks, and let those through that reach the cascade's threshold, or still may."""
        cells, scores, judge = survivors[peaks], scores[peaks], memory.judge
        sees = asks_cameras(frame, memory.sees)
        if judge is not None and len(cells):
            cells, scores, found = self._best_about(S, cells, judge, memory)
            peaks = peaks[found]
            if sees and len(cells):
                self._look_about(frame, S, cells, judge, memory, scores)
        least = least_score(self._config, self.cascade.source, blind=memory.sees and not sees)
        centres, slack = memory.centres(cells), slack_of(self._config, expected)
        hopeful = least_before(least, self.cascade.relief, sees)
        kept = np.flatnonzero(keep(centres, scores, hopeful, slack, expected, memory.lattice.voxel_m))
        return Judged(cells[kept], centres[kept], scores[kept], peaks[kept], least)

    def _best_about(
        self, S: npt.NDArray[Any], cells: I32, judge: Stages, memory: Memory
    ) -> tuple[I32, I64, I64]:
        """Move each peak to the best voxel about it; return cells, scores and which of the peaks they were."""
        around = AROUND[self.cascade.gate.spacing]
        about = (cells[:, None] + around).reshape(-1, 3)
        memory.make_room(len(about))
        scores, best = np.empty((2, len(about)), np.int64)
        set_corners(S, judge.compiled.boxes, judge.corners)
        self._score(S, about, memory.unseen, judge, judge.occupied, memory, scores)
        best = best[: best_of_each(about, scores, len(around), DROPPED + 1, best)]
        return about[best], scores[best], best // len(around)

    def _look_about(
        self, frame: Frame, S: npt.NDArray[Any], cells: I32, judge: Stages, memory: Memory, scores: I64
    ) -> None:
        """Go on to score by the stages of the judge that ask what the cameras saw empty and hidden.

        A cloud may have put something where no camera looks: these stages have no say there.
        """
        states = np.zeros((len(cells), judge.offsets.shape[1]), np.uint8)
        in_lattice = cells + memory.first.astype(np.int32)
        seen = np.empty((len(cells), len(judge.offset_start) - 1, 2), np.int32)
        cameras = [
            (read_only(image.depth), self._placing.view(image, memory.lattice).table)
            for image in frame.depths
        ]

        def look(cells: I32, states: npt.NDArray[np.uint8], seen: I32) -> None:
            for depth, table in cameras:
                look_about(depth, table, cells, judge.offsets, states)
            count_states(states, judge.offset_start, seen)

        shares = shares_of(len(cells), 1 if len(cells) < FEW_PEAKS else self._threads.count)
        calls = [(in_lattice[low:high], states[low:high], seen[low:high]) for _, low, high in shares]
        self._threads.run(look, calls)
        by_occupancy = scores + shift_of_unseen(self.cascade.source)
        self._score(S, cells, seen, judge, judge.seeing, memory, scores)
        if frame.clouds:
            unseen = not_seen(states)
            scores[unseen] = by_occupancy[unseen]

    def _refine(self, frame: Frame, judged: Judged, memory: Memory, expected: Expected | None) -> Heads:
        """Fit spheres, take the best of those that overlap, look again pixel by pixel, fit poses, and verify."""
        cells, centres, scores, peaks, least = judged
        if len(cells) == 0:
            return Heads()
        spheres = None if self._config.refine == "none" else self._fit_spheres(cells, memory)
        kept, centres, radii = best_apart(centres, scores, spheres, haired=knows_an_origin(frame))
        scores, relief = scores[kept], self.cascade.relief
        limits = (least, slack_of(self._config, expected), expected, memory.lattice.voxel_m)
        if relief is not None and asks_cameras(frame, memory.sees):
            again, scores = look_again(centres, radii, scores, frame.depths, relief, *limits, self._threads)
            kept, centres, radii = kept[again], centres[again], radii[again]
        votes = self.cascade.votes
        yaws = None if votes is None else votes.yaws_rad[memory.yaws[peaks[kept]]]
        heads = as_heads(centres, radii, scores, least, yaws)
        if self._config.refine != "pose":
            return heads
        poses = fit_poses(frame, heads.centres[:MOST_POSES], memory.fits, self._threads, expected)
        rule = self.cascade.source.verification
        if rule is not None:
            heads, poses = verify(heads, poses, rule, *limits)
        return with_poses(heads, poses)

    def _fit_spheres(self, cells: I32, memory: Memory) -> F64:
        """Return the spheres (N, 6) that fit what lies about ``cells`` (N, 3) of the integral volume."""
        spheres = np.empty((len(cells), 6))
        lattice, counting = memory.lattice, self.cascade.source.counting
        in_lattice = cells + memory.first.astype(np.int32)

        common = (lattice.voxel_m, lattice.subdivision, counting)
        calls = [
            (
                memory.grids,
                lattice.shape,
                in_lattice[low:high],
                *common,
                memory.parts[part],
                spheres[low:high],
            )
            for part, low, high in shares_of(len(cells), self._threads.count)
        ]
        self._threads.run(fit_spheres, calls)
        return spheres

    # -------------------------------------------------------------------------------------------- working memory

    def _memory_for(self, frame: Frame) -> Memory:
        """Return the working memory, made anew only for another cascade or a region of another shape."""
        lattice, memory = self._placing.lattice(frame, self.cascade), self._memory
        if memory is None or memory.cascade is not self.cascade or memory.lattice.shape != lattice.shape:
            poses = self._config.refine == "pose"
            memory = self._memory = Memory(lattice, self.cascade, self._config.threads, poses)
        if memory.lattice is not lattice:
            memory.place(lattice)
        return memory


def _run_loops(loops: Sequence[Loop]) -> None:
    for loop, arguments in loops:
        loop(*arguments)


def _warn(text: str) -> None:
    warnings.warn(f"headvox: {text}", RuntimeWarning, stacklevel=4)
