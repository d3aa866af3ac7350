"""RealSense without a camera: devices in software, and the SDK's own playback of what they recorded."""

import json
import subprocess
import sys
import threading
import time
from contextlib import closing

import numpy as np
import pytest

from headvox.calibrate.command import extrinsics_text
from headvox.data import Frame, Intrinsics
from headvox.errors import HeadvoxError, Undecided
from headvox.sources import open_source, realsense
from headvox.sources.describe import describe
from headvox.sources.extrinsics import read_extrinsics
from headvox.sources.options import SourceOptions, mount, mounted

rs = pytest.importorskip(
    "pyrealsense2",
    reason="pyrealsense2 does not load here: there is none for this machine, or libusb is missing",
    exc_type=ImportError,
)

WIDTH, HEIGHT = 64, 48
START_MS = 1_700_000_000_000.0
T = mount(1.0, 2.0, 1.5, 0.0, 20.0, 90.0)


class SoftCamera:
    """A camera whose images a test makes: every pixel of image k is 1000 + k."""

    def __init__(self, serial: str) -> None:
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, "soft")
        self.device.register_info(rs.camera_info.serial_number, serial)
        self.sensor = self.device.add_sensor("Depth")
        lens = rs.intrinsics()
        lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = WIDTH, HEIGHT, 60.0, 61.0, 31.5, 23.5
        lens.model, lens.coeffs = rs.distortion.none, [0.0] * 5
        stream = rs.video_stream()
        stream.type, stream.index, stream.uid, stream.fmt = rs.stream.depth, 0, int(serial), rs.format.z16
        stream.width, stream.height, stream.fps, stream.bpp, stream.intrinsics = WIDTH, HEIGHT, 30, 2, lens
        self.profile = self.sensor.add_video_stream(stream)
        self.sensor.add_read_only_option(rs.option.depth_units, 0.001)
        self.kept: list[np.ndarray] = []

    def shoot(self, k: int, late_ms: float = 0.0) -> None:
        self.kept.append(np.full((HEIGHT, WIDTH), 1000 + k, np.uint16))
        image = rs.software_video_frame()
        image.pixels, image.stride, image.bpp = self.kept[-1], 2 * WIDTH, 2
        image.timestamp, image.domain = START_MS + 100.0 * k + late_ms, rs.timestamp_domain.system_time
        image.frame_number, image.profile, image.depth_units = (
            k + 1,
            self.profile.as_video_stream_profile(),
            0.001,
        )
        self.sensor.on_video_frame(image)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("realsense") / "soft.db3"
    camera = SoftCamera("123")
    recorder = rs.recorder(str(path), camera.device)
    (sensor,) = recorder.query_sensors()
    sensor.open(sensor.get_stream_profiles()[0])
    sensor.start(rs.frame_queue(50))
    for k in range(40):
        camera.shoot(k)
        time.sleep(0.005)  # the recorder drops what comes at once
    sensor.stop()
    sensor.close()
    return path


def live(*cameras: SoftCamera, notes: list[str] | None = None, serials=(), **options: object):
    say = [].append if notes is None else notes.append
    devices = [camera.device for camera in cameras]
    return realsense.RealSenseLive(serials, SourceOptions(**options), say, devices)


def test_a_recording_of_the_sdk_is_played_whole_by_the_real_pipeline(recorded):
    notes: list[str] = []
    with closing(open_source(recorded, None, notes.append)) as source:
        frames = []
        for frame in source:
            frames.append(frame)
            time.sleep(0.002 * (len(frames) % 7 == 0))  # a reader that is slow now and then
    assert len(frames) == 40
    for k, frame in enumerate(frames):
        assert isinstance(frame, Frame)
        assert frame.stamp_ns == pytest.approx((START_MS + 100.0 * k) * 1e6, abs=1e3)
        (image,) = frame.depths
        assert (image.depth == 1000 + k).all()
        assert image.intrinsics == Intrinsics(WIDTH, HEIGHT, 60.0, 61.0, 31.5, 23.5, 0.001)
    assert "the camera is taken to stand 1.2 m above the floor" in notes[0]
    np.testing.assert_allclose(frames[0].depths[0].T_world_camera, mounted(mount(0, 0, 1.2, 0, 0, 0), True))


def test_a_machine_that_is_slow_to_start_loses_no_image(recorded, monkeypatch):
    class Slow(rs.pipeline):
        def start(self, config):
            started = super().start(config)
            time.sleep(0.5)  # five images long
            return started

    monkeypatch.setattr(rs, "pipeline", Slow)
    with closing(open_source(recorded, None, [].append)) as source:
        assert [int(frame.depths[0].depth[0, 0]) - 1000 for frame in source] == list(range(40))


def test_info_tells_what_is_in_a_recording(recorded):
    rows = dict(describe(recorded, SourceOptions(T_world_mount=T)))
    assert (rows["kind"], rows["camera"]) == ("RealSense recording", "123, 64x48")
    assert rows["looked at"] == "the first 10 frames, 0 of them cannot be read"
    assert rows["camera depth"] == "1.50 m above the floor at x 1.00 y 2.00 m, tilted 20.0° down"


def test_where_it_stood_can_be_said(recorded):
    notes: list[str] = []
    with closing(open_source(recorded, SourceOptions(T_world_mount=T), notes.append)) as source:
        frame = next(iter(source))
    assert notes == []
    np.testing.assert_allclose(frame.depths[0].T_world_camera, mounted(T, True))


def test_a_recording_that_is_cut_off_is_refused_or_read(recorded, tmp_path):
    data = recorded.read_bytes()
    for share in (0.3, 0.7):
        path = tmp_path / f"{share}.db3"
        path.write_bytes(data[: int(share * len(data))])
        with pytest.raises(HeadvoxError) as refused:
            list(open_source(path, None, [].append))
        assert "\n" not in str(refused.value)


def test_the_package_to_install_is_named(recorded, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(HeadvoxError, match=r"pip install 'headvox\[realsense\]'"):
        open_source(recorded)
    with pytest.raises(HeadvoxError, match=r"pip install 'headvox\[realsense\]'"):
        open_source("realsense:")


# ---------------------------------------------------------------------------------------------------------- live


def test_one_camera_live():
    camera, notes = SoftCamera("7"), []
    with closing(live(camera, notes=notes)) as source:
        frames = iter(source)
        for k in range(5):
            camera.shoot(k)
            frame = next(frames)
            assert frame.stamp_ns == pytest.approx((START_MS + 100.0 * k) * 1e6, abs=1e3)
            assert (frame.depths[0].depth == 1000 + k).all()
    assert list(frames) == []
    assert "1.2 m above the floor" in notes[0]
    source.close()


def test_the_newest_images_win():
    camera = SoftCamera("7")
    with closing(live(camera)) as source:
        for k in range(20):
            camera.shoot(k)
            time.sleep(0.005)
        frame = next(iter(source))
    assert (frame.depths[0].depth == 1019).all()


def test_images_of_two_cameras_are_put_together_by_their_stamps(tmp_path):
    left, right = SoftCamera("1"), SoftCamera("2")
    file = tmp_path / "rig.toml"
    matrix = mounted(T, True).tolist()
    file.write_text(f"[cameras.1]\nmount = [0, 0, 2, 0, 30, 0]\n[cameras.2]\nT_world_camera = {matrix}\n")
    with closing(live(left, right, extrinsics=str(file))) as source:
        frames = iter(source)
        for k in range(4):
            left.shoot(k)
            right.shoot(k, late_ms=5.0)
            frame = next(frames)
            assert [image.name for image in frame.depths] == ["1", "2"]
            assert all((image.depth == 1000 + k).all() for image in frame.depths)
            assert frame.stamp_ns == pytest.approx((START_MS + 100.0 * k + 5.0) * 1e6, abs=1e3)
        np.testing.assert_allclose(frame.depths[0].T_world_camera, mounted(mount(0, 0, 2, 0, 30, 0), True))
        np.testing.assert_allclose(frame.depths[1].T_world_camera, mounted(T, True))


def test_a_camera_that_gives_nothing_or_is_unplugged_is_told(monkeypatch):
    monkeypatch.setattr(realsense, "FIRST_FRAME_S", 0.4)
    monkeypatch.setattr(realsense, "SILENT_S", 0.2)
    camera = SoftCamera("7")
    begun = time.monotonic()
    with closing(live(camera)) as source, pytest.raises(HeadvoxError, match="camera 7 gives no images"):
        next(iter(source))
    assert 0.35 < time.monotonic() - begun < 5.0
    camera = SoftCamera("7")
    with closing(live(camera)) as source:
        frames = iter(source)
        camera.shoot(0)
        next(frames)
        with pytest.raises(HeadvoxError, match="Is it plugged in"):
            next(frames)


def test_closing_lets_a_waiting_reader_go():
    source = live(SoftCamera("7"))
    threading.Timer(0.2, source.close).start()
    assert list(source) == []


def test_what_is_not_plugged_in_is_told(tmp_path):
    with pytest.raises(HeadvoxError, match="no RealSense camera is plugged in"):
        live()
    with pytest.raises(HeadvoxError, match=r"there is no camera 9.* Plugged in: 7"):
        live(SoftCamera("7"), serials=["9"])
    with pytest.raises(Undecided, match="there are 2 cameras, and nothing tells where they stand") as refused:
        live(SoftCamera("7"), SoftCamera("8"))
    assert refused.value.choices == ("realsense:7", "realsense:8")
    file = tmp_path / "one.json"
    file.write_text(json.dumps({"cameras": {"7": {"mount": [0, 0, 1, 0, 0, 0]}}}))
    with pytest.raises(HeadvoxError, match="camera 8 is not in it"):
        live(SoftCamera("7"), SoftCamera("8"), serials=["7", "8"], extrinsics=str(file))


@pytest.mark.skipif(
    len(rs.context().query_devices()) > 0, reason="a RealSense camera is plugged in: it would run"
)
def test_the_command_without_a_camera_ends_with_one():
    done = subprocess.run(
        [sys.executable, "-m", "headvox", "run", "realsense:"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert "no RealSense camera is plugged in" in done.stderr
    assert (done.returncode, done.stdout) == (1, "")


# ---------------------------------------------------------------------------------------------------- extrinsics


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "a table 'cameras'"),
        ("cameras = 3", "a table 'cameras'"),
        ("[cameras", "neither TOML nor JSON"),
        ("{nonsense", "neither TOML nor JSON"),
        ("[cameras.1]", "expected T_world_camera or mount, got nothing"),
        ("[cameras.1]\nmount = [1, 2, 3]", "six numbers"),
        ("[cameras.1]\nmount = [1, 2, 3, 'a', 0, 0]", "six numbers"),
        ("[cameras.1]\nmount = [nan, 2, 3, 0, 0, 0]", "camera 1"),
        ("[cameras.1]\nmount = [0, 0, 0, 0, 0, 0]\nmout = 3", "got mount, mout"),
        ("[cameras.1]\nT_world_camera = [[1, 0], [0, 1]]", "4x4"),
        ("[cameras.1]\nT_world_camera = [[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]", "not a rotation"),
    ],
)
def test_extrinsics_that_cannot_be_used_are_refused(tmp_path, text, message):
    (tmp_path / "rig").write_text(text)
    with pytest.raises(HeadvoxError, match=message) as refused:
        read_extrinsics(str(tmp_path / "rig"))
    assert "\n" not in str(refused.value)


def test_a_byte_order_mark_is_no_part_of_extrinsics(tmp_path):
    text = extrinsics_text({"1": np.eye(4)})
    (tmp_path / "rig").write_text(text, "utf-8-sig")
    assert list(read_extrinsics(str(tmp_path / "rig"))) == ["1"]


def test_extrinsics_that_are_not_there_are_refused(tmp_path):
    with pytest.raises(HeadvoxError, match="No such file"):
        read_extrinsics(str(tmp_path / "rig"))


def test_a_bag_of_the_sdk_goes_to_the_sdk(tmp_path):
    """Those of its older versions are bags of ROS 1; this one is too small for it."""
    rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="rosbags is not installed")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    with rosbag1.Writer(tmp_path / "sdk.bag") as writer:
        for topic in ("/file_version", "/device_0/sensor_0/info"):
            number = writer.add_connection(topic, "std_msgs/msg/UInt32", typestore=store)
            content = store.types["std_msgs/msg/UInt32"](2)
            writer.write(number, 1, store.serialize_ros1(content, "std_msgs/msg/UInt32"))
    with pytest.raises(HeadvoxError, match=r"sdk\.bag: .* Has it a depth stream") as refused:
        open_source(tmp_path / "sdk.bag")
    assert "\n" not in str(refused.value)
