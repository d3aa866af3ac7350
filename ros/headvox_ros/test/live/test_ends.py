"""How a node ends: with a reason when it cannot start, and cleanly when it is told to."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import pytest
from robot import NS, START_S, STEP


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ([], "There is no topic to listen to"),
        (["depths:=['/a/image']", "detector.refine:=magic"], "detector.refine"),
        (["depths:=['/a/image']", "reliability:=maybe"], "expected best_effort or reliable"),
        (["depths:=['/a/image']", "camera_infos:=['/a','/b']"], "expected one for each of the 1 depths"),
    ],
)
def test_a_node_that_cannot_start_says_why_and_exits_with_1(start, parameters, said):
    code, output = start("head_detector", *parameters).wait()
    assert code == 1
    assert said in output
    assert "Traceback" not in output


def shared_memory_of(pid: int) -> set[str]:
    """The shared memory that a process has mapped and nobody else has."""
    maps = Path(f"/proc/{pid}/maps").read_text()
    return {line.split()[-1] for line in maps.splitlines() if "/dev/shm/fastdds" in line}


def test_interrupted_in_mid_frame_it_ends_cleanly(robot, start, frames):
    """Frames come as fast as they can while it is told to end: no traceback, no thread, no shared memory stays."""
    ours = shared_memory_of(os.getpid())
    process = start(
        "head_detector", "depths:=['/only/image']", "target_frame:=world", "reliability:=reliable"
    )
    robot.place("only_optical", frames[0].depths[0].T_world_camera)
    stamps = itertools.count(5000 * NS, STEP)
    seen = len(robot.poses())
    robot.wait(
        lambda: len(robot.poses()) > seen + 3,
        START_S,
        meanwhile=lambda: robot.see("only", frames[0].depths[0], next(stamps)),
        every_s=0.02,
    )
    theirs = shared_memory_of(process.pid) - ours
    assert theirs
    for k in range(40):
        robot.see("only", frames[0].depths[0], next(stamps))
        if k == 20:
            process.interrupt()
    code, said = process.wait()
    assert code == 0, said
    assert "Traceback" not in said
    assert "rror" not in said, said
    assert not Path(f"/proc/{process.pid}").exists()
    own = {name for name in theirs if "port" not in name}  # ports are closed when both ends are
    assert not [name for name in own if Path(name).exists()]


def test_interrupted_while_it_compiles_it_ends_cleanly(robot, start, tmp_path):
    process = start("head_detector", "depths:=['/a/image']", NUMBA_CACHE_DIR=str(tmp_path))
    robot.wait(lambda: any(tmp_path.rglob("*.nbi")), START_S)
    process.interrupt()
    code, said = process.wait(START_S)
    assert code == 0, said
    assert "Traceback" not in said, said
