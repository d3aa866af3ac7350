"""The search of a batch of frames on the device: one upload, the stages one after the other, one download.

Nothing is allocated per frame. All launches and copies are on one stream, and everything about a frame that a kernel
needs is in the row that is uploaded: see :mod:`headvox.cuda.readings`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import cuda

from headvox.assemble import MOST_POSES
from headvox.cuda import compact, gate, integral, judge, suppress, vote, voxelize
from headvox.cuda.fits import Fits
from headvox.cuda.graph import capture
from headvox.cuda.lanes import SIMULATED
from headvox.cuda.readings import OCTET, Asked, Found, pack, words_of
from headvox.data import I32, I64, DepthImage
from headvox.gate import gate_tables
from headvox.keep import shift_of_unseen
from headvox.lattice import Lattice
from headvox.masks.compile import CompiledCascade, CompiledStages
from headvox.suppress import PEAK_REACH
from headvox.visibility import cells_of
from headvox.vote import seen_boxes
from headvox.voxelize import Rays

# The simulator runs every thread in turn: a few of each kind are enough to show what goes wrong between them.
THREADS = 2 if SIMULATED else 128
ONE_BLOCK_THREADS = 3 if SIMULATED else compact.THREADS
MOST_BLOCKS = 2 if SIMULATED else 4096
STAGE_BLOCKS = 2 if SIMULATED else 1024  # each has working memory of its own
SHARES = 7 if SIMULATED else 8192  # that bits are counted in
FIRST_CANDIDATES = 64 if SIMULATED else 1 << 15


class Search:
    """Kernels and buffers for up to ``frames`` frames at once, of lattices of one shape, by one cascade.

    ``around`` (M, 3) are the voxels about a peak that compete for it, ``most_peaks`` how many peaks a frame may have,
    and ``refines`` what is fitted to them: see :class:`headvox.config.DetectorConfig`.
    """

    def __init__(
        self, cascade: CompiledCascade, shape: tuple[int, int, int], around: I32, most_peaks: int, refines: str,
        frames: int,
    ) -> None:  # fmt: skip
        nx, ny, nz = self.shape = shape
        self.cascade, self.frames, self.most_peaks, self.refines = cascade, frames, most_peaks, refines
        self.counting = cascade.source.counting
        self.stream = cuda.stream()
        self.is_graph = False
        """Whether a frame is one launch."""
        self._again: dict[tuple[int, int], Callable[[], None]] = {}
        self._room_for_words(1)
        cells = math.prod(shape)
        self.cells = self._empty(cells if self.counting else -(-cells // 4), np.uint32)
        self.grid = self.cells if self.counting else self.cells.view(np.uint8)
        self.S = cuda.device_array((frames, nx + 1, ny + 1, nz + 1), np.uint32)
        self.places = (nx + 2) * (ny + 2) * (nz + 2)
        self.passed = self._empty(-(-self.places // 32), np.uint32)
        self.shares = self._empty(SHARES, np.int32)
        self.counts = self._empty(suppress.HEADS + 1, np.int32)
        self._make_room(FIRST_CANDIDATES)
        self._tables(around)
        source = cascade.source
        self.fits = Fits(frames, most_peaks, refines, cascade.voxel_m, source.subdivision, source.counting)
        poses = MOST_POSES if refines == "pose" else 0
        self.report = self._empty(judge.REPORT_HEADER + judge.ROW * most_peaks + judge.POSE * poses, np.int64)
        self.real_report = self.report.view(np.float64)
        self.host_report = cuda.pinned_array(self.report.shape, np.int64)

    def _empty(self, count: int, dtype: npt.DTypeLike) -> Any:
        return cuda.device_array((self.frames, count), dtype)

    def _room_for_words(self, words: int) -> None:
        """Have room for rows of so many words."""
        words = -(-words // OCTET) * OCTET
        self._again.clear()
        self.host_rows = cuda.pinned_array((self.frames, words), np.int32)
        self.host_rows[:] = 0
        self.whole = cuda.device_array((self.frames, words), np.int32)
        self.real, self.half = self.whole.view(np.float32), self.whole.view(np.uint16)
        self.quads = self.real.reshape(self.frames, words // 4, 4)
        self.wide = self.whole.view(np.float64)
        self.octets = self.wide.reshape(self.frames, words // OCTET, 8)

    def _make_room(self, candidates: int) -> None:
        self._again.clear()
        self.candidates = self._empty(candidates, np.int32)
        self.scores, self.yaws = self._empty(candidates, np.int64), self._empty(candidates, np.int32)
        self.yaws.copy_to_device(np.zeros((self.frames, candidates), np.int32))
        self.marked = self._empty(-(-candidates // 32), np.uint32)
        self.maxima, self.ranks = self._empty(candidates, np.int32), self._empty(candidates, np.int32)

    def _tables(self, around: I32) -> None:
        """Send the cascade to the device, and make room for what it says of the peaks."""
        cascade, most = self.cascade, self.most_peaks
        _, ny, nz = self.shape
        self.column, self.layer = nz + 2, (ny + 2) * (nz + 2)
        steps = around @ np.array([self.layer, self.column, 1])
        self.stay = cuda.to_device(np.zeros(1, np.int32))
        self.steps = cuda.to_device(steps.astype(np.int32))
        weights, spans, rank, limits = gate_tables(cascade.gate, np.dtype(np.uint32))
        self.gate = _to_device((cascade.gate.boxes, weights, spans, rank, limits))
        self.votes = _to_device(vote.votes_table(cascade.votes)) if cascade.votes else None
        self.search = _to_device(vote.stages_table(cascade.stages)) if cascade.stages else None
        self.judge = _to_device(vote.stages_table(cascade.judge)) if cascade.judge else None
        sizes = vote.Sizes.of(cascade.stages, cascade.judge)
        self.sums = cuda.device_array((self.frames * STAGE_BLOCKS, sizes.boxes), np.int64)
        self.features = cuda.device_array((self.frames * STAGE_BLOCKS, sizes.features), np.int64)
        self.about_scores = self._empty(most * len(steps), np.int64)
        self.peaks, self.peak_places = self._empty(most, np.int32), self._empty(most, np.int32)
        self.peak_scores, self.best = self._empty(most, np.int64), self._empty(most, np.int32)
        self.judged, self.judged_places = self._empty(most, np.int32), self._empty(most, np.int32)
        self.judged_scores = self._empty(most, np.int64)
        self.unseen = cuda.to_device(np.zeros((self.frames, 1, 1, 2), np.int32))
        self.asked = self._empty(most, np.bool_)
        boxes = seen_boxes(cascade.judge)[0] if cascade.judge else np.zeros((0, 6), np.int32)
        offsets, start = cells_of(boxes)
        self.sees = len(offsets) > 0
        if self.sees:
            self.offsets, self.start = cuda.to_device(offsets), cuda.to_device(start)
            self.states = cuda.device_array((self.frames, most, len(offsets)), np.uint8)
            self.shift = shift_of_unseen(cascade.source)
            self.seen = cuda.device_array((self.frames, most, len(boxes), 2), np.int32)

    # ------------------------------------------------------------------------------------------------ the frames

    def run(self, asked: Sequence[Asked], rays_of: Callable[[DepthImage, Lattice], Rays]) -> list[Found]:
        """Return what is found in each of up to ``frames`` frames."""
        words = max(words_of(one) for one in asked)
        if words > self.host_rows.shape[1]:
            self._room_for_words(words + words // 4)
        for one, row in zip(asked, self.host_rows, strict=False):
            pack(one, rays_of, row)
        sensors = max(len(one.frame.clouds) + len(one.frame.depths) for one in asked)
        while True:
            self._start(len(asked), sensors)
            self.stream.synchronize()
            found = [self._read(row) for row in self.host_report[: len(asked)]]
            most = max(one.candidates for one in found)
            if most <= self.candidates.shape[1]:
                return found
            self._make_room(2 * most)  # and again: some did not fit

    def _start(self, frames: int, sensors: int) -> None:
        """Start everything: the first time call by call, then as one graph, which is kept while the buffers are."""
        again = self._again.get((frames, sensors))
        if again is not None:
            again()
            return
        plainly = partial(self.all_of, frames, sensors)
        plainly()
        graph = capture(self.stream, plainly)
        self.is_graph = graph is not None
        self._again[frames, sensors] = graph or plainly

    def all_of(self, frames: int, sensors: int) -> None:
        """Start the upload, all stages and the download, one by one."""
        self.upload()
        self.launch(frames, sensors)
        self.download()

    def upload(self) -> None:
        """Start to copy all rows to the device."""
        self.whole.copy_to_device(self.host_rows, stream=self.stream)

    def download(self) -> None:
        """Start to copy all reports to the host."""
        self.report.copy_to_host(self.host_report, stream=self.stream)

    def launch(self, frames: int, sensors: int) -> None:
        """Start all stages for the first ``frames`` rows, which have been uploaded."""
        self._voxelize(frames, sensors)
        self._integrate(frames)
        self._gate(frames)
        self._vote(frames)
        self._suppress(frames)
        self._judge(frames)
        self.fits.launch(self, frames)
        self._report(frames)

    def on(self, items: int, frames: int, sensors: int = 1) -> tuple[Any, ...]:
        """Return how to launch a kernel over so many items a frame."""
        return (min(-(-items // THREADS), MOST_BLOCKS), frames, sensors), THREADS, self.stream

    def _voxelize(self, frames: int, sensors: int) -> None:
        shift = self.cascade.source.subdivision - 1
        voxelize.clear[self.on(self.passed.shape[1], frames)](
            self.cells, self.passed, self.marked, self.counts
        )
        items = self.whole.shape[1] // 2
        voxelize.mark[self.on(items, frames, sensors)](
            self.whole, self.real, self.quads, self.half, self.shape, shift, self.counting, self.cells
        )

    def _integrate(self, frames: int) -> None:
        nx, ny, nz = (n + 1 for n in self.shape)
        integral.sum_along_z[self.on(nx * ny, frames)](self.cells, self.counting, self.S)
        integral.sum_along[self.on(nx * nz, frames)](self.S)
        integral.sum_along[self.on(ny * nz, frames)](self.S.reshape(self.frames, 1, nx, ny * nz))

    def _gate(self, frames: int) -> None:
        spacing = self.cascade.gate.spacing
        gate.gate[self.on(math.prod(self.shape), frames)](
            self.S, self.whole, *self.gate, spacing, self.passed
        )
        self._compact(self.passed, suppress.CANDIDATES, self.candidates, frames)

    def _compact(self, bits: Any, which: int, listed: Any, frames: int) -> None:
        compact.count_bits[self.on(SHARES, frames)](bits, self.shares)
        compact.add_up[(1, frames), ONE_BLOCK_THREADS, self.stream](self.shares, self.counts, which)
        compact.list_bits[self.on(SHARES, frames)](bits, self.shares, listed)

    def _vote(self, frames: int) -> None:
        votes, stages = self.cascade.votes, self.cascade.stages
        if stages is not None:
            self._score(
                self.candidates, self.stay, suppress.CANDIDATES, self.search, stages.occupied_stages, self.unseen,
                False, self.scores, frames,
            )  # fmt: skip
        elif votes is not None:
            vote.vote_masks[self.on(self.candidates.shape[1], frames)](
                self.S, self.candidates, self.counts, suppress.CANDIDATES, self.votes, votes.masks,
                votes.asymmetry_cost, votes.min_votes, self.scores, self.yaws,
            )  # fmt: skip

    def _score(
        self, places: Any, steps: Any, which: int, table: Any, to_stage: int, seen: Any, sees: bool, scores: Any,
        frames: int,
    ) -> None:  # fmt: skip
        vote.vote_stages[(STAGE_BLOCKS, frames), THREADS, self.stream](
            self.S, self.whole, places, steps, self.counts, which, table, seen, self.asked, sees, to_stage,
            self.sums, self.features, scores,
        )  # fmt: skip

    def _suppress(self, frames: int) -> None:
        on = self.on(self.candidates.shape[1], frames)
        reach = PEAK_REACH[self.cascade.gate.spacing]
        suppress.mark_maxima[on](
            self.candidates, self.counts, self.scores, reach, self.column, self.layer, self.marked
        )
        self._compact(self.marked, suppress.MAXIMA, self.maxima, frames)
        suppress.rank_maxima[on](self.maxima, self.counts, self.scores, self.most_peaks, self.ranks)
        suppress.list_peaks[on](
            self.maxima, self.counts, self.ranks, self.candidates, self.scores, self.peaks, self.peak_places,
            self.peak_scores,
        )  # fmt: skip

    def _judge(self, frames: int) -> None:
        stages: CompiledStages | None = self.cascade.judge
        scores, steps = self.peak_scores, self.stay
        if stages is not None:
            scores, steps = self.about_scores, self.steps
            occupied = stages.occupied_stages
            self._score(
                self.peak_places,
                steps,
                suppress.PEAKS,
                self.judge,
                occupied,
                self.unseen,
                False,
                scores,
                frames,
            )
        judge.keep_best[(1, frames), ONE_BLOCK_THREADS, self.stream](
            self.counts, steps, scores, self.peaks, self.peak_places, self.best, self.judged, self.judged_places,
            self.judged_scores,
        )  # fmt: skip
        if stages is None or not self.sees:
            return
        judge.look_about[self.on(self.most_peaks * len(self.offsets), frames)](
            self.S,
            self.whole,
            self.quads,
            self.half,
            self.counts,
            self.judged_places,
            self.offsets,
            self.states,
        )
        judge.count_states[self.on(self.most_peaks, frames)](
            self.whole, self.counts, self.states, self.start, self.seen
        )
        judge.ask_of[self.on(self.most_peaks, frames)](
            self.whole, self.counts, self.states, self.shift, self.asked, self.judged_scores
        )
        self._score(
            self.judged_places, self.stay, suppress.JUDGED, self.judge, len(stages.stage_keep), self.seen, True,
            self.judged_scores, frames,
        )  # fmt: skip

    def _report(self, frames: int) -> None:
        fits = self.fits
        judge.report[self.on(self.most_peaks, frames)](
            self.S, self.counts, self.judged, self.judged_places, self.judged_scores, self.yaws, fits.kept, fits.heads,
            fits.spheres, fits.poses, self.refines == "pose", self.report, self.real_report,
        )  # fmt: skip

    def _read(self, report: I64) -> Found:
        """Return what a frame's report says, in memory of its own."""
        count, end = int(report[judge.COUNT]), judge.REPORT_HEADER + judge.ROW * self.most_peaks
        rows = report[judge.REPORT_HEADER : end].reshape(-1, judge.ROW)[:count]
        place, spheres = rows[:, judge.PLACE], rows.view(np.float64)[:, judge.SPHERE :]
        cells = np.stack(
            [place // self.layer, place % self.layer // self.column, place % self.column], axis=1
        )
        poses = report[end:].view(np.float64).reshape(-1, judge.POSE)[:count]
        return Found(
            bool(report[judge.TOTAL]),
            int(report[judge.FOUND]),
            (cells - 1).astype(np.int32),
            rows[:, judge.SCORE].copy(),
            rows[:, judge.YAW].copy(),
            spheres[:, :3].copy(),
            spheres[:, 3].copy(),
            judge.poses_of(poses) if self.refines == "pose" else None,
        )


def _to_device(tables: tuple[npt.NDArray[Any], ...]) -> tuple[Any, ...]:
    return tuple(cuda.to_device(np.ascontiguousarray(table)) for table in tables)
