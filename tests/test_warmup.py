"""Warming up compiles all that later frames need."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from headvox import warmup
from headvox.config import DetectorConfig
from headvox.data import Cloud, DepthImage, Expected, Frame, Intrinsics
from headvox.errors import HeadvoxError
from headvox.masks.read import shipped_cascades
from headvox.pipeline import Detector
from headvox.warmup import cache_folder, warm_up


def compiled() -> dict[str, int]:
    """How many versions of each kernel there are in this process."""
    modules = [module for name, module in list(sys.modules.items()) if name.startswith("headvox.")]
    kernels = {
        k.py_func.__qualname__: k for m in modules for k in vars(m).values() if isinstance(k, Dispatcher)
    }
    return {name: len(kernel.signatures) for name, kernel in kernels.items()}


def frames() -> list[Frame]:
    """A ball and a wall, as points and as depth images, in memory of one's own and in somebody else's."""
    rng = np.random.default_rng(1)
    ball = rng.normal(size=(4000, 3))
    ball *= 0.1 / np.linalg.norm(ball, axis=1, keepdims=True)
    points = np.ascontiguousarray(ball + np.array([1.0, 0.0, 1.5]), dtype=np.float32)
    depth = np.full((60, 80), 2000, np.uint16)
    depth[20:40, 30:50] = 1500
    camera = Intrinsics(80, 60, 70.0, 70.0, 39.5, 29.5)
    T = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1.0]])
    made = []
    for writeable in (True, False):
        points, depth = points.copy(), depth.copy()
        points.flags.writeable = depth.flags.writeable = writeable
        made.append(Frame(0, clouds=(Cloud("ball", points),)))
        made.append(
            Frame(0, depths=(DepthImage("left", depth, camera, T), DepthImage("right", depth, camera, T)))
        )
    return made


@pytest.mark.parametrize("cascade", shipped_cascades())
@pytest.mark.parametrize("threads", [1, 2])
def test_no_frame_compiles_anything_after_a_warm_up(cascade: str, threads: int) -> None:
    config = DetectorConfig(cascade=cascade, threads=threads, min_score=-1000.0)
    warm_up(config)
    before = compiled()
    detector = Detector(config)
    for frame in frames():
        heads = detector.detect_frame(frame)
        reach = np.full(len(heads), 0.2)
        detector.detect_frame(frame, Expected(heads.centres, heads.quaternions, reach))
    detector.close()
    assert compiled() == before
    assert sum(before.values()) > 10


# Run by a process of its own: whatever other tests have compiled would hide what a warm-up forgets.
FOLLOW = """
from test_warmup import compiled
import headvox
from headvox.config import DetectorConfig
from headvox.warmup import warm_up
warm_up(DetectorConfig())
before = compiled()
detector, tracker, ids = headvox.Detector(), headvox.Tracker(), set()
for frame in headvox.open_source(headvox.sample_folder()):
    heads = detector.detect_frame(frame, tracker.expected(frame.stamp_ns))
    ids.update(tracker.update(heads, frame).ids.tolist())
print(len(ids), sum(before.values()), {name: n for name, n in compiled().items() if n != before.get(name)})
"""


def test_following_people_compiles_nothing_after_a_warm_up() -> None:
    here = Path(__file__).parent
    done = subprocess.run(
        [sys.executable, "-c", FOLLOW], capture_output=True, text=True, check=True, cwd=here
    )
    ids, loops, new = done.stdout.strip().split(" ", 2)
    assert int(ids) >= 3
    assert int(loops) > 30
    assert new == "{}"


@pytest.mark.parametrize("voxel_m", [0.005, 0.2])
def test_any_voxel_size_is_quick_to_warm_up(voxel_m: float) -> None:
    warm_up(DetectorConfig(voxel_m=voxel_m))


def test_an_unknown_cascade_is_told() -> None:
    with pytest.raises(HeadvoxError, match="nonesuch"):
        warm_up(DetectorConfig(cascade="nonesuch"))


def test_the_cache_is_a_folder() -> None:
    warm_up(DetectorConfig())
    assert cache_folder().is_dir()


def test_another_process_compiles_the_pose_fit_where_nothing_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    begun = []

    class Noted(subprocess.Popen):
        def __init__(self, command: list[str], **settings: int) -> None:
            begun.append(self)
            super().__init__(command, **settings)

    monkeypatch.setattr(warmup, "_is_kept", lambda kernel: False)
    monkeypatch.setattr(warmup.subprocess, "Popen", Noted)
    warm_up(DetectorConfig())
    assert [process.returncode for process in begun] == [0]
    warm_up(DetectorConfig(refine="sphere"))
    assert len(begun) == 1


def test_the_other_process_compiles_the_fit_for_all_that_a_detector_hands_it() -> None:
    code = "import headvox.warmup as w; w._fit(); print(sorted(map(str, w.search.signatures)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    warm_up(DetectorConfig())
    assert done.stdout.strip() == str(sorted(map(str, warmup.search.signatures)))
    assert warmup.search.signatures


def test_a_warm_up_that_is_interrupted_ends_the_other_process(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []

    class Sleeper(subprocess.Popen[bytes]):
        def __init__(self, command: list[str], **named: int) -> None:
            super().__init__([command[0], "-c", "import time; time.sleep(600)"], **named)
            started.append(self)

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(warmup, "_is_kept", lambda kernel: False)
    monkeypatch.setattr(warmup.subprocess, "Popen", Sleeper)
    monkeypatch.setattr(warmup, "_search", interrupted)
    with pytest.raises(KeyboardInterrupt):
        warm_up(DetectorConfig())
    assert [process.wait(10.0) for process in started] == [-signal.SIGTERM]
