import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from headvox.data import Frame
from headvox.errors import HeadvoxError
from headvox.parallel.workers import Workers
from headvox.sources import open_source
from headvox.synth import mannequin, presets, record

STAMPS = record.stamps(3, 10.0)


@pytest.fixture(scope="module")
def scene():
    return presets.two_cameras(1, mannequin, duration_s=1.0, mode="d435i-small")


def contents(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_recording_is_as_the_format_says_and_reads_back(tmp_path, scene):
    folder = record.write_recording(tmp_path / "walk", scene, STAMPS)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["walk"]
    assert sorted(p.name for p in folder.iterdir()) == ["heads.jsonl", "left", "recording.json", "right"]
    about = json.loads((folder / "recording.json").read_text())
    assert (about["format"], about["version"]) == ("headvox-recording", 1)
    assert [frame["stamp_ns"] for frame in about["frames"]] == STAMPS
    lines = [json.loads(line) for line in (folder / "heads.jsonl").read_text().splitlines()]
    assert [line["stamp_ns"] for line in lines] == STAMPS
    assert all(line["exhaustive"] is True for line in lines)
    for k, stamp in enumerate(STAMPS):
        frame, heads = scene.frame(stamp)
        for depth in frame.depths:
            camera = about["cameras"][depth.name]
            assert (camera["width"], camera["height"]) == (424, 240)
            assert camera["depth_scale"] == 0.001
            np.testing.assert_array_equal(np.array(camera["T_world_camera"]), depth.T_world_camera)
            with Image.open(folder / about["frames"][k]["depth"][depth.name]) as image:
                assert image.mode.startswith("I;16")
                np.testing.assert_array_equal(np.asarray(image), depth.depth)
        assert len(lines[k]["heads"]) == len(heads)
        for row, head in zip(lines[k]["heads"], heads, strict=True):
            np.testing.assert_allclose(row["centre"], head.centre, atol=1e-5)
            np.testing.assert_allclose(np.linalg.norm(row["quaternion"]), 1.0, atol=1e-5)
            assert row["visible"] == head.visible
            assert row["posture"] == head.posture


def test_two_workers_write_the_same_bytes_as_one(tmp_path, scene):
    one = record.write_recording(tmp_path / "one", scene, STAMPS, workers=Workers(1))
    two = record.write_recording(tmp_path / "two", scene, STAMPS, workers=Workers(2))
    assert contents(one) == contents(two)


def test_a_recording_that_was_broken_off_goes_on(tmp_path, scene, monkeypatch):
    whole = record.write_recording(tmp_path / "whole", scene, STAMPS)
    made = []
    usual = type(scene).frame

    def broken(self, stamp_ns):
        made.append(stamp_ns)
        if len(made) == 3:
            raise KeyboardInterrupt
        return usual(self, stamp_ns)

    monkeypatch.setattr(type(scene), "frame", broken)
    with pytest.raises(KeyboardInterrupt):
        record.write_recording(tmp_path / "late", scene, STAMPS)
    assert not (tmp_path / "late").exists()
    late = record.write_recording(tmp_path / "late", scene, STAMPS)
    assert made == [*STAMPS, STAMPS[2]]  # the first two were not made again
    assert contents(late) == contents(whole)


def test_what_cannot_be_written_is_said(tmp_path, scene):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "mine.txt").write_text("mine")
    with pytest.raises(HeadvoxError, match="exists already"):
        record.write_recording(tmp_path / "there", scene, STAMPS)
    with pytest.raises(HeadvoxError, match="later than the one before"):
        record.write_recording(tmp_path / "new", scene, [0, 0])
    with pytest.raises(HeadvoxError, match="0 cameras"):
        record.write_recording(tmp_path / "new", replace(scene, cameras=[]), STAMPS)
    (tmp_path / "new.partial").mkdir()
    (tmp_path / "new.partial" / "making.json").write_text('{"seed": 0}')
    with pytest.raises(HeadvoxError, match="another recording"):
        record.write_recording(tmp_path / "new", scene, STAMPS)


def test_the_sample_shows_three_people_and_is_small(tmp_path):
    folder = record.make_sample(tmp_path / "sample", mannequin)
    size = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
    assert size < 3.5e6
    lines = [json.loads(line) for line in (folder / "heads.jsonl").read_text().splitlines()]
    assert len(lines) == record.SAMPLE_FRAMES
    assert all({row["id"] for row in line["heads"]} >= {1, 2, 3} for line in lines)
    seen = [max(row["visible"].values()) > 0.15 for line in lines for row in line["heads"] if row["id"] <= 3]
    assert np.mean(seen) > 0.9


def test_the_package_s_own_reader_gives_the_frames_back(tmp_path, scene):
    folder = record.write_recording(tmp_path / "walk", scene, STAMPS)
    read = list(open_source(folder))
    assert len(read) == len(STAMPS)
    for got, stamp in zip(read, STAMPS, strict=True):
        assert isinstance(got, Frame)
        wanted, _ = scene.frame(stamp)
        assert got.stamp_ns == stamp
        assert len(got.depths) == 2
        for one, other in zip(got.depths, wanted.depths, strict=True):
            assert (one.name, one.intrinsics) == (other.name, other.intrinsics)
            np.testing.assert_array_equal(one.depth, other.depth)
            np.testing.assert_allclose(one.T_world_camera, other.T_world_camera)
