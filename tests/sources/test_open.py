"""Files and folders through the front door."""

import os
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from cloud_writers import POINTS, SQUARE, npy, npz, pcd, ply, recording
from PIL import Image

from headvox.commands.convert import convert
from headvox.data import BadFrame, Frame
from headvox.errors import HeadvoxError
from headvox.remarks import Remarks
from headvox.run import Report
from headvox.sample import sample_folder
from headvox.sources import open_source
from headvox.sources.check import as_points, check_cloud
from headvox.sources.describe import describe
from headvox.sources.folder import natural_key
from headvox.sources.options import SourceOptions

KINDS = {
    "ply": ply(),
    "ply_ascii": ply(encoding="ascii"),
    "pcd": pcd(),
    "pcd_ascii": pcd(encoding="ascii"),
    "npy": npy(),
    "npz": npz(points=POINTS),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("file", ["cloud", "pcd.ply", "x.npz.txt", "recording"])
def test_the_kind_is_told_by_the_content(tmp_path, kind, file):
    folder = tmp_path / "recording.ply"  # no name on the way means anything
    folder.mkdir()
    (folder / file).write_bytes(KINDS[kind])
    source = open_source(folder / file)
    assert (source.name, source.length) == (file, 1)
    (frame,) = source
    assert isinstance(frame, Frame)
    assert frame.stamp_ns == 0
    (cloud,) = frame.clouds
    assert cloud.name == file
    assert cloud.T_world_sensor is None
    np.testing.assert_array_equal(cloud.points, POINTS)
    source.close()
    source.close()


def test_a_path_may_be_text(tmp_path):
    (tmp_path / "a.ply").write_bytes(ply(SQUARE, faces=[(0, 1, 2, 3)]))
    (frame,) = open_source(str(tmp_path / "a.ply"))
    assert len(frame.clouds[0].points) > 5


def test_a_folder_is_in_natural_order_a_thirtieth_of_a_second_apart(tmp_path):
    names = ["f1.ply", "f2.PCD", "f10.npy", "f11.npz"]
    for name, data in zip(names, (ply(), pcd(), npy(), npz(points=POINTS)), strict=True):
        (tmp_path / name).write_bytes(data)
    for other in ("notes.txt", ".hidden.ply"):
        (tmp_path / other).write_bytes(b"nothing")
    (tmp_path / "deeper.ply").mkdir()
    source = open_source(tmp_path)
    frames = list(source)
    assert source.length == len(frames) == 4
    assert [frame.clouds[0].name for frame in frames] == names
    assert [frame.stamp_ns for frame in frames] == [0, 33_333_333, 66_666_666, 99_999_999]


def test_the_rate_of_a_folder_is_what_is_said(tmp_path):
    for index in range(3):
        (tmp_path / f"{index}.ply").write_bytes(ply())
    source = open_source(tmp_path, SourceOptions(rate_hz=10.0))
    assert [frame.stamp_ns for frame in source] == [0, 100_000_000, 200_000_000]
    rows = dict(describe(tmp_path, SourceOptions(rate_hz=10.0)))
    assert rows["duration"] == "0.20 s, files have no stamps and are 10 a second"
    assert (
        "0.07 s, files have no stamps and are taken to be 1/30 s apart"
        in dict(describe(tmp_path))["duration"]
    )
    for rate in (0.0, -10.0, 1e9, float("nan")):
        with pytest.raises(HeadvoxError, match=r"--rate: expected 0\.001 to 10000 clouds a second, got"):
            open_source(tmp_path, SourceOptions(rate_hz=rate))
    recording(tmp_path / "r")
    convert(open_source(tmp_path / "r"), tmp_path / "r.mcap")
    for stamped in ("r", "0.ply", "r.mcap"):
        with pytest.raises(HeadvoxError, match=r"--rate (is )?for folders of clouds"):
            open_source(tmp_path / stamped, SourceOptions(rate_hz=10.0))
    with pytest.raises(HeadvoxError, match="realsense:: --rate is for folders"):
        open_source("realsense:", SourceOptions(rate_hz=10.0))


def test_a_run_whose_velocities_depend_on_a_rate_that_nobody_said_tells_it_once(tmp_path):
    (tmp_path / "0.ply").write_bytes(ply())

    def told(ids: int | None, rate_hz: float | None) -> list[str]:
        lines: list[str] = []
        source = open_source(tmp_path, SourceOptions(rate_hz=rate_hz))
        Remarks(lines.append).ended(source, Report(frames=3, heads=3, ids=ids))
        return lines

    assert told(1, None) == ["velocities are for 30 clouds a second, for files have no stamps: see --rate"]
    assert told(None, None) == told(0, None) == told(1, 10.0) == []


def test_frames_that_were_not_tracked_are_told_whatever_is_written():
    lines: list[str] = []
    report = Report(frames=9, heads=9, untracked={"repeated": 3, "resets": 1})
    Remarks(lines.append).ended(open_source(sample_folder()), report)
    assert lines == [
        "3 frames with the stamp of the one before, not tracked",
        "1 jumps back in time, tracks begun anew",
    ]


def test_natural_order():
    names = ["a", "a1", "a02", "a2", "a10", "a10b", "b1"]
    assert sorted({*names}, key=natural_key) == names
    assert all(natural_key(a) < natural_key(b) for a, b in pairwise(names))


def test_a_bad_file_in_a_folder_is_a_bad_frame_and_keeps_its_place(tmp_path):
    for index, data in enumerate([ply(), b"", ply()[:-5], npy(POINTS * np.nan), npy(POINTS * 1000), pcd()]):
        (tmp_path / f"{index}.ply").write_bytes(data)
    (tmp_path / "6.ply").symlink_to(tmp_path / "nowhere.ply")
    frames = list(open_source(tmp_path))
    assert [type(frame) for frame in frames] == [Frame, *[BadFrame] * 4, Frame, BadFrame]
    assert [frame.stamp_ns for frame in frames] == [index * 33_333_333 for index in range(7)]
    reasons = [frame.reason for frame in frames if isinstance(frame, BadFrame)]
    words = ["1.ply: the file is empty", "promises 4 rows", "NaN", "millimetres", "no such file"]
    assert all(word in reason for word, reason in zip(words, reasons, strict=True))
    assert not any("\n" in reason for reason in reasons)


def test_closing_a_folder_or_a_recording_ends_it(tmp_path):
    recording(tmp_path / "r")
    (tmp_path / "c").mkdir()
    for index in range(3):
        (tmp_path / "c" / f"{index}.ply").write_bytes(ply())
    for folder in ("r", "c"):
        source = open_source(tmp_path / folder)
        frames = iter(source)
        next(frames)
        source.close()
        assert list(frames) == []


def test_missing_and_unreadable_things_are_refused(tmp_path):
    with pytest.raises(HeadvoxError, match="no such file"):
        open_source(tmp_path / "missing.ply")
    with pytest.raises(HeadvoxError, match=r"neither recording\.json nor any file that ends in \.ply, \.pcd"):
        open_source(tmp_path)
    (tmp_path / "text").write_text("hello\nworld")
    with pytest.raises(HeadvoxError, match=r"a ply, pcd, npy or npz file, it begins with b.hello"):
        open_source(tmp_path / "text")
    (tmp_path / "empty").touch()
    with pytest.raises(HeadvoxError, match="empty: the file is empty"):
        open_source(tmp_path / "empty")
    for name in ("x\0y", "x" * 5000):
        with pytest.raises(HeadvoxError, match=r"cannot be read|no such file"):
            open_source(tmp_path / name)


def test_images_alone_are_told_what_they_lack(tmp_path):
    Image.fromarray(np.full((2, 2), 1000, np.uint16)).save(tmp_path / "000000.png")
    for place in (tmp_path, tmp_path / "000000.png"):
        with pytest.raises(HeadvoxError, match=r"Depth images need a recording\.json"):
            open_source(place)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes exist on Unix only")
def test_a_pipe_does_not_block(tmp_path):
    os.mkfifo(tmp_path / "pipe.ply")
    with pytest.raises(HeadvoxError, match="neither"):
        open_source(tmp_path / "pipe.ply")
    (frame,) = open_source(tmp_path)
    assert isinstance(frame, BadFrame)


def test_importing_the_sources_and_reading_a_cloud_stays_light(tmp_path):
    (tmp_path / "a.ply").write_bytes(ply())
    code = (
        "import sys; from headvox.sources import open_source; "
        "list(open_source(sys.argv[1])); "
        "print([m for m in ('numba', 'PIL', 'scipy', 'headvox.sources.pcd') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "a.ply"], capture_output=True, text=True)
    assert (done.stdout.strip(), done.stderr) == ("[]", "")


def test_check_cloud_accepts_a_room_with_holes():
    points = POINTS.copy()
    points[1:] = np.nan
    check_cloud(points, "ok")
    check_cloud(np.vstack([np.full((100_000, 3), np.nan), points]).astype(np.float32), "ok")


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.empty((0, 3), np.float32), "empty"),
        (np.full((5, 3), np.nan, np.float32), "all 5 points are NaN"),
        (np.full((5, 3), np.inf, np.float32), "all 5 points are NaN or infinite"),
        (np.zeros((5, 4), np.float32), r"expected points as \(N, 3\) float32, got shape \(5, 4\)"),
        (np.zeros((5, 3), np.int32), "of int32"),
        (POINTS * 1000, "these look like millimetres"),
        (
            POINTS + np.float32(5000),
            "m or more from the origin, though they lie together: expected less than 100 m",
        ),
        (
            POINTS * 200,
            r"points are 375\.\d or more from the origin and .* their middle: metres are expected",
        ),
        (POINTS * 1e9, "metres are expected"),
    ],
)
def test_check_cloud_refuses_in_one_line(points, message):
    with pytest.raises(HeadvoxError, match=message) as error:
        check_cloud(points, "cloud 3")
    assert str(error.value).startswith("cloud 3: ")
    assert "\n" not in str(error.value)
    assert error.value.do


def test_points_that_are_not_finite_are_nan_as_a_whole_and_the_input_stays():
    x, y, z = np.array([[1.0, 1.0, 1e300], [2.0, np.inf, 2.0], [3.0, 3.0, 3.0]])
    points = as_points(x, y, z)
    np.testing.assert_array_equal(points, [[1, 2, 3], [np.nan] * 3, [np.nan] * 3])
    assert points.dtype == np.float32
    assert np.isinf(y[1])


def test_a_signalling_nan_is_a_nan():
    x = np.array([0x7FF4 << 48, 0], np.uint64).view(np.float64)
    assert np.isnan(as_points(x, np.zeros(2), np.zeros(2))).all(axis=1).tolist() == [True, False]
