"""Files that were damaged, or made to do damage: one error of ours, soon, and without filling the memory."""

import json
import tracemalloc
from datetime import timedelta

import numpy as np
import pytest
from cloud_writers import POINTS, SQUARE, npy, npz, pcd, ply, png, recording
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from headvox.data import BadFrame, Frame
from headvox.errors import HeadvoxError
from headvox.sources import open_source

MANY = np.tile(POINTS, (20, 1))
FACES = [(0, 1, 2, 3), (3, 2, 4)]
FILES = {
    "ply_ascii": ply(encoding="ascii"),
    "ply_little": ply(extra=False),
    "ply_lists": ply(encoding="binary_big_endian"),
    "ply_surface": ply(SQUARE, faces=FACES),
    "ply_surface_ascii": ply(SQUARE, "ascii", FACES),
    "pcd_ascii": pcd(encoding="ascii"),
    "pcd_binary": pcd(viewpoint="0 0 1 1 0 0 0"),
    "pcd_compressed": pcd(MANY, "binary_compressed"),
    "npy": npy(),
    "npy_fields": npy(MANY.astype("<f4").view([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])),
    "npz": npz(points=POINTS),
    "npz_compressed": npz(True, points=MANY),
}
MOST_BYTES = 1 << 30
FUZZ = settings(
    max_examples=60,
    deadline=timedelta(seconds=60),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
FLIPS = st.lists(st.tuples(st.integers(0, 1 << 16), st.integers(1, 255)), max_size=6)
CUT = st.none() | st.integers(0, 1 << 16)


def damaged(data: bytes, flips, cut) -> bytes:
    body = bytearray(data)
    for at, bits in flips:
        body[at % len(body)] ^= bits
    return bytes(body if cut is None else body[: cut % (len(body) + 1)])


def frames_of(path):
    """Read everything as a run does; only HeadvoxError may come out, and never much memory go in."""
    frames, problem = [], ""
    tracemalloc.start()
    try:
        frames = list(open_source(path))
    except HeadvoxError as error:
        problem = str(error)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < MOST_BYTES
    assert bool(frames) != bool(problem)
    assert "\n" not in problem
    return frames


def check_frame(frame):
    for cloud in frame.clouds:
        assert cloud.points.dtype == np.float32
        assert cloud.points.flags.c_contiguous
        assert cloud.points.shape[1:] == (3,)
        assert not np.isinf(cloud.points).any()
    for image in frame.depths:
        assert image.depth.dtype == np.uint16
        assert image.depth.shape == (image.intrinsics.height, image.intrinsics.width)


@pytest.mark.parametrize("kind", FILES)
def test_damaged_files_are_read_or_refused(kind, tmp_path):
    path = tmp_path / "file"

    @FUZZ
    @given(FLIPS, CUT)
    def run(flips, cut):
        path.write_bytes(damaged(FILES[kind], flips, cut))
        for frame in frames_of(path):
            check_frame(frame)

    run()


@pytest.mark.parametrize("kind", FILES)
def test_every_truncation_is_read_or_refused(kind, tmp_path):
    path = tmp_path / "file"
    data = FILES[kind]
    for end in range(0, len(data), max(1, len(data) // 80)):
        path.write_bytes(data[:end])
        for frame in frames_of(path):
            check_frame(frame)


@FUZZ
@given(FLIPS, CUT, st.sampled_from(["recording.json", "left/000001.png"]))
def test_damaged_recordings_are_read_or_refused(tmp_path_factory, flips, cut, damaged_file):
    folder = tmp_path_factory.mktemp("recording")
    recording(folder)
    path = folder / damaged_file
    path.write_bytes(damaged(path.read_bytes(), flips, cut))
    frames = frames_of(folder)
    if damaged_file.endswith(".png"):
        assert len(frames) == 3
    for frame in frames:
        if isinstance(frame, Frame):
            check_frame(frame)
        else:
            assert isinstance(frame, BadFrame)
            assert "\n" not in frame.reason


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


@settings(FUZZ, max_examples=150)
@given(st.data())
def test_any_json_in_any_place_of_a_recording_is_read_or_refused(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("recording")
    content = recording(folder, frames=1)
    place = content
    while True:
        key = data.draw(st.sampled_from(list(place) if isinstance(place, dict) else range(len(place))))
        if not isinstance(place[key], (dict, list)) or not place[key] or data.draw(st.booleans()):
            break
        place = place[key]
    place[key] = data.draw(JSON)
    (folder / "recording.json").write_text(json.dumps(content))
    for frame in frames_of(folder):
        assert isinstance(frame, (Frame, BadFrame))


def test_a_header_that_claims_terabytes_costs_nothing(tmp_path):
    claims = {
        "ply": (ply(extra=False), b"vertex 4", b"vertex 999999999999"),
        "ply_faces": (ply(SQUARE, faces=FACES), b"face 2", b"face 999999999999"),
        "pcd": (pcd(), b"WIDTH 4\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4", b"POINTS 999999999999"),
        "npy": (npy(), b"(4, 3), }            ", b"(999999999999, 3), } "),
    }
    for kind, (data, old, new) in claims.items():
        assert old in data, kind
        (tmp_path / kind).write_bytes(data.replace(old, new))
        tracemalloc.start()
        with pytest.raises(HeadvoxError, match="promises"):
            list(open_source(tmp_path / kind))
        assert tracemalloc.get_traced_memory()[1] < 1 << 20, kind
        tracemalloc.stop()


def test_a_png_bomb_is_refused_by_its_header(tmp_path):
    recording(tmp_path)
    (tmp_path / "left" / "000000.png").write_bytes(png(np.zeros((9000, 9000), np.uint16)))
    first, *rest = frames_of(tmp_path)
    assert isinstance(first, BadFrame)
    assert "9000x9000, expected 8x6" in first.reason
    assert all(isinstance(frame, Frame) for frame in rest)
