"""What is fitted on the device to the peaks of a batch of frames: its memory, and how the kernels follow each other."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import cuda

from headvox.assemble import MOST_POSES, SAME_HEAD_M
from headvox.cuda import nearby, pose, refine
from headvox.cuda.lanes import SIMULATED
from headvox.pose.fit import Poses, all_turns, upright_turns
from headvox.pose.nearby import MOST_SAMPLES, RAY, SAMPLE
from headvox.pose.residuals import ROWS, STATE, TOLD
from headvox.pose.settle import Refined
from headvox.pose.template import WORDS, load_template
from headvox.pose.trials import (
    COARSE_SAMPLES,
    FINE_RAYS,
    FINE_SAMPLES,
    MOST_REFINED,
    MOST_STARTS,
    POLISH_RAYS,
    POLISH_SAMPLES,
)
from headvox.refine import cells_about

if TYPE_CHECKING:
    from headvox.cuda.search import Search

# The simulator runs every thread in turn.
SPHERE_THREADS = 2 if SIMULATED else refine.MOST_THREADS
GATHER_THREADS = 2 if SIMULATED else nearby.MOST_THREADS
POSE_THREADS = 2 if SIMULATED else pose.MOST_THREADS
SPHERE_BLOCKS = 1 if SIMULATED else 64
GATHER_BLOCKS = 2 if SIMULATED else MOST_POSES
POSE_BLOCKS = 2 if SIMULATED else 512  # shared by the frames; each has working memory of its own


class Fits:
    """Buffers for the fits of up to ``frames`` frames with up to ``most`` peaks each."""

    def __init__(
        self, frames: int, most: int, refines: str, voxel_m: float, subdivision: int, counting: bool
    ) -> None:
        self.refines, self.voxel_m, self.subdivision, self.counting = refines, voxel_m, subdivision, counting
        self.reach = cells_about(voxel_m)
        self.kept, self.order, self.heads = (cuda.device_array((frames, most), np.int32) for _ in range(3))
        self.spheres = cuda.device_array((frames, most, 4), np.float64)
        rows = frames * MOST_POSES if refines == "pose" else 0
        self.near = cuda.device_array((frames, MOST_POSES, 3), np.int32)
        self.poses = Poses(*(_reals(rows, *shape) for shape in ((3,), (4,), (), (3, 3), (3, 3), (), (), ())))
        if refines == "pose":
            self._make_room_for_poses(frames, rows)

    def _make_room_for_poses(self, frames: int, rows: int) -> None:
        each = MOST_STARTS + 1
        self.samples, self.rays = _reals(rows, MOST_SAMPLES, SAMPLE), _reals(rows, MOST_SAMPLES, RAY)
        self.points = _reals(rows, SAMPLE, FINE_SAMPLES + COARSE_SAMPLES + POLISH_SAMPLES)
        self.passing = _reals(rows, RAY, FINE_RAYS + POLISH_RAYS)
        self.turns = _reals(rows, 9)
        self.pose_blocks = max(POSE_BLOCKS // frames, 1)
        blocks = frames * self.pose_blocks
        words = cuda.device_array((blocks, WORDS, pose.COLUMNS), np.int64)
        self.scratch = pose.Scratch(_reals(blocks, ROWS, pose.COLUMNS), words)
        self.starts = pose.Starts(
            *(_reals(rows, each, *shape) for shape in ((), (STATE,), (STATE,), (TOLD,)))
        )
        self.picked = _reals(rows, MOST_REFINED, STATE)
        self.chosen = Refined(
            _reals(rows, MOST_REFINED, STATE), _reals(rows, MOST_REFINED, TOLD), _reals(rows, 6, 6)
        )
        self.upright, self.anyhow = cuda.to_device(upright_turns()), cuda.to_device(all_turns())
        template = load_template()
        self.template = template._replace(
            **{
                name: cuda.to_device(part)
                for name, part in template._asdict().items()
                if isinstance(part, np.ndarray)
            }
        )

    def launch(self, search: Search, frames: int) -> None:
        """Start all fits of the first ``frames`` frames, whose peaks ``search`` has judged."""
        uploaded, counts, stream = (search.whole, search.wide), search.counts, search.stream
        refine.keep[(1, frames), 1, stream](
            search.S, *uploaded, search.octets, counts, search.judged_places, search.judged_scores, self.voxel_m,
            self.kept,
        )  # fmt: skip
        refine.fit_spheres[(SPHERE_BLOCKS, frames), SPHERE_THREADS, stream](
            search.S, *uploaded, search.grid, counts, search.judged_places, self.kept, self.reach, self.voxel_m,
            self.subdivision, self.counting, self.refines != "none", self.spheres,
        )  # fmt: skip
        refine.suppress_overlaps[(1, frames), SPHERE_THREADS, stream](
            counts, search.judged_scores, self.kept, self.spheres, SAME_HEAD_M, self.order, self.heads
        )
        if self.refines == "pose":
            self.launch_poses(search, frames)

    def launch_poses(self, search: Search, frames: int) -> None:
        """Start the fit of poses near the spheres of the first heads of each frame."""
        counts, stream = search.counts, search.stream
        nearby.gather[(GATHER_BLOCKS, frames), GATHER_THREADS, stream](
            search.whole, search.wide, search.real, search.half, search.octets, counts, self.heads, self.spheres,
            self.samples, self.rays, self.near, self.points, self.passing, self.turns,
        )  # fmt: skip
        pose.fit_starts[(self.pose_blocks, frames), POSE_THREADS, stream](
            counts, self.near, self.points, self.passing, self.turns, self.upright, self.anyhow, self.template,
            self.scratch, self.starts,
        )  # fmt: skip
        pose.settle_heads[(min(self.pose_blocks, MOST_POSES), frames), POSE_THREADS, stream](
            counts, self.near, self.heads, self.spheres, self.points, self.passing, self.upright, self.anyhow,
            self.template, self.scratch, self.starts, self.picked, self.chosen, self.poses,
        )  # fmt: skip


def _reals(*shape: int) -> Any:
    return cuda.device_array(shape, np.float64)
