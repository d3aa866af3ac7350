"""The paper's third scenario over ROS 2, short: two D435i, a walking person, three processes."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from robot import NS, START_S

from headvox.parallel.workers import Workers
from headvox.synth.camera import d435i
from headvox.synth.presets import two_cameras
from headvox.synth.record import stamps, write_recording
from headvox_ros.scenario import play, report

FRAMES, LOOPS = 12, 2


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    scene = two_cameras(3, duration_s=0.1 * FRAMES, sensor=d435i())
    return str(
        write_recording(tmp_path_factory.mktemp("rig") / "rig", scene, stamps(FRAMES), workers=Workers(2))
    )


@pytest.mark.parametrize("sensors", ["depth", "cloud"])
def test_a_walking_person_between_two_cameras(rig, sensors):
    """Whatever the machine has time for: what it answers is right, and what it does not was left out for a fresher one.

    The times are printed, and judged by whoever reads them.
    """
    heard = play(rig, sensors, rate_hz=4.0, loops=LOOPS, reliability="reliable")
    figures = report(rig, heard, rate_hz=4.0, loops=LOOPS)
    print(f"\n{sensors}:", {name: round(value, 3) for name, value in figures.items()})
    assert figures["frames"] == FRAMES * LOOPS
    sent = [heard.first_ns + k * NS // 4 for k in range(FRAMES * LOOPS)]
    answered = [stamp for stamp, _, _ in heard.answers]
    assert answered == sorted(set(answered))
    assert set(answered) <= set(sent)
    due = sum(stamp >= answered[0] for stamp in sent) - figures["frames the player skipped"]
    left_out = figures["frames left out for fresher ones"] + figures["messages lost"]
    assert len(answered) + left_out >= due
    found = figures["recall"] * figures["heads"] / figures["frames answered"]
    assert found > 0.9
    assert figures["false a frame"] < 0.5
    assert figures["centre error, mean [cm]"] < 4.0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_told_to_end_it_ends_its_nodes_and_says_nothing(robot, start, rig, number):
    process = start("scenario", words=[rig, "--rate", "4", "--loops", "1000"])
    seen = len(robot.poses())
    robot.wait(lambda: len(robot.poses()) > seen, START_S)
    nodes = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    assert len(nodes) == 2
    process.process.send_signal(number)
    code, said = process.wait()
    assert code == 130, said
    assert said == ""
    assert not [node for node in nodes if Path(f"/proc/{node}").exists()]
