"""Bags that headvox writes: read back by itself, and by the library of others with the definitions that are in them."""

import signal
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from headvox.commands.convert import convert
from headvox.config import DetectorConfig
from headvox.data import BadFrame, Cloud, DepthImage, Frame, Heads, Intrinsics
from headvox.errors import HeadvoxError
from headvox.pipeline import Detector
from headvox.ros.mcapfile import McapFile
from headvox.run import run
from headvox.sinks import Result, open_sink
from headvox.sources import open_source
from headvox.synth import mannequin, presets, record
from headvox.tracking.tracker import Tracker

STAMP = 1_700_000_000_123_456_789
POINTS = np.random.default_rng(0).uniform(-2, 2, (50, 3)).astype(np.float32)


class Listed:
    """Frames that are there already."""

    name = "listed"

    def __init__(self, *frames):
        self.frames, self.length = frames, len(frames)

    def __iter__(self):
        return iter(self.frames)

    def close(self):
        pass


class Kept:
    """A sink that keeps what is written."""

    def __init__(self):
        self.results = []

    def write(self, result):
        self.results.append(result)

    def close(self):
        pass


def read(path: Path) -> list:
    """Return (topic, stamp, message) of each message, decoded by the definitions in the file alone."""
    with AnyReader([path]) as reader:
        return [(c.topic, stamp, reader.deserialize(data, c.msgtype)) for c, stamp, data in reader.messages()]


def look_at(source) -> list[Result]:
    kept = Kept()
    with closing(source), closing(Detector(DetectorConfig(refine="sphere"))) as detector:
        run(source, detector, [kept], tracker=Tracker())
    return kept.results


def test_two_cameras_of_the_simulation_are_the_same_heads_through_a_bag(tmp_path):
    scene = presets.two_cameras(1, mannequin, duration_s=1.0, mode="d435i-small")
    folder = record.write_recording(tmp_path / "rig", scene, record.stamps(6, 10.0))
    direct = look_at(open_source(folder))
    assert convert(open_source(folder), tmp_path / "rig.mcap") == (6, 0)
    through = look_at(open_source(tmp_path / "rig.mcap"))
    assert sum(len(result.heads) for result in direct) >= 6
    assert [result.stamp_ns for result in through] == [result.stamp_ns for result in direct]
    for a, b in zip(direct, through, strict=True):
        for field in ("centres", "quaternions", "radii", "scores"):
            np.testing.assert_allclose(getattr(a.heads, field), getattr(b.heads, field), rtol=0, atol=1e-9)
        np.testing.assert_array_equal(a.tracks.ids, b.tracks.ids)
        np.testing.assert_allclose(a.tracks.centres, b.tracks.centres, rtol=0, atol=1e-9)


@pytest.mark.parametrize("stamp_ns", [-1, 2**31 * 10**9, 2**62])
def test_a_stamp_that_ros_cannot_have_is_explained(tmp_path, stamp_ns):
    with pytest.raises(HeadvoxError, match=rf"expected stamps from 0 to 2\^31 s.* got {stamp_ns} ns"):
        convert(Listed(Frame(0), Frame(stamp_ns)), tmp_path / "a.mcap")
    assert [stamp for _, stamp, _ in read(tmp_path / "a.mcap")] == [0]


def test_the_last_stamp_of_ros_comes_back(tmp_path):
    last = 2**31 * 10**9 - 1
    convert(Listed(Frame(last, (Cloud("x", POINTS, np.eye(4)),))), tmp_path / "a.mcap")
    assert [frame.stamp_ns for frame in open_source(tmp_path / "a.mcap")] == [last]


def test_cameras_whose_names_come_to_the_same_stay_apart(tmp_path):
    lens, names = Intrinsics(4, 3, 5.0, 6.0, 1.5, 1.0, 0.001), ["cam a", "cam_a", "左", "右"]
    values = {name: np.full((3, 4), 1000 + k, np.uint16) for k, name in enumerate(names)}

    def frame(k: int, seen: list[str]) -> Frame:
        return Frame(STAMP + k, (), tuple(DepthImage(name, values[name], lens, np.eye(4)) for name in seen))

    convert(Listed(frame(0, names[1:]), frame(1, names)), tmp_path / "a.mcap")  # the first one comes late
    first = {
        topic: m.data.view(np.uint16)[0] for topic, stamp, m in read(tmp_path / "a.mcap") if "image" in topic
    }
    topics = [f"/{name}/depth/image_rect_raw" for name in ("cam_a", "sensor", "sensor_2", "cam_a_2")]
    assert first == dict(zip(topics, [1001, 1002, 1003, 1000], strict=True))
    places = [m for topic, _, m in read(tmp_path / "a.mcap") if topic == "/tf"]
    assert len({place.child_frame_id for place in places[-1].transforms}) == 4


def test_clouds_and_other_scales_come_back(tmp_path):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], (1.0, 2.0, 3.0)
    values = np.arange(12, dtype=np.uint16).reshape(3, 4) * 100
    image = DepthImage("a b/ü", values, Intrinsics(4, 3, 5.0, 6.0, 1.5, 1.0, 0.0005), T)
    frame = Frame(STAMP, (Cloud("x.ply", POINTS, T),), (image,))
    assert convert(Listed(frame, BadFrame(STAMP, "no")), tmp_path / "a.mcap") == (2, 1)
    (back,) = open_source(tmp_path / "a.mcap")
    assert (back.stamp_ns, back.depths[0].name) == (STAMP, "/a_b/depth/image_rect_raw")
    np.testing.assert_array_equal(back.clouds[0].points, POINTS)
    np.testing.assert_allclose(back.clouds[0].T_world_sensor, T, atol=1e-15)
    np.testing.assert_array_equal(back.depths[0].depth, values // 2)
    convert(Listed(Frame(STAMP, (Cloud("x.ply", POINTS),))), tmp_path / "b.mcap")
    (back,) = open_source(tmp_path / "b.mcap")
    assert back.clouds[0].T_world_sensor is None
    np.testing.assert_array_equal(back.clouds[0].points, POINTS)


def heads_at(*centres) -> Heads:
    count = len(centres)
    turns = np.tile([0.0, 0.0, 0.6, 0.8], (count, 1))
    turns[1:] = np.nan
    return Heads(
        np.array(centres, dtype=float).reshape(-1, 3), turns, np.full(count, 0.1), np.full(count, 3.5)
    )


def test_heads_are_messages_that_anybody_can_read(tmp_path):
    sink = open_sink(tmp_path / "heads.mcap", frame="map")
    sink.write(Result(0, STAMP, 1.0, heads_at((1.0, 2.0, 1.7), (0.0, 0.0, 1.2))))
    sink.write(Result(1, STAMP + 5, 1.0, heads_at()))
    sink.close()
    sink.close()
    messages = read(tmp_path / "heads.mcap")
    assert [(topic, stamp) for topic, stamp, _ in messages] == [
        (topic, STAMP + late)
        for late in (0, 5)
        for topic in ("/head_detector/heads", "/head_detector/poses", "/head_detector/markers", "/tf")
    ]
    heads, poses, markers, _ = (message for _, _, message in messages[:4])
    header = heads.header
    assert (header.frame_id, header.stamp.sec, header.stamp.nanosec) == ("map", *divmod(STAMP, 10**9))
    first, second = heads.detections
    assert (first.bbox.center.position.x, first.bbox.center.position.y) == (1.0, 2.0)
    assert (first.bbox.size.x, first.results[0].hypothesis.score) == (0.2, 3.5)
    assert (first.results[0].hypothesis.class_id, first.id) == ("head", "")
    assert [first.bbox.center.orientation.z, second.bbox.center.orientation.w] == [0.6, 1.0]
    assert second.results[0].pose.covariance[35] == pytest.approx(np.pi**2)  # it is not known
    assert [pose.position.z for pose in poses.poses] == [1.7, 1.2]
    assert [(m.ns, m.type) for m in markers.markers] == [
        ("head", 1), ("label", 9), ("axis", 0), ("head", 2), ("label", 9),
    ]  # fmt: skip
    gone = messages[6][2].markers
    assert [m.action for m in gone] == [2] * 5
    assert messages[4][2].detections == []


def test_tracks_have_frames_of_their_own(tmp_path):
    tracker, sink = Tracker(), open_sink(tmp_path / "heads.mcap")
    for k in range(6):
        stamp = STAMP + k * 33_000_000
        frame = Frame(stamp, (Cloud("c", POINTS),))
        heads = heads_at((1.0 + 0.01 * k, 0.0, 1.7))
        sink.write(Result(k, stamp, 1.0, heads, tracker.update(heads, frame)))
    sink.close()
    messages = read(tmp_path / "heads.mcap")
    tracks = [message for topic, _, message in messages if topic == "/head_detector/tracks"]
    transforms = [t for topic, _, message in messages if topic == "/tf" for t in message.transforms]
    assert {track.child_frame_id for track in tracks} == {t.child_frame_id for t in transforms} == {"head_1"}
    assert len(tracks) >= 3
    assert tracks[-1].pose.pose.position.x == pytest.approx(1.05, abs=0.02)
    forward, left = tracks[-1].twist.twist.linear.x, tracks[-1].twist.twist.linear.y
    assert np.hypot(forward, left) == pytest.approx(0.3, abs=0.15)
    assert (abs(forward), abs(left)) == (
        pytest.approx(0.28 * np.hypot(forward, left), rel=0.1),
        -left,
    )  # its axes


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_run_that_is_interrupted_leaves_a_bag_that_can_be_read(tmp_path, monkeypatch, number):
    sink = open_sink(tmp_path / "heads.mcap")
    sink.write(Result(0, STAMP, 1.0, heads_at((1.0, 2.0, 1.7))))
    writer = sink._file._writer
    write = writer.add_message

    def interrupted(*arguments):
        signal.raise_signal(number)  # within a record
        write(*arguments)

    monkeypatch.setattr(writer, "add_message", interrupted)
    before = signal.signal(number, signal.default_int_handler)  # a job in the background ignores it
    try:
        with pytest.raises(KeyboardInterrupt):
            sink.write(Result(1, STAMP + 5, 1.0, heads_at((1.0, 2.0, 1.7))))
    finally:
        signal.signal(number, before)
    sink.close()
    assert [stamp for topic, stamp, _ in read(tmp_path / "heads.mcap") if topic == "/head_detector/heads"] == [
        STAMP, STAMP + 5,
    ]  # fmt: skip


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="/dev/full exists on Linux only")
def test_a_full_disk_is_told():
    file = McapFile(Path("/dev/full"))
    many = {"poses": [{} for _ in range(10_000)]}
    with pytest.raises(HeadvoxError, match="No space left"):
        file.write("/p", "geometry_msgs/msg/PoseArray", 0, many)
    file.close()


def test_a_field_that_is_none_is_a_mistake(tmp_path):
    with closing(McapFile(tmp_path / "a.mcap")) as file, pytest.raises(KeyError):
        file.write("/p", "geometry_msgs/msg/PoseArray", 0, {"posse": []})


def test_what_a_killed_run_has_written_can_be_recovered(tmp_path):
    sink = open_sink(tmp_path / "heads.mcap")
    for k in range(600):
        sink.write(Result(k, STAMP + k, 1.0, heads_at((1.0, 2.0, 1.7))))
    copy = tmp_path / "killed.mcap"
    copy.write_bytes((tmp_path / "heads.mcap").read_bytes())  # as it is on the disk now
    sink.close()
    with copy.open("rb") as file:
        chunks = [record for record in _records(file) if type(record).__name__ == "Chunk"]
    kept = sum(chunk.uncompressed_size for chunk in chunks)
    with (tmp_path / "heads.mcap").open("rb") as file:
        whole = sum(r.uncompressed_size for r in _records(file) if type(r).__name__ == "Chunk")
    assert len(chunks) >= 2
    assert whole - kept <= (256 << 10) + 10_000


def _records(file):
    from mcap.exceptions import EndOfFile
    from mcap.stream_reader import StreamReader

    try:
        yield from StreamReader(file, emit_chunks=True).records
    except EndOfFile:
        return
