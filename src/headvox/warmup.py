"""Compile every loop that a detector runs, or load it from the disk, before the first frame comes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from headvox.compile_masks import CompiledCascade, CompiledStages
from headvox.config import DetectorConfig
from headvox.data import Cloud, DepthImage, Expected, Frame, Heads, Intrinsics
from headvox.gate import gate_columns
from headvox.pipeline import Detector
from headvox.read_masks import load_cascade
from headvox.track import Tracker

_ANYTHING = 1 << 40


def warm_up(config: DetectorConfig) -> None:
    """Run a detector as ``config`` asks for, over a few voxels of points and a depth image of a few pixels.

    Raises:
        HeadvoxError: no such cascade.
    """
    voxel = config.voxel_m or load_cascade(config.cascade).voxel_m
    near = replace(config, max_range_m=6 * voxel, min_height_m=-6 * voxel, max_height_m=6 * voxel)
    detector = Detector(replace(near, centre=(0.0, 0.0, 0.0), min_score=-1e6))
    detector.cascade = _open(detector.cascade)
    grid = voxel * np.linspace(-2, 2, 9, dtype=np.float32)
    points = np.stack(np.meshgrid(grid, grid, grid), axis=-1).reshape(-1, 3).astype(np.float32)
    wall = np.full((12, 16), 3, np.uint16)
    camera = Intrinsics(16, 12, 20.0, 20.0, 8.0, 6.0, depth_scale=voxel)
    # Numba compiles a loop anew for arrays that lie in somebody else's buffer.
    for writeable in (True, False):
        points.flags.writeable = wall.flags.writeable = writeable
        detector.detect_frame(Frame(0, clouds=(Cloud("warm-up", points),)))
        frame = Frame(0, depths=(DepthImage("warm-up", wall, camera, np.eye(4)),))
        detector.detect_frame(frame)
        detector.detect_frame(frame, _expected())
        _follow(frame)
    detector.close()


def _expected() -> Expected:
    """Return a head that is expected, and one whose orientation nobody knows."""
    turns = np.array([[0.0, 0.0, 0.0, 1.0], [np.nan, np.nan, np.nan, np.nan]])
    return Expected(np.zeros((2, 3)), turns, np.full(2, 0.3))


def _follow(frame: Frame) -> None:
    """Run a tracker over a head that is new, seen again, and looked for."""
    tracker = Tracker()
    head = Heads(np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0, 1.0]]), np.full(1, 0.1), np.ones(1))
    for k, found in enumerate((head, head, Heads())):
        tracker.update(found, replace(frame, stamp_ns=k))


def cache_folder() -> Path:
    """Return the folder where the compiled loops are kept."""
    return Path(gate_columns.stats.cache_path)  # type: ignore[attr-defined]


def _open(cascade: CompiledCascade) -> CompiledCascade:
    """Return ``cascade`` with all its doors open, so that each loop is run whatever the masks ask for."""
    gate, votes = cascade.gate, cascade.votes

    def opened(stages: CompiledStages | None) -> CompiledStages | None:
        return replace(stages, stage_keep=np.full_like(stages.stage_keep, -_ANYTHING)) if stages else None

    return replace(
        cascade,
        gate=replace(gate, low=np.full_like(gate.low, -_ANYTHING), high=np.full_like(gate.high, _ANYTHING)),
        votes=replace(votes, min_votes=0) if votes else None,
        stages=opened(cascade.stages),
        judge=opened(cascade.judge),
    )
