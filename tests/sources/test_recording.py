import json
import os
import re

import numpy as np
import pytest
from cloud_writers import IDENTITY, camera, depth_image, png, recording, write_json
from PIL import Image

from headvox.data import BadFrame, Frame, Intrinsics
from headvox.errors import HeadvoxError
from headvox.sources import open_source
from headvox.sources.recording import decode_depth

LIFTED = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 2.5], [0, 0, 0, 1]]


def test_reads_every_frame_with_the_cameras_it_has(tmp_path):
    recording(tmp_path)
    source = open_source(tmp_path)
    frames = list(source)
    assert (source.name, source.length) == (tmp_path.name, 3)
    assert [frame.stamp_ns for frame in frames] == [0, 100_000_000, 200_000_000]
    assert [[image.name for image in frame.depths] for frame in frames] == [
        ["left", "right"],
        ["left"],
        ["left", "right"],
    ]
    left, right = frames[2].depths
    np.testing.assert_array_equal(left.depth, depth_image(20))
    np.testing.assert_array_equal(right.depth, depth_image(21))
    assert left.depth.dtype == np.uint16
    assert left.depth.flags.c_contiguous
    assert left.intrinsics == Intrinsics(8, 6, 7.0, 7.5, 3.5, 2.5, 0.001)
    assert right.intrinsics.fx == 9.0
    np.testing.assert_array_equal(left.T_world_camera, np.eye(4))
    assert frames[0].clouds == ()


def test_the_file_itself_may_be_given(tmp_path):
    recording(tmp_path)
    assert open_source(tmp_path / "recording.json").length == 3


def test_a_frame_may_say_where_its_camera_is(tmp_path):
    content = recording(tmp_path)
    content["frames"][1]["T_world_camera"] = {"left": LIFTED}
    write_json(tmp_path, content)
    heights = [frame.depths[0].T_world_camera[2, 3] for frame in open_source(tmp_path)]
    assert heights == [0.0, 2.5, 0.0]


def test_a_camera_may_have_no_place_of_its_own_when_every_frame_has(tmp_path):
    content = recording(tmp_path, cameras={"left": camera(T_world_camera=None), "right": camera()})
    write_json(tmp_path, content)
    with pytest.raises(HeadvoxError, match="frame 0: camera 'left' has no T_world_camera"):
        open_source(tmp_path)
    for frame in content["frames"]:
        frame["T_world_camera"] = {"left": LIFTED}
    write_json(tmp_path, content)
    assert all(frame.depths[0].T_world_camera[2, 3] == 2.5 for frame in open_source(tmp_path))


def test_a_moment_in_which_all_cameras_dropped_out_is_a_frame(tmp_path):
    content = recording(tmp_path)
    content["frames"][1]["depth"] = {}
    write_json(tmp_path, content)
    assert [len(frame.depths) for frame in open_source(tmp_path)] == [2, 0, 2]


def test_the_ground_truth_is_left_alone(tmp_path):
    recording(tmp_path)
    (tmp_path / "heads.jsonl").write_text("not json")
    assert all(isinstance(frame, Frame) for frame in open_source(tmp_path))


def replace_image(folder, data):
    (folder / "left" / "000001.png").write_bytes(data)


def pillow_png(tmp_path, mode, size=(8, 6)):
    Image.new(mode, size).save(tmp_path / "made.png")
    return (tmp_path / "made.png").read_bytes()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda p: (p / "left" / "000001.png").unlink(), "000001.png: cannot be read: No such file"),
        (lambda p: replace_image(p, b""), "expected a PNG image"),
        (lambda p: replace_image(p, b"P5 8 6 65535\n" + bytes(96)), "expected a PNG image"),
        (lambda p: replace_image(p, png(depth_image())[:-30]), "damaged"),
        (lambda p: replace_image(p, png(depth_image())[:40]), "damaged"),
        (lambda p: replace_image(p, png(depth_image()[:, :7])), "the image is 7x6, expected 8x6"),
        (lambda p: replace_image(p, png(depth_image()[:0])), "the image is 8x0, expected 8x6"),
        (lambda p: replace_image(p, png(depth_image(), bits=8)), "16-bit grey PNG, got 8 bits"),
        (lambda p: replace_image(p, pillow_png(p, "L")), "16-bit grey PNG, got 8 bits and colour type 0"),
        (lambda p: replace_image(p, pillow_png(p, "RGB")), "got 8 bits and colour type 2"),
        (
            lambda p: replace_image(p, png(depth_image()) + bytes(2_000_000)),
            "2000[0-9]* bytes, expected at most",
        ),
    ],
)
def test_a_bad_image_is_a_bad_frame_and_the_rest_goes_on(tmp_path, damage, message):
    recording(tmp_path)
    damage(tmp_path)
    good, bad, last = open_source(tmp_path)
    assert isinstance(good, Frame)
    assert isinstance(last, Frame)
    assert isinstance(bad, BadFrame)
    assert bad.stamp_ns == 100_000_000
    assert re.search(message, bad.reason)
    assert "\n" not in bad.reason


def test_a_png_that_claims_to_be_huge_is_never_decoded(monkeypatch):
    data = bytearray(png(depth_image()))
    data[16:24] = (60_000).to_bytes(4, "big") * 2
    monkeypatch.setattr(Image, "open", lambda *_, **__: pytest.fail("it was opened"))
    with pytest.raises(HeadvoxError, match="60000x60000, expected 8x6"):
        decode_depth(bytes(data), 8, 6, "a.png")


def test_what_pillow_writes_is_read_exactly(tmp_path):
    depth = depth_image(3, 64, 48)
    depth[0, :2] = 0, 65535
    Image.fromarray(depth).save(tmp_path / "a.png")
    np.testing.assert_array_equal(decode_depth((tmp_path / "a.png").read_bytes(), 64, 48, "a.png"), depth)


def test_links_and_pipes_do_not_lead_out(tmp_path):
    folder = tmp_path / "r"
    recording(folder)
    secret = tmp_path / "secret.png"
    secret.write_bytes(png(depth_image(10)))
    image = folder / "left" / "000001.png"
    image.unlink()
    image.symlink_to(secret)
    bad = list(open_source(folder))[1]
    assert isinstance(bad, BadFrame)
    assert "leads out of the recording" in bad.reason
    image.unlink()
    image.symlink_to(folder / "left" / "000000.png")  # inside it may
    assert isinstance(list(open_source(folder))[1], Frame)
    if hasattr(os, "mkfifo"):
        image.unlink()
        os.mkfifo(image)
        assert isinstance(list(open_source(folder))[1], BadFrame)


@pytest.mark.parametrize(
    "file", ["../secret.png", "left/../../a.png", "/etc/passwd", "C:\\a.png", "..\\a.png", "\\a"]
)
def test_paths_that_leave_the_folder_refuse_the_recording(tmp_path, file):
    content = recording(tmp_path)
    content["frames"][2]["depth"]["left"] = file
    write_json(tmp_path, content)
    with pytest.raises(HeadvoxError, match=r"frame 2: depth of 'left': the path .* leaves the recording"):
        open_source(tmp_path)


def put(path, value):
    """Return a change of a recording: what lies along the path becomes the value; it goes with ``put``."""

    def change(content):
        *way, last = path
        for key in way:
            content = content[key]
        if value is put:
            del content[last]
        else:
            content[last] = value

    return change


LEFT = ("cameras", "left")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put(["format"], "rosbag"), "format is 'rosbag', expected 'headvox-recording'"),
        (put(["version"], 2), "version is 2, expected 1"),
        (put(["version"], True), "version is True, expected 1"),
        (put(["version"], put), "key 'version' is missing"),
        (put(["cameras"], put), "key 'cameras' is missing"),
        (put(["cameras"], {}), "there are no cameras"),
        (put(["cameras"], []), "cameras: expected an object in braces, got a list of 0"),
        (put(LEFT, 3), "camera 'left': expected an object in braces, got 3"),
        (put([*LEFT, "fx"], put), "camera 'left': the key 'fx' is missing"),
        (put([*LEFT, "fx"], "7"), "fx: expected a finite number, got '7'"),
        (put([*LEFT, "fx"], float("nan")), "fx: expected a finite number, got nan"),
        (put([*LEFT, "fx"], float("inf")), "fx: expected a finite number, got inf"),
        (put([*LEFT, "fx"], 10**400), "fx: expected a finite number, got a huge number"),
        (put([*LEFT, "fx"], 0), "fx is 0.0, expected more than 0"),
        (put([*LEFT, "depth_scale"], -0.001), "depth_scale is -0.001"),
        (put([*LEFT, "depth_scale"], 1), "depth_scale is 1, expected 0.000001 to 0.1"),
        (put([*LEFT, "width"], 8.0), "width: expected a whole number, got 8.0"),
        (put([*LEFT, "width"], True), "width: expected a whole number, got True"),
        (put([*LEFT, "height"], 0), "the size is 8x0"),
        (put([*LEFT, "width"], 10**9), "the size is 1000000000x6"),
        (put([*LEFT, "T_world_camera"], [1, 2]), "no 4x4 matrix but a list of 2"),
        (put([*LEFT, "T_world_camera"], [["a"] * 4] * 4), "no 4x4 matrix but a list of 4"),
        (put([*LEFT, "T_world_camera"], [[0] * 4] * 4), "T_world_camera: the last row is"),
        (put([*LEFT, "T_world_camera"], np.diag([2.0, 2, 2, 1]).tolist()), "rotation part is not a rotation"),
        (put([*LEFT, "T_world_camera"], np.diag([1.0, 1, 0, 1]).tolist()), "rotation part is not a rotation"),
        (
            put([*LEFT, "T_world_camera"], np.diag([1.0, 1, -1, 1]).tolist()),
            "rotation part is not a rotation",
        ),
        (put(["frames"], put), "key 'frames' is missing"),
        (put(["frames"], []), "frames is a list of 0"),
        (put(["frames"], {"0": 1}), "frames is an object of 1"),
        (put(["frames", 1], None), "frame 1: expected an object in braces, got None"),
        (put(["frames", 1, "stamp_ns"], put), "frame 1: the key 'stamp_ns' is missing"),
        (put(["frames", 1, "stamp_ns"], 1.5), "frame 1: stamp_ns: expected a whole number, got 1.5"),
        (put(["frames", 1, "stamp_ns"], "1"), "stamp_ns: expected a whole number, got '1'"),
        (
            put(["frames", 1, "stamp_ns"], 2**63),
            "stamp_ns: expected a whole number of 64 bits, got 9223372036854775808",
        ),
        (put(["frames", 2, "stamp_ns"], 99_999_999), "stamp_ns 99999999 after one with 100000000"),
        (put(["frames", 1, "depth"], put), "frame 1: the key 'depth' is missing"),
        (put(["frames", 1, "depth"], "left"), "depth: expected an object in braces, got 'left'"),
        (put(["frames", 1, "depth", "left"], 7), "expected a file name, got 7"),
        (put(["frames", 1, "depth", "left"], ""), "expected a file name, got ''"),
        (put(["frames", 1, "depth", "left"], "a\nb\0"), "expected a file name, got 'a"),
        (
            put(["frames", 1, "depth", "top"], "a.png"),
            "there is no camera 'top', the cameras are 'left, right'",
        ),
        (put(["frames", 1, "T_world_camera"], {"top": IDENTITY}), "there is no camera 'top'"),
        (put(["frames", 1, "T_world_camera"], {"left": None}), "no 4x4 matrix but None"),
        (put(["frames", 1, "T_world_camera"], IDENTITY), "expected an object in braces, got a list of 4"),
    ],
)
def test_a_bad_recording_json_is_refused_in_one_line(tmp_path, change, message):
    content = recording(tmp_path)
    change(content)
    write_json(tmp_path, content)
    with pytest.raises(HeadvoxError, match=message) as error:
        open_source(tmp_path)
    assert "recording.json" in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 400
    assert error.value.do


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "not valid JSON"),
        (b'{"format": ', "not valid JSON"),
        (b"\xff\xfe\x00", "not valid JSON"),
        (b'{"version": ' + b"9" * 10_000 + b"}", "not valid JSON|key 'format' is missing"),
        (b"[" * 1_000_000, "nested too deeply|not valid JSON"),
        (b'{"a":' * 1_000_000, "nested too deeply|not valid JSON"),
        (b"[]", "expected an object in braces, got a list of 0"),
    ],
)
def test_what_is_no_recording_json_is_refused_in_one_line(tmp_path, text, message):
    (tmp_path / "recording.json").write_bytes(text)
    with pytest.raises(HeadvoxError, match=message) as error:
        open_source(tmp_path)
    assert "\n" not in str(error.value)


def test_what_is_said_of_a_camera_and_not_read_is_told(tmp_path):
    content = recording(tmp_path)
    content["cameras"]["left"].update(model="D435", distortion=[0.0, 0.0], binning=0)
    told: list[str] = []
    write_json(tmp_path, content)
    open_source(tmp_path, None, told.append)
    content["cameras"]["right"].update(
        distortion=[-0.05, 0.06], **{"\x1b[2J": 1, "T_camera": LIFTED, "note": "x"}
    )
    write_json(tmp_path, content)
    open_source(tmp_path, None, told.append)
    assert "is not read: 'model'; images are taken to be those of pinhole cameras" in told[0]
    assert "is not read: 'model', 'distortion', '\\x1b[2J', 'T_camera', ..; images" in told[1]
    assert len(told) == 2


def test_names_from_the_file_cannot_steer_a_terminal(tmp_path):
    content = recording(tmp_path)
    content["frames"][1]["depth"]["\x1b[2J\nleft"] = "a.png"
    (tmp_path / "recording.json").write_text(json.dumps(content))
    with pytest.raises(HeadvoxError, match="there is no camera") as error:
        open_source(tmp_path)
    assert str(error.value).isprintable()
