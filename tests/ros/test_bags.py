"""Bags of every kind through the front door."""

import subprocess
import sys
import warnings
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from bag_writers import KINDS, NS, Maker, write_bag
from command import headvox

from headvox.data import BadFrame, Frame, Intrinsics
from headvox.errors import HeadvoxError, Undecided
from headvox.ros import bagfile
from headvox.sample import sample_folder
from headvox.sources import open_source
from headvox.sources.options import SourceOptions, mount

COMMAND = Path(sys.executable).with_name("headvox")
CAMERA = Intrinsics(32, 24, 30.0, 31.0, 15.5, 11.5)
START = 1_700_000_000 * NS
STEP = 100_000_000
POINTS = np.random.default_rng(0).uniform(-2, 2, (50, 3)).astype(np.float32)
LEFT, RIGHT = mount(-2.0, 0.0, 1.65, 0.0, 10.0, 0.0), mount(2.0, 0.5, 1.5, 0.0, 0.0, 180.0)
OPTICAL = mount(0, 0, 0, -90.0, 0.0, -90.0)  # as every URDF has it


def depth_of(frame: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng([frame, seed]).integers(0, 4000, (24, 32)).astype(np.uint16)


def rig(maker: Maker, frames: int = 3, moving: bool = False) -> list:
    """Two depth cameras: world -> base_link (that may move) -> NAME_link -> NAME_optical."""
    messages = []
    for name, T in (("left", LEFT), ("right", RIGHT)):
        messages.append(("/tf_static", START, maker.transform(0, "base_link", f"{name}_link", T)))
        messages.append(("/tf_static", START, maker.transform(0, f"{name}_link", f"{name}_optical", OPTICAL)))
    for k in range(frames):
        stamp = START + k * STEP
        for seed, name in enumerate(("left", "right")):
            late = stamp + seed * 3_000_000
            arrived = late + 20_000_000
            image, info = (
                maker.depth(late, f"{name}_optical", depth_of(k, seed)),
                maker.info(late, f"{name}_optical", CAMERA),
            )
            messages += [
                (f"/{name}/depth/camera_info", arrived, info),
                (f"/{name}/depth/image_rect_raw", arrived, image),
            ]
        if moving:  # told after the images, as it is in life
            T = mount(0.1 * k, 0, 0, 0, 0, 0)
            messages.append(("/tf", stamp + 40_000_000, maker.transform(stamp, "map", "base_link", T)))
    return messages


_opened: list = []


@pytest.fixture(autouse=True)
def _close():
    yield
    while _opened:
        _opened.pop().close()


def opened(place: Path, **options: object):
    notes: list[str] = []
    _opened.append(open_source(place, SourceOptions(**options), notes.append))
    return _opened[-1], notes


@pytest.mark.parametrize("kind", KINDS)
def test_two_cameras_of_any_kind_of_bag(tmp_path, kind):
    place = write_bag(tmp_path, kind, rig(Maker(kind.startswith("ros1"))))
    if place.is_file():  # its name means nothing
        place = place.rename(tmp_path / "thing.ply")
    source, notes = opened(place)
    with closing(source):
        frames = list(source)
    assert (notes, source.length) == ([], None)
    assert [frame.stamp_ns for frame in frames] == [START + k * STEP + 3_000_000 for k in range(3)]
    for k, frame in enumerate(frames):
        left, right = frame.depths
        assert (left.name, right.name) == ("/left/depth/image_rect_raw", "/right/depth/image_rect_raw")
        np.testing.assert_array_equal(left.depth, depth_of(k, 0))
        np.testing.assert_array_equal(right.depth, depth_of(k, 1))
        assert left.intrinsics == CAMERA
        np.testing.assert_allclose(left.T_world_camera, LEFT @ OPTICAL, atol=1e-12)
        np.testing.assert_allclose(right.T_world_camera, RIGHT @ OPTICAL, atol=1e-12)


def test_the_z_of_the_earth_points_to_the_pole_so_heads_are_in_the_map(tmp_path):
    maker, T = Maker(), mount(4.7e6, 1.7e5, 4.2e6, 0, 0, 0)
    messages = [("/tf_static", START, maker.transform(0, "earth", "map", T))]
    messages.append(("/tf_static", START, maker.transform(0, "map", "base_link", np.eye(4))))
    source, notes = opened(write_bag(tmp_path, "mcap", messages + rig(maker)))
    assert "heads are in the frame 'map'" in notes[0]
    assert "earth" in notes[0]  # for --frame
    np.testing.assert_allclose(next(iter(source)).depths[0].T_world_camera, LEFT @ OPTICAL, atol=1e-12)


def test_a_moving_robot_is_placed_by_transforms_that_come_after_the_image(tmp_path):
    source, notes = opened(write_bag(tmp_path, "mcap", rig(Maker(), 6, moving=True)))
    *frames, last = source
    assert "heads are in the frame 'map'" in notes[0]
    assert "base_link" in notes[0]
    for k, frame in enumerate(frames):
        left, right = frame.depths
        assert left.T_world_camera[0, 3] == pytest.approx(-2.0 + 0.1 * k)
        assert right.T_world_camera[0, 3] == pytest.approx(
            2.0 + 0.1 * (k + 0.03)
        )  # 3 ms later, between two of them
    assert len(frames) == 5
    assert isinstance(
        last, BadFrame
    )  # nothing tells where the second camera was 3 ms after the last transform
    assert "older than the reading" in last.reason
    source, _ = opened(tmp_path / "rig", frame="base_link")
    assert all(frame.depths[0].T_world_camera[0, 3] == pytest.approx(-2.0) for frame in source)


@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("organised", [False, True])
def test_clouds_of_any_layout(tmp_path, dtype, big, organised):
    maker = Maker()
    points = POINTS.reshape(5, 10, 3) if organised else POINTS
    cloud = maker.cloud(START, "/lidar", points, dtype=dtype, big=big, gap=5, padding=7)
    T = mount(0, 0, 1, 0, 20, 90)
    messages = [("/tf_static", START, maker.transform(0, "world", "lidar", T)), ("/points", START, cloud)]
    ((frame),) = opened(write_bag(tmp_path, "mcap", messages))[0]
    (read,) = frame.clouds
    np.testing.assert_array_equal(read.points, POINTS)
    np.testing.assert_allclose(read.T_world_sensor, T, atol=1e-12)


def test_depth_in_metres(tmp_path):
    maker = Maker()
    metres = (depth_of(0) / np.float32(1000.0)).astype(np.float32)
    messages = [
        ("/tf_static", START, maker.transform(0, "world", "cam_optical", LEFT @ OPTICAL)),
        ("/cam/depth/camera_info", START, maker.info(START, "cam_optical", CAMERA)),
        ("/cam/depth/image", START, maker.depth(START, "cam_optical", metres)),
    ]
    (frame,) = opened(write_bag(tmp_path, "db3", messages))[0]
    np.testing.assert_array_equal(frame.depths[0].depth, depth_of(0))


def test_one_sensor_without_transforms_is_placed_as_it_is_said(tmp_path):
    maker = Maker()
    messages = [
        ("/cam/depth/camera_info", START, maker.info(START, "cam_optical", CAMERA)),
        *(
            ("/cam/depth/image", START + k, maker.depth(START + k, "cam_optical", depth_of(k)))
            for k in range(4)
        ),
    ]
    place = write_bag(tmp_path, "mcap", messages)
    source, notes = opened(place)
    assert source.length == 4
    (note,) = notes
    assert "1.2 m above the floor and to look level: say otherwise with --mount" in note
    level = mount(0, 0, 1.2, 0, 0, 0) @ OPTICAL
    np.testing.assert_allclose(next(iter(source)).depths[0].T_world_camera, level, atol=1e-12)
    source, notes = opened(place, T_world_mount=LEFT)
    assert notes == []
    np.testing.assert_allclose(next(iter(source)).depths[0].T_world_camera, LEFT @ OPTICAL, atol=1e-12)
    with pytest.warns(UserWarning, match="1.2 m above the floor"):  # a library says it, too
        open_source(place).close()


def test_a_driver_that_ends_at_its_own_link(tmp_path):
    maker = Maker()
    messages = [
        ("/tf_static", START, maker.transform(0, "camera_link", "cam_optical", OPTICAL)),
        ("/cam/points", START, maker.cloud(START, "cam_optical", POINTS)),
    ]
    place = write_bag(tmp_path, "mcap", messages)
    source, notes = opened(place)
    assert "no transform leads to the world; the frame 'camera_link' is taken to stand 1.2 m" in notes[0]
    np.testing.assert_allclose(
        next(iter(source)).clouds[0].T_world_sensor, mount(0, 0, 1.2, 0, 0, 0) @ OPTICAL, atol=1e-12
    )
    source, notes = opened(place, T_world_mount=RIGHT)
    np.testing.assert_allclose(next(iter(source)).clouds[0].T_world_sensor, RIGHT @ OPTICAL, atol=1e-12)


def test_points_in_the_world_need_no_sensor(tmp_path):
    place = write_bag(tmp_path, "mcap", [("/fused", START, Maker().cloud(START, "map", POINTS))])
    source, notes = opened(place)
    (frame,) = source
    assert frame.clouds[0].T_world_sensor is None
    assert notes == []


@pytest.mark.parametrize("is_ros1", [False, True])
def test_distortion_is_told_once(tmp_path, is_ros1):
    maker = Maker(is_ros1)
    info = maker.info(START, "cam_optical", CAMERA)
    (info.D if is_ros1 else info.d)[:2] = -0.3, 0.1
    (info.P if is_ros1 else info.p)[:] = 0.0
    world = [("/tf_static", START, maker.transform(0, "world", "cam_optical", LEFT @ OPTICAL))]
    for name, told in (("image_raw", 1), ("image_rect", 0)):
        images = [
            (f"/cam/depth/{name}", START + k, maker.depth(START + k, "cam_optical", depth_of(k)))
            for k in range(3)
        ]
        messages = [*world, ("/cam/depth/camera_info", START, info), *images]
        source, notes = opened(write_bag(tmp_path, "ros1" if is_ros1 else "mcap", messages, name))
        assert all(frame.depths[0].intrinsics == CAMERA for frame in source)
        assert len(notes) == told
        assert all("/cam/depth/image_raw: its camera_info has distortion" in note for note in notes)


def test_the_stamps_of_the_recorder_stand_in_for_none(tmp_path):
    maker = Maker()
    messages = [("/fused", START + k * STEP, maker.cloud(0, "map", POINTS)) for k in range(3)]
    frames = list(opened(write_bag(tmp_path, "mcap", messages))[0])
    assert [frame.stamp_ns for frame in frames] == [START + k * STEP for k in range(3)]


def test_a_batch_and_an_evaluation_tell_what_is_assumed_and_what_is_to_be_chosen(tmp_path):
    maker = Maker()
    cloud = ("/cam/points", START, maker.cloud(START, "camera_link", POINTS))
    another = ("/left/depth/points", START, maker.cloud(START, "left_optical", POINTS))
    assumed = write_bag(tmp_path, "bare-mcap", [cloud], "assumed")
    several = write_bag(tmp_path, "bare-mcap", [*rig(maker), another], "several")
    done = headvox("run", assumed, several, "--into", tmp_path / "out", "--no-track")
    assert "headvox: assumed: " in done.stderr
    assert "is taken to stand 1.2 m above the floor" in done.stderr
    assert "    --topic /left/depth/points  cloud, 50 points" in done.stderr.splitlines()
    (tmp_path / "heads.jsonl").write_text(f'{{"stamp_ns": {START}, "heads": []}}\n')
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        done = headvox("eval", assumed, "--no-track")
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("is taken to stand 1.2 m above the floor") == 1


# ------------------------------------------------------------------------------------------------------ in doubt


def chosen(place: Path, **options: object) -> Undecided:
    with pytest.raises(Undecided) as refused:
        opened(place, **options)
    assert "\n" not in str(refused.value)
    assert not any("\n" in choice for choice in refused.value.choices)
    return refused.value


def test_a_depth_image_and_its_own_cloud_are_to_be_chosen_from(tmp_path):
    maker = Maker()
    messages = [*rig(maker), ("/left/depth/points", START, maker.cloud(START, "left_optical", POINTS))]
    place = write_bag(tmp_path, "mcap", messages)
    error = chosen(place)
    assert "/left/depth/image_rect_raw and /left/depth/points are of one sensor" in error.what
    assert "--topic /left/depth/points  cloud, 50 points" in error.choices
    source, _ = opened(place, topics=("/left/depth/points",))
    assert len(next(iter(source)).clouds) == 1
    aligned = ("/right/aligned/image_raw", START, maker.depth(START, "right_colour", depth_of(0)))
    info = ("/right/aligned/camera_info", START, maker.info(START, "right_colour", CAMERA))
    nudged = maker.transform(0, "right_optical", "right_colour", mount(0.015, 0, 0, 0.2, 0, 0))
    place = write_bag(
        tmp_path, "mcap", [*rig(maker), aligned, info, ("/tf_static", START, nudged)], "aligned"
    )
    assert "/right/aligned/image_raw and /right/depth/image_rect_raw are of one sensor" in chosen(place).what


def test_what_transforms_do_not_connect_is_refused(tmp_path):
    messages = [message for message in rig(Maker()) if message[0] != "/tf_static"]
    place = write_bag(tmp_path, "mcap", messages)
    error = chosen(place)
    assert "do not connect the 2 sensors" in error.what
    assert error.choices[0] == "/left/depth/image_rect_raw: left_optical"
    assert len(opened(place, topics=("/left/depth/image_rect_raw",))[1]) == 1


def test_a_world_that_nobody_knows_is_refused(tmp_path):
    maker = Maker()
    messages = [
        (topic, logged, maker.transform(0, "table", f"{name}_optical", T @ OPTICAL))
        for topic, logged, name, T in (
            ("/tf_static", START, "left", LEFT),
            ("/tf_static", START, "right", RIGHT),
        )
    ] + [message for message in rig(maker) if message[0] != "/tf_static"]
    place = write_bag(tmp_path, "mcap", messages)
    error = chosen(place)
    assert "none of the frames is plainly the world" in error.what
    assert "left_optical in table" in error.choices[0]
    frame = next(iter(opened(place, frame="table")[0]))
    np.testing.assert_allclose(frame.depths[1].T_world_camera, RIGHT @ OPTICAL, atol=1e-12)
    raised = mount(0, 0, 0.7, 0, 0, 0)
    frame = next(iter(opened(place, frame="table", T_world_mount=raised)[0]))
    np.testing.assert_allclose(frame.depths[1].T_world_camera, raised @ RIGHT @ OPTICAL, atol=1e-12)
    assert "is not connected with 'moon'" in chosen(place, frame="moon").what


def test_a_bag_without_sensors_tells_what_is_in_it(tmp_path):
    maker = Maker()
    colour = maker.depth(START, "cam", depth_of(0), encoding="mono16")
    messages = [("/infra/image", START, colour), ("/tf", START, maker.transform(0, "a", "b", LEFT))]
    place = write_bag(tmp_path, "mcap", messages)
    assert chosen(place).choices == ("--topic /infra/image  sensor_msgs/msg/Image, 1 messages",)
    assert "there is no topic /x with images or clouds" in chosen(place, topics=("/x",)).what
    with pytest.raises(HeadvoxError, match="there is no CameraInfo of its frame and size"):
        opened(place, topics=("/infra/image",))


# -------------------------------------------------------------------------------------------------------- damage


def test_garbage_among_messages_is_bad_frames(tmp_path):
    maker = Maker()
    messages = [message for message in rig(maker, 8) if not message[0].startswith("/right")]
    at = [n for n, message in enumerate(messages) if message[0] == "/left/depth/image_rect_raw"]
    small = maker.depth(START + 3 * STEP, "left_optical", depth_of(3)[:12])
    lost = maker.depth(START + 4 * STEP, "nowhere", depth_of(4))
    short = maker.depth(START + 6 * STEP, "left_optical", depth_of(5))
    short.height = 100_000
    again = messages[at[5]][2]
    for n, content in (
        (at[2], b"\x00\x01\x00\x00garbage"),
        (at[3], small),
        (at[4], lost),
        (at[6], short),
        (at[7], again),
    ):
        messages[n] = (messages[n][0], messages[n][1], content)
    frames = list(opened(write_bag(tmp_path, "mcap", messages))[0])
    reasons = [frame.reason if isinstance(frame, BadFrame) else "" for frame in frames]
    words = [
        "",
        "",
        "is damaged",
        "32 x 12",
        "'nowhere' is not in the transform tree",
        "",
        "its header says",
        "stamp",
    ]
    assert [bool(reason) for reason in reasons] == [bool(word) for word in words]
    assert [word for word, reason in zip(words, reasons, strict=True) if word not in reason] == []
    assert not any("\n" in reason for reason in reasons)


@pytest.mark.parametrize(
    "kind", ["ros1", "ros1-lz4", "db3", "db3-message", "db3-file", "mcap-storage", "bare-mcap-flat"]
)
def test_a_damaged_bag_is_read_or_refused(tmp_path, kind):
    place = write_bag(tmp_path, kind, rig(Maker(kind.startswith("ros1")), 4))
    file = max((path for path in tmp_path.rglob("*") if path.is_file()), key=lambda path: path.stat().st_size)
    good = file.read_bytes()
    rng = np.random.default_rng(1)
    outcomes = set()
    for trial in range(40):
        data = bytearray(good)
        if trial < 12:
            del data[int(len(data) * trial / 12) :]
        else:
            for at in rng.integers(0, len(data), 8):
                data[at] = rng.integers(256)
        file.write_bytes(data)
        try:
            source, _ = opened(place)
            with closing(source):
                frames = list(source)
            outcomes |= {type(frame) for frame in frames}
        except HeadvoxError as error:
            outcomes.add(HeadvoxError if "\n" not in str(error) else "several lines")
    assert "several lines" not in outcomes
    assert HeadvoxError in outcomes
    assert Frame in outcomes or kind in ("db3-file", "mcap-storage")


@pytest.mark.parametrize("moving", [False, True])
def test_frames_before_a_damaged_chunk_are_read(tmp_path, moving):
    messages = rig(Maker(), 6, moving=moving)
    place = write_bag(tmp_path, "bare-mcap-zstd", messages, chunk_bytes=16 << 10)
    data = bytearray(place.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 40] = bytes(40)
    place.write_bytes(data)
    source, notes = opened(place)
    assert sum("is damaged" in note and "mcap recover" in note for note in notes) == moving
    *frames, last = source
    assert 1 <= sum(isinstance(frame, Frame) for frame in frames) < 6
    assert isinstance(last, BadFrame)
    assert "the bag is damaged" in last.reason


def test_a_transform_that_is_damaged_refuses_no_bag(tmp_path):
    messages = [*rig(Maker()), ("/tf_static", START, b"\x00\x01\x00\x00garbage")]
    assert len(list(opened(write_bag(tmp_path, "mcap", messages))[0])) == 3


def test_a_small_bag_cannot_fill_the_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(bagfile, "MOST_UNPACKED_BYTES", 1 << 20)
    monkeypatch.setattr(bagfile, "_MOST_EXPANSION", 1)
    maker = Maker()
    vast = maker.cloud(START, "map", np.zeros((200_000, 3), np.float32))
    for kind in ("db3-message", "db3-file", "mcap-storage", "bare-mcap-lz4", "bare-mcap-zstd"):
        place = write_bag(tmp_path, kind, [("/fused", START, vast)], kind)
        assert sum(path.stat().st_size for path in [place, *place.rglob("*")] if path.is_file()) < 100_000
        with pytest.raises(HeadvoxError, match="more than"):
            list(opened(place)[0])
    place = write_bag(
        tmp_path, "ros1-bz2", [("/fused", START, Maker(True).cloud(START, "map", np.zeros((200_000, 3))))]
    )
    with pytest.raises(HeadvoxError, match="more than"):
        opened(place)


@pytest.mark.parametrize("at_once", [1, 7, 1000, 1 << 20])
def test_what_is_unpacked_in_pieces_is_whole(monkeypatch, at_once):
    import bz2

    import lz4.frame
    from rosbags.rosbag2 import writer

    monkeypatch.setattr(bagfile, "_AT_ONCE", at_once)
    data = np.random.default_rng(0).integers(0, 9, 3000, dtype=np.uint8).tobytes()
    for pack, unpacker in (
        (bz2.compress, bz2.BZ2Decompressor),
        (lz4.frame.compress, lz4.frame.LZ4FrameDecompressor),
        (writer.zstd.compress, writer.zstd.ZstdDecompressor),
    ):
        assert bagfile.bounded(unpacker(), pack(data)) == data
        assert bagfile.bounded(unpacker(), pack(data), 3000) == data
        with pytest.raises(ValueError, match="more than 2999"):
            bagfile.bounded(unpacker(), pack(data), 2999)
        with pytest.raises(ValueError, match="cut off"):
            bagfile.bounded(unpacker(), pack(data)[:-20])


def test_an_mcap_that_was_not_closed_says_so(tmp_path):
    place = write_bag(tmp_path, "bare-mcap", rig(Maker()))
    place.write_bytes(place.read_bytes()[:-2000])
    with pytest.raises(HeadvoxError, match=r"was not closed when it was recorded.* mcap recover"):
        opened(place)


def test_a_bag_of_nothing_but_its_first_bytes_ends_too_early(tmp_path):
    (tmp_path / "magic.mcap").write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(
        HeadvoxError, match=r"magic\.mcap: the bag is damaged: it ends too early\. .* mcap recover"
    ):
        opened(tmp_path / "magic.mcap")


def test_a_bag_is_read_once(tmp_path):
    source, _ = opened(write_bag(tmp_path, "bare-mcap", rig(Maker())))
    assert len(list(source)) == 3
    with pytest.raises(HeadvoxError, match=r"is read once, and is closed then\. Open it again\."):
        next(iter(source))


def test_a_bag_that_is_closed_meanwhile_just_ends(tmp_path):
    source, _ = opened(write_bag(tmp_path, "bare-mcap-flat", rig(Maker(), 9)))
    frames = []
    for frame in source:
        frames.append(frame)
        source.close()
    assert [type(frame) for frame in frames] == [Frame]


def test_the_package_to_install_is_named(tmp_path, monkeypatch):
    place = write_bag(tmp_path, "bare-mcap", rig(Maker()))
    monkeypatch.setattr(bagfile, "_loaded", [])
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(HeadvoxError, match=r"pip install 'headvox\[bag\]'"):
        opened(place)


# ------------------------------------------------------------------------------------------------------ the command


def test_the_command_exits_with_two_when_in_doubt(tmp_path):
    maker = Maker()
    messages = [*rig(maker), ("/left/depth/points", START, maker.cloud(START, "left_optical", POINTS))]
    place = write_bag(tmp_path, "mcap", messages)
    for command in ("run", "info"):
        done = subprocess.run([COMMAND, command, place], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout) == (2, "")
        assert "--topic /left/depth/points  cloud, 50 points" in done.stderr
    done = subprocess.run(
        [COMMAND, "info", place, "--topic", "/left/depth/points"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0
    assert "reads /left/depth/points" in done.stdout
    assert "frame 'base_link'" in done.stdout


def test_options_of_bags_are_refused_elsewhere():
    for unused in (SourceOptions(frame="world"), SourceOptions(T_world_mount=mount(0, 0, 1, 0, 0, 0))):
        with pytest.raises(HeadvoxError, match="for bags"):
            open_source(sample_folder(), unused)
