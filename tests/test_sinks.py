"""What is written, to the byte."""

from __future__ import annotations

import io
import json
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from headvox.commands.live import Live
from headvox.commands.table import printable, table
from headvox.config import TrackerConfig
from headvox.data import Frame, Heads
from headvox.errors import HeadvoxError
from headvox.run import Report
from headvox.sinks import Result, open_sink
from headvox.sinks.jsonl import JsonStream, to_json
from headvox.tracking.tracker import Tracker

HEADS = Heads(
    np.array([[1.00004, -2.0, -0.00001]]),
    np.array([[0.0, 0.0, 0.6, 0.8]]),
    np.array([0.11]),
    np.array([3.25]),
)
RESULT = Result(7, 123456789012345678, 2.10049, HEADS)


def test_a_line_of_json() -> None:
    assert to_json(RESULT) == (
        '{"stamp_ns": 123456789012345678, "frame": 7, "latency_ms": 2.1, "heads": [{"id": null, '
        '"centre": [1.0, -2.0, 0.0], "quaternion": [0.0, 0.0, 0.6, 0.8], "radius": 0.11, "score": 3.25, '
        '"velocity": null, "centre_sigma": null, "rotation_sigma": null}]}'
    )
    assert '"heads": []' in to_json(Result(0, 0, 1.0, Heads()))


def test_json_states_how_sure_a_head_is() -> None:
    turn = np.diag(np.radians([1.0, 2.0, 30.0]) ** 2)
    place = np.diag([0.01, 0.02, 0.0301234]) ** 2
    tables = [
        np.repeat(table, 2, axis=0) for table in (HEADS.centres, HEADS.quaternions, HEADS.radii, HEADS.scores)
    ]
    heads = Heads(*tables, np.stack([place, place]), np.stack([turn, np.full((3, 3), np.nan)]))
    one, other = json.loads(to_json(Result(0, 0, 1.0, heads)))["heads"]
    assert one["centre_sigma"] == other["centre_sigma"] == [0.01, 0.02, 0.0301]
    assert one["rotation_sigma"] == [1.0, 2.0, 30.0]
    assert other["rotation_sigma"] is None

    tracker = Tracker()
    tracked = [tracker.update(heads, Frame(stamp_ns=k * 33_000_000)) for k in range(3)][-1]
    head = json.loads(to_json(Result(0, 0, 1.0, heads, tracked)))["heads"][0]
    assert head["centre_sigma"] == pytest.approx(np.sqrt(np.diag(tracked.covariances[0])[:3]), abs=6e-5)
    assert 0 < head["centre_sigma"][0] < 0.1
    wanted = np.degrees(np.sqrt(np.diag(tracked.rotation_covariances[0])))
    assert head["rotation_sigma"] == pytest.approx(wanted, abs=6e-3)


@given(st.lists(st.floats(), min_size=10, max_size=10))
def test_no_number_makes_json_that_is_none(values: list[float]) -> None:
    v = np.array(values)
    heads = Heads(v[None, :3], v[None, 3:7], v[7:8], v[8:9])

    def refuse(token: str) -> None:
        raise AssertionError(token)

    line = to_json(Result(0, 0, values[9], heads))
    json.loads(line, parse_constant=refuse)
    assert "-0.0," not in line


def test_files_are_whole_at_every_moment(tmp_path: Path) -> None:
    for name in ("out.jsonl", "out.csv"):
        sink = open_sink(tmp_path / name)
        for n in range(1, 4):
            sink.write(RESULT)
            text = (tmp_path / name).read_text()
            assert text.endswith("\n")
            assert len(text.splitlines()) == n + name.endswith("csv")
        sink.close()
        sink.close()


@pytest.mark.parametrize("name", ["out.jsonl", "out.csv", "out.tum", "out.mcap"])
def test_without_a_result_an_older_file_stays(tmp_path: Path, name: str) -> None:
    older = tmp_path / name.replace(".tum", "_3.tum")
    older.write_text("precious\n")
    open_sink(tmp_path / name).close()
    assert [path.read_text() for path in tmp_path.iterdir()] == ["precious\n"]
    with closing(open_sink(tmp_path / name)) as sink:
        sink.write(RESULT)
    assert not older.exists() or b"precious" not in older.read_bytes()


def test_csv_has_a_row_a_head(tmp_path: Path) -> None:
    sink = open_sink(tmp_path / "out.csv")
    sink.write(Result(0, 5, 1.0, Heads()))
    sink.write(RESULT)
    sink.close()
    assert (tmp_path / "out.csv").read_text() == (
        "frame,stamp_ns,latency_ms,id,x,y,z,qx,qy,qz,qw,radius,score,vx,vy,vz,state\n"
        "7,123456789012345678,2.1,,1.0,-2.0,0.0,0.0,0.0,0.6,0.8,0.11,3.25,,,,\n"
    )


@pytest.mark.parametrize(
    ("stamp_ns", "told"),
    [(1_500_000_000, "1.500000000"), (-1, "-0.000000001"), (1 - 10**18, "-999999999.999999999")],
)
def test_trajectories_have_stamps_before_1970(tmp_path: Path, stamp_ns: int, told: str) -> None:
    tracker = Tracker(TrackerConfig(confirm_hits=1, strong_score=1.0))
    result = Result(0, stamp_ns, 1.0, HEADS, tracker.update(HEADS, Frame(stamp_ns)))
    open_sink(tmp_path / "out.tum").write(result)
    assert (tmp_path / "out_1.tum").read_text().split()[0] == told


def test_a_stream_is_not_closed() -> None:
    stream = io.StringIO()
    sink = JsonStream(stream)
    sink.write(RESULT)
    sink.close()
    assert stream.getvalue() == to_json(RESULT) + "\n"


def test_files_that_cannot_be_written_are_explained(tmp_path: Path) -> None:
    with pytest.raises(HeadvoxError, match=r"\.jsonl, \.csv, \.tum or \.mcap"):
        open_sink(tmp_path / "out.txt")
    with pytest.raises(HeadvoxError, match="No such file"):
        open_sink(tmp_path / "nowhere" / "out.csv")
    full = tmp_path / "full.jsonl"
    if Path("/dev/full").exists():
        full.symlink_to("/dev/full")
        sink = open_sink(full)
        with pytest.raises(HeadvoxError, match="No space left"):
            sink.write(RESULT)
        sink.close()


def test_tables_align_and_hide_control_characters() -> None:
    text = table(["name", "n", "word"], [["a", "1", "x"], ["long\x1b[31m", "20", "yy"]])
    assert text.splitlines() == ["name        n  word", "a           1  x", "long?[31m  20  yy"]
    assert printable("a\nb\udc80") == "a?b?"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_the_live_line_goes_away_for_notes_and_at_the_end() -> None:
    stream = Terminal()
    live = Live(stream)
    live.frame(Report(frames=3, bad=1, seconds=0.5))
    live.frame(Report(frames=4, bad=1, seconds=0.5))  # too soon after the first
    live.note("frame 2 skipped:\x07 torn")
    live.close()
    shown = "frame 3  heads 0  6.0 Hz  0.0 ms  dropped 1"
    assert stream.getvalue() == f"\r{shown}\r{' ' * len(shown)}\rframe 2 skipped:? torn\n"
    quiet = io.StringIO()
    Live(quiet, 9).frame(Report(frames=3))
    assert quiet.getvalue() == ""
