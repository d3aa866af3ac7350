"""Whoever knows only standard messages hears frames, stamps, REP 103, markers: the sample that ships, played."""

from __future__ import annotations

import json

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
from robot import NS, START_S, stamp_of, xyz
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from vision_msgs.msg import Detection3DArray
from visualization_msgs.msg import Marker

from headvox import Detector

DEPTHS = "depths:=['/left/depth/image_rect_raw','/right/depth/image_rect_raw']"
CLOUDS = "clouds:=['/left/depth/points','/right/depth/points']"


@pytest.fixture(scope="module")
def truth(sample):
    rows = [json.loads(line) for line in (sample / "heads.jsonl").read_text().splitlines()]
    return {row["stamp_ns"]: np.array([h["centre"] for h in row["heads"] if not h["ignore"]]) for row in rows}


@pytest.fixture(scope="module")
def heard(robot, start, sample):
    """What is to be heard while the sample is played once to a node that takes depth images."""
    robot.listen(Detection3DArray, "/head_detector/heads")
    robot.listen(PoseArray, "/true_heads")
    robot.listen(Clock, "/clock")
    node = start(
        "head_detector", DEPTHS, "target_frame:=world", "use_sim_time:=true", "sync_wait_s:=0.5",
        "reliability:=reliable",
    )  # fmt: skip
    robot.wait(lambda: robot.node.count_publishers("/head_detector/poses") > 0, START_S)
    robot.wait(lambda: robot.node.count_subscribers("/left/depth/image_rect_raw") > 0, START_S)
    player = start(
        "play_recording", f"recording:={sample}", "clock:=true", "loops:=1", "rate_hz:=4.0", "delay_s:=3.0"
    )
    robot.wait(lambda: player.process.poll() is not None)
    heads, truth = robot.got["/head_detector/heads"], robot.got["/true_heads"]
    robot.wait(
        lambda: heads and stamp_of(heads[-1]) == stamp_of(truth[-1])
    )  # nothing newer replaces the last
    told = len(robot.got["/diagnostics"])
    robot.wait(lambda: len(robot.got["/diagnostics"]) > told + 1)  # one that was begun after the last answer
    assert player.wait()[0] == 0
    code, said = node.end()
    assert code == 0, said
    # Frames may have been played before the listener had found who tells their truth, or the time.
    begin = max(min(map(stamp_of, robot.got["/true_heads"])), min(map(time_of, robot.got["/clock"])))
    for topic in ("/true_heads", "/head_detector/heads", "/head_detector/poses"):
        robot.got[topic] = [message for message in robot.got[topic] if stamp_of(message) >= begin]
    robot.got["/clock"] = [message for message in robot.got["/clock"] if time_of(message) >= begin]
    return robot.got


def time_of(message: Clock) -> int:
    return message.clock.sec * NS + message.clock.nanosec


def test_every_message_bears_the_stamp_and_the_frame_of_its_input(heard, truth):
    stamps = [stamp_of(message) for message in heard["/head_detector/heads"]]
    sent = [stamp_of(message) for message in heard["/true_heads"]]
    status = heard["/diagnostics"][-1].status[0]
    told = {row.key: row.value for row in status.values}
    left_out = int(told["replaced_by_fresher"]) + int(told["lost"])
    due = sum(stamp >= stamps[0] for stamp in sent)  # 24 where there is time for all
    assert due > 8
    assert len(stamps) + left_out >= due, (sorted(set(sent) - set(stamps)), told)
    assert stamps == sorted(set(stamps))
    assert set(stamps) <= set(sent)
    for topic in ("/head_detector/heads", "/head_detector/poses"):
        assert {message.header.frame_id for message in heard[topic]} == {"world"}
    markers = [marker for message in heard["/head_detector/markers"] for marker in message.markers]
    assert {marker.header.frame_id for marker in markers} == {"world"}
    assert {stamp for stamp in map(stamp_of, markers) if stamp >= sent[0]} <= set(sent)


def test_heads_are_where_they_truly_are(heard, frames):
    """By the truth that the recording itself publishes; and no more false ones than the library finds there."""
    true = {stamp_of(m): np.array([xyz(p) for p in m.poses]) for m in heard["/true_heads"]}
    found = missed = false = 0
    gaps = []
    for message in heard["/head_detector/heads"]:
        centres = np.array([xyz(d.bbox.center) for d in message.detections]).reshape(-1, 3)
        distance = np.linalg.norm(true[stamp_of(message)][:, None] - centres[None], axis=2)
        near = distance.min(axis=1, initial=9.0)
        found += int((near < 0.15).sum())
        missed += int((near >= 0.15).sum())
        false += int((distance.min(axis=0) >= 0.15).sum())
        gaps += near[near < 0.15].tolist()
    assert found / (found + missed) > 0.9
    assert np.mean(gaps) < 0.03
    detector = Detector()
    theirs = 0
    for stamp, centres in true.items():
        frame = frames[stamp * 4 // NS]
        distance = np.linalg.norm(centres[:, None] - detector.detect_frame(frame).centres[None], axis=2)
        theirs += int((distance.min(axis=0) >= 0.15).sum())
    assert false <= theirs + 5


def facing(pose) -> np.ndarray:
    """Return the direction that a pose's x points in."""
    q = pose.orientation
    return np.array([1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y + q.z * q.w), 2 * (q.x * q.z - q.y * q.w)])


def test_x_is_out_of_the_face(heard):
    """REP 103: against the truth; an orientation that is not known has a variance of pi^2."""
    true = {stamp_of(message): message.poses for message in heard["/true_heads"]}
    angles = []
    for message in heard["/head_detector/heads"]:
        for detection in message.detections:
            if detection.results[0].pose.covariance[35] > 9.8:
                continue
            pose = detection.bbox.center
            away = [np.linalg.norm(xyz(one) - xyz(pose)) for one in true[stamp_of(message)]]
            if min(away) < 0.15:
                near = true[stamp_of(message)][int(np.argmin(away))]
                angles.append(np.degrees(np.arccos(np.clip(facing(near) @ facing(pose), -1.0, 1.0))))
    assert len(angles) > 10
    assert np.median(angles) < 45.0, np.round(angles)


def test_detections_hold_what_the_standard_wants(heard):
    for message in heard["/head_detector/heads"]:
        for detection in message.detections:
            assert detection.header == message.header
            (result,) = detection.results
            assert result.hypothesis.class_id == "head"
            assert np.isfinite(result.hypothesis.score)
            assert result.pose.pose == detection.bbox.center
            q = detection.bbox.center.orientation
            assert np.hypot(np.hypot(q.x, q.y), np.hypot(q.z, q.w)) == pytest.approx(1.0, abs=1e-6)
            size = detection.bbox.size
            assert all(0.05 < edge < 0.5 for edge in (size.x, size.y, size.z))
            covariance = np.array(result.pose.covariance).reshape(6, 6)
            np.testing.assert_allclose(covariance, covariance.T, atol=1e-9)
            assert np.linalg.eigvalsh(covariance).min() >= -1e-9


def test_a_marker_that_was_shown_and_is_not_any_more_was_deleted(heard):
    shown: set[tuple[str, int]] = set()
    for message in heard["/head_detector/markers"]:
        added = {(m.ns, m.id) for m in message.markers if m.action == Marker.ADD}
        deleted = {(m.ns, m.id) for m in message.markers if m.action == Marker.DELETE}
        assert deleted == shown - added
        shown = added
    assert shown


def test_the_diagnostics_say_that_all_is_well(heard):
    levels = [message.status[0].level for message in heard["/diagnostics"]]
    assert DiagnosticStatus.OK in levels
    status = next(m.status[0] for m in heard["/diagnostics"] if m.status[0].level == DiagnosticStatus.OK)
    rows = {row.key: row.value for row in status.values}
    assert status.name == "head_detector"
    assert float(rows["latency_p50_ms"]) > 0.0
    assert rows["sensors_alive"] == "/left/depth/image_rect_raw, /right/depth/image_rect_raw"
    assert rows["bad_messages"] == rows["without_transform"] == "0"


def test_time_is_that_of_the_recording(heard):
    times = list(map(time_of, heard["/clock"]))
    assert times == sorted(times)
    assert set(times) == {stamp_of(message) for message in heard["/true_heads"]}


def test_the_fused_cloud_is_that_of_both_cameras(robot, start, sample, frames):
    robot.listen(PointCloud2, "/cloud_concatenate/cloud")
    node = start(
        "cloud_concatenate", CLOUDS, "target_frame:=world", "sync_wait_s:=0.5",
        "publish_reliability:=reliable", "rate_hz:=1.5",
    )  # fmt: skip
    robot.wait(lambda: robot.node.count_subscribers("/left/depth/points") > 0, START_S)
    player = start(
        "play_recording",
        f"recording:={sample}",
        "clock:=true",
        "loops:=1",
        "clouds:=true",
        "depths:=false",
        "rate_hz:=5.0",
        "delay_s:=3.0",
    )
    fused = robot.got["/cloud_concatenate/cloud"]
    robot.wait(lambda: len(fused) >= 3)
    player.wait()
    code, said = node.end()
    assert code == 0, said
    for message in fused[1:]:  # the first may come before the other camera is known
        assert message.header.frame_id == "world"
        frame = frames[stamp_of(message) * 5 // NS]
        points = np.frombuffer(message.data, np.float32).reshape(-1, 3)
        assert len(points) == sum(int((image.depth > 0).sum()) for image in frame.depths)
        assert np.isfinite(points).all()
    assert len(fused) < 16  # 1.5 of 5 a second
