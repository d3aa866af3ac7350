"""The working memory of a detector: made once, used for every frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.assemble import MOST_POSES
from headvox.data import F64, I32, I64
from headvox.gate import candidate_reach, gate_tables, shape_of_passed
from headvox.integral import box_reach, room_for, row_for, shape_with_margins
from headvox.lattice import Lattice
from headvox.machine.simd import LANES
from headvox.masks.compile import CompiledCascade, CompiledStages
from headvox.pose.fit import FitMemory
from headvox.refine import MOST_PARTS, ROWS
from headvox.slabs import Slabs, cut
from headvox.visibility import as_columns, cells_of
from headvox.vote import StageTables, seen_boxes
from headvox.voxelize import Marking


class Memory:
    """The buffers of a detector: nothing as large as a frame is allocated per frame."""

    def __init__(self, lattice: Lattice, cascade: CompiledCascade, threads: int, poses: bool) -> None:
        counting = cascade.source.counting
        cell_type = np.uint32 if counting else np.uint8
        sum_type = np.uint32 if counting or cascade.largest_sum > 0xFFFF else np.uint16
        self.cascade = cascade
        self.place(lattice)
        self.dirty: tuple[int, int] | None = (0, 0)
        self.grids = _touched((threads, room_for(math.prod(lattice.shape))), cell_type)
        """The cells as each thread entered them, see :func:`headvox.integral.integrate`."""
        self.boxes = np.empty((threads, 6), np.int64)
        """What cells each thread entered: lowest and highest in x, y, z."""
        self.marking = [Marking.of(LANES) for _ in range(threads)]
        tables = [part.boxes for part in (cascade.gate, cascade.stages, cascade.votes) if part is not None]
        if cascade.votes is not None:
            tables.append(cascade.votes.pairs.reshape(-1, 6))
        if cascade.judge is not None:  # it looks at the neighbours of candidates, too
            tables += [cascade.judge.boxes + one for one in (-1, 1)]
        self.reach = box_reach(np.concatenate(tables))
        slices, *slice_shape = shape_with_margins(lattice.shape, self.reach)
        self.S = _touched((self.cut(lattice.shape[0], threads).slices * math.prod(slice_shape),), sum_type)
        self.row = [row_for(slice_shape[1], sum_type) for _ in range(threads)]
        self.index = np.zeros(slices * math.prod(slice_shape), np.int32)
        self.lowest = self.reach[0::2]
        self.first = np.zeros(3, np.int64)
        """The cell that the integral volume begins at,"""
        self.region = np.zeros(6, np.int64)
        """and which of its voxels are searched: x0 x1 y0 y1 z0 z1, half-open."""
        self.gate = gate_tables(cascade.gate, self.S.dtype)
        self.gate_corners = np.empty((len(cascade.gate.boxes), 8), np.int64)
        self.candidate_reach = candidate_reach(cascade.gate)
        whole = np.array([0, lattice.shape[0], 0, lattice.shape[1], 0, lattice.shape[2]])
        self.passed = _touched((math.prod(shape_of_passed(whole)),), np.uint32)
        self.survivors = np.empty((4096, 3), np.int32)
        self.parts = [np.empty((ROWS, MOST_PARTS)) for _ in range(threads)]
        self.unseen = np.zeros((1, 1, 2), np.int32)
        self.sees = cascade.source.sees  # asks every tree: not for every frame
        self.search = Stages.of(cascade.stages, self.S.dtype, threads) if cascade.stages else None
        self.judge = Stages.of(cascade.judge, self.S.dtype, threads) if cascade.judge else None
        self.fits = FitMemory.new(threads, MOST_POSES) if poses else FitMemory.new(0, 0)
        self.scores: I64 = np.empty(0, np.int64)
        self.make_room(4096)

    def used(self, grid: npt.NDArray[Any], dirty: tuple[int, int] | None) -> npt.NDArray[Any]:
        """Return the part of a ``grid`` in the slices ``dirty``: all of it, if a frame was interrupted midway."""
        if dirty is None:
            return grid
        a_slice = math.prod(self.lattice.shape[1:])
        return grid[dirty[0] * a_slice : dirty[1] * a_slice]

    def cut(self, slices: int, threads: int) -> Slabs:
        """Cut the volume about so many ``slices`` of candidates into slabs."""
        self.slabs = cut(slices, int(self.reach[0]), int(self.reach[1]), threads)
        return self.slabs

    def volume_about(self, candidates: I64, threads: int) -> npt.NDArray[Any]:
        """Return room for the integral volume about the box ``candidates``, in a slab for each of ``threads``.

        It has margins for whatever box is looked up there.
        """
        searched = (candidates[3:] - candidates[:3] + 1).tolist()
        slabs = self.cut(searched[0], threads)
        shape = (slabs.slices, *shape_with_margins(searched, self.reach)[1:])
        self.first = candidates[:3] + self.lowest
        self.region[0::2], self.region[1::2] = -self.lowest, searched - self.lowest
        S: npt.NDArray[Any] = self.S[: math.prod(shape)].reshape(shape)
        return S

    def candidates_about(self, occupied: I64) -> I64:
        """Return the box of cells that may pass the gate, lowest and highest, where these are occupied."""
        box: I64 = np.minimum(np.maximum(occupied + self.candidate_reach, 0), self.last_cells)
        return box

    def centres(self, cells: I32) -> F64:
        """Return the world centres (N, 3) of ``cells`` (N, 3) of the integral volume."""
        return self.lattice.centres(cells + self.first)

    def place(self, lattice: Lattice) -> None:
        """Stand for another region of the same shape."""
        self.lattice = lattice
        self.limits, self.bits, self.odd = lattice.limits(), lattice.bits, lattice.odd
        self.last_cells = np.tile(np.array(lattice.shape) - 1, 2)

    def make_room_for_width(self, pixels: int) -> None:
        """Have room for images as wide as that."""
        if len(self.marking[0].codes) < pixels + LANES:
            self.marking = [Marking.of(pixels) for _ in self.marking]

    def make_room(self, candidates: int) -> None:
        """Have room for as many candidates."""
        if len(self.scores) < candidates:
            self.scores = np.empty(2 * candidates, np.int64)
            self.alive = np.empty(2 * candidates, np.int64)
            self.yaws = np.zeros(2 * candidates, np.int32)
            self.peaks = np.empty(2 * candidates, np.int64)


def _touched(shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Return zeros that are written, so that no frame has to wait for the system to fetch their pages."""
    return np.full(shape, 0, dtype)


@dataclass(frozen=True, slots=True)
class Stages:
    """Stages as tables, with the working memory of each thread, and the cells that they ask the cameras for."""

    compiled: CompiledStages
    tables: tuple[npt.NDArray[Any], ...]
    memory: list[tuple[npt.NDArray[Any], ...]]
    corners: I64
    offsets: I32
    offset_start: I32
    occupied: tuple[int, int]
    """The stages that do without the cameras, from the first to the second,"""
    seeing: tuple[int, int]
    """and all further ones."""

    @classmethod
    def of(cls, compiled: CompiledStages, sum_type: np.dtype[Any], threads: int) -> Stages:
        """Return ``compiled`` with the memory for volumes of ``sum_type``."""
        stages = StageTables.of(compiled, sum_type)
        boxes, _ = seen_boxes(compiled)
        memory = [stages.memory() for _ in range(threads)]
        offsets, start = cells_of(boxes)
        corners = np.empty((len(compiled.boxes), 8), np.int64)
        first, all_stages = compiled.occupied_stages, len(compiled.stage_keep)
        spans = (0, first), (first, all_stages)
        return cls(compiled, stages.tables, memory, corners, as_columns(offsets), start, *spans)
