"""Compile every loop that a detector runs, or load it from the disk, before the first frame comes."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from headvox.config import DetectorConfig
from headvox.data import Cloud, DepthImage, Expected, Frame, Heads, Intrinsics
from headvox.gate import gate_columns
from headvox.machine.threads import Threads, begin
from headvox.masks.compile import CompiledCascade, CompiledStages
from headvox.masks.read import load_cascade
from headvox.organise import Organiser
from headvox.pipeline import Detector
from headvox.pose.fit import FitMemory, fit_poses
from headvox.pose.trials import search
from headvox.tracking.identity import price
from headvox.tracking.tracker import Tracker

_ANYTHING = 1 << 40
VOXEL_M = 0.025


def warm_up(config: DetectorConfig) -> None:
    """Run a detector as ``config`` asks for, over a few voxels of points and a depth image of a few pixels.

    Where the disk has no compiled loops yet, two processes share the work: another one compiles the pose fit.

    Raises:
        HeadvoxError: no such cascade.
    """
    voxel = config.voxel_m or load_cascade(config.cascade).voxel_m
    tiny = replace(
        config,
        centre=(0.0, 0.0, 0.0),
        max_range_m=6 * voxel,
        min_height_m=-6 * voxel,
        max_height_m=6 * voxel,
        min_score=-1e6,
    )
    if config.refine == "pose" and not _is_kept(search):
        nothing = subprocess.DEVNULL  # what it cannot compile is compiled here, and told here
        command = [sys.executable, "-m", "headvox.warmup"]
        with subprocess.Popen(command, stdin=nothing, stdout=nothing, stderr=nothing) as other:
            try:
                _search(replace(tiny, refine="sphere"), voxel)
                _follow()
            except BaseException:
                other.terminate()
                raise
    _search(tiny, voxel)
    _follow()


def _search(config: DetectorConfig, voxel: float) -> None:
    detector = Detector(config)
    detector.cascade = _open(detector.cascade)
    for cloud, image in _frames(voxel):
        detector.detect_frame(cloud)
        detector.detect_frame(image)
        detector.detect_frame(image, _expected())
    Organiser(Threads(1)).organised(_camera_s_cloud())
    detector.close()


def _fit() -> None:
    memory, threads = FitMemory.new(1, 2), Threads(1)
    for frames in _frames(VOXEL_M):
        for frame in frames:
            fit_poses(frame, np.zeros((2, 3)), memory, threads, _expected())
    threads.close()


def _frames(voxel: float) -> Iterator[tuple[Frame, Frame]]:
    """Yield a frame of points and one of an image: in memory of one's own, and in somebody else's.

    Numba compiles a loop anew for the latter.
    """
    grid = voxel * np.linspace(-2, 2, 9, dtype=np.float32)
    points = np.stack(np.meshgrid(grid, grid, grid), axis=-1).reshape(-1, 3).astype(np.float32)
    wall = np.full((12, 16), 3, np.uint16)
    camera = Intrinsics(16, 12, 20.0, 20.0, 8.0, 6.0, depth_scale=voxel)
    for writeable in (True, False):
        points.flags.writeable = wall.flags.writeable = writeable
        image = DepthImage("warm-up", wall, camera, np.eye(4))
        yield Frame(0, clouds=(Cloud("warm-up", points),)), Frame(0, depths=(image,))


def _camera_s_cloud() -> Frame:
    """Return a cloud that a depth camera may have made: of a wall, 1 m away."""
    v, u = np.mgrid[:24, :32].astype(np.float32) / 20.0
    points = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    return Frame(0, clouds=(Cloud("warm-up", points, np.eye(4)),))


def _expected() -> Expected:
    """Return a head that is expected, and one whose orientation nobody knows."""
    turns = np.array([[0.0, 0.0, 0.0, 1.0], [np.nan, np.nan, np.nan, np.nan]])
    return Expected(np.zeros((2, 3)), turns, np.full(2, 0.3))


def _follow() -> None:
    """Run a tracker over a head that is new, seen again, expected, and looked for."""
    head = Heads(np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0, 1.0]]), np.full(1, 0.1), np.ones(1))
    for _, image in _frames(VOXEL_M):
        tracker = Tracker()
        for k, found in enumerate((head, head, Heads())):
            tracker.update(found, replace(image, stamp_ns=k))
            tracker.expected(k + 1)


def cache_folder() -> Path:
    """Return the folder where the compiled loops of the search are kept; each package has one."""
    return _folder_of(gate_columns)


def kept_loops() -> int:
    """Return how many compiled loops the disk has, of search, poses and tracks."""
    folders = {_folder_of(kernel) for kernel in (gate_columns, search, price, begin)}
    return sum(1 for folder in folders for _ in folder.glob("*.nbc"))


def _folder_of(kernel: Any) -> Path:
    return Path(kernel.stats.cache_path)


def _is_kept(kernel: Any) -> bool:
    """Whether the disk has some version of a compiled loop."""
    name = f"{kernel.__module__.rpartition('.')[2]}.{kernel.__name__}-*"
    return any(_folder_of(kernel).glob(name))


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


if __name__ == "__main__":
    _fit()
