"""What rerun is told: read back from a file, seen on a screen, and never waited for."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import headvox
from headvox.cli import main
from headvox.data import Frame
from headvox.errors import HeadvoxError
from headvox.render.colours import HEADS
from headvox.run import look
from headvox.sinks import Result
from headvox.tracking.tracker import Tracker
from headvox.view.mailbox import Mailbox, letters
from headvox.view.watch import Watch

SAMPLE = Path(headvox.__file__).parent / "assets" / "sample"
FRAMES = 6
ECHO = """
import sys
from headvox.view.mailbox import letters
with open(sys.argv[1], "w") as out:
    for letter in letters(sys.stdin.buffer):
        print(letter[0], letter[1].sum(), file=out, flush=True)
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("view") / "run.rrd"
    assert main(["view", str(SAMPLE), "-o", str(path), "--limit", str(FRAMES)]) == 0
    return path


@pytest.fixture(scope="module")
def found() -> list[tuple[Frame, Result]]:
    detector, tracker = headvox.Detector(), Tracker()
    frames = [frame for frame, _ in zip(headvox.open_source(SAMPLE), range(FRAMES), strict=False)]
    results = [look(detector, tracker, frame, n)[0] for n, frame in enumerate(frames)]
    detector.close()
    return list(zip(frames, results, strict=True))


@pytest.fixture(scope="module")
def table(recording: Path) -> Iterator:
    rr = pytest.importorskip("rerun")
    pytest.importorskip("datafusion")
    with rr.server.Server(datasets={"run": [str(recording)]}) as server:
        data = server.client().get_dataset("run").filter_contents(["/**"])
        yield data.reader(index="frame").to_pandas().set_index("frame").sort_index()


# ---------------------------------------------------------------------------------------------------- read back


def test_the_heads_in_the_file_are_those_that_were_found(table, found) -> None:
    assert list(table.index) == list(range(FRAMES))
    turned = 0
    for number, (_, result) in enumerate(found):
        row = table.loc[number]
        tracks = list(result.rows())
        known = [track for track in tracks if np.isfinite(track.quaternion).all()]
        others = [track for track in tracks if not np.isfinite(track.quaternion).all()]
        for entity, expected in (("turned:Boxes3D", known), ("round:Ellipsoids3D", others)):
            centres = row[f"/world/heads/{entity}:centers"]
            centres = np.array([] if centres is None else list(centres)).reshape(-1, 3)
            assert len(centres) == len(expected)
            assert np.allclose(centres, np.array([t.centre for t in expected]).reshape(-1, 3), atol=1e-5)
            labels = row[f"/world/heads/{entity}:labels"]
            assert [] if labels is None else list(labels) == [str(t.id or "?") for t in expected]
        if known:
            quaternions = np.array(list(row["/world/heads/turned:Boxes3D:quaternions"]))
            assert np.allclose(quaternions, [t.quaternion for t in known], atol=1e-5)
        turned += len(known)
    assert turned > FRAMES


def test_the_images_and_where_they_were_taken_are_in_the_file(table, found) -> None:
    for number, (frame, _) in enumerate(found):
        for image in frame.depths:
            entity = f"/world/sensors/{image.name}"
            buffer = np.array(table.loc[number][f"{entity}/depth:DepthImage:buffer"][0], np.uint8)
            assert np.array_equal(buffer.view(np.uint16).reshape(image.depth.shape), image.depth)
    for image in found[0][0].depths:
        entity, T = f"/world/sensors/{image.name}", image.T_world_camera
        first = table.loc[0]
        assert np.allclose(first[f"{entity}:Transform3D:translation"][0], T[:3, 3], atol=1e-5)
        R = np.array(first[f"{entity}:Transform3D:mat3x3"][0]).reshape(3, 3).T  # column by column
        assert np.allclose(R, T[:3, :3], atol=1e-5)
        K = np.array(first[f"{entity}:Pinhole:image_from_camera"][0]).reshape(3, 3).T
        assert (K[0, 0], K[1, 1]) == pytest.approx((image.intrinsics.fx, image.intrinsics.fy))


def test_every_stage_is_in_the_file(table) -> None:
    for stage in (*headvox.pipeline.STAGES, "all"):
        assert all(ms[0] >= 0 for ms in table[f"/latency/{stage}:Scalars:scalars"])
    gate, votes = table["/world/gate:Points3D:positions"], table["/world/votes:Points3D:positions"]
    assert all(len(g) > len(v) > 3 for g, v in zip(gate, votes, strict=True))


def test_the_candidates_are_those_of_the_last_frame(found) -> None:
    detector = headvox.Detector()
    assert len(detector.candidates_of_last_frame()[0]) == 0
    for frame, _ in found[:3]:
        heads = detector.detect_frame(frame)
        centres, votes = detector.candidates_of_last_frame()
        assert centres.shape == (detector.candidates, 3)
        assert votes.shape == (detector.candidates,)
        voted = centres[np.isfinite(votes)]
        for head in heads.centres:  # a head comes from a candidate near it
            assert np.linalg.norm(voted - head, axis=1).min() < 0.15
    detector.close()


# ------------------------------------------------------------------------------------------------- never waited for


def test_a_slow_child_never_holds_up_the_loop_and_gets_the_newest(tmp_path: Path) -> None:
    out = tmp_path / "out"
    slow = ECHO.replace("print(", "import time; time.sleep(0.2); print(")
    mailbox = Mailbox(["-c", slow, str(out)])
    took = []
    for number in range(40):
        begun = time.perf_counter()
        mailbox.put((number, np.full(500_000, number, np.int64)))
        took.append(time.perf_counter() - begun)
        time.sleep(0.01)
    mailbox.close()
    rows = [tuple(map(int, line.split())) for line in out.read_text().splitlines()]
    assert np.median(took) < 1e-3
    assert rows[-1][0] == 39
    assert len(rows) + mailbox.dropped == 40
    assert mailbox.dropped > 5
    assert all(total == 500_000 * number for number, total in rows)


def test_with_every_nothing_is_dropped(tmp_path: Path) -> None:
    out = tmp_path / "out"
    mailbox = Mailbox(["-c", ECHO, str(out)], every=True)
    for number in range(30):
        mailbox.put((number, np.ones(10)))
    mailbox.close()
    assert [int(line.split()[0]) for line in out.read_text().splitlines()] == list(range(30))
    assert mailbox.dropped == 0


@pytest.mark.parametrize(("hz", "every", "shown"), [(30, False, 10), (30, True, 30), (9, False, 30)])
def test_ten_frames_a_second_are_shown(found, monkeypatch, tmp_path, hz, every, shown) -> None:
    left = []
    monkeypatch.setattr(Mailbox, "put", lambda _, letter: left.append(letter.result.frame))
    frame, result = found[0]
    detector = headvox.Detector()
    watch = Watch(detector, tmp_path / "out.rrd", every)
    for number in range(30):
        watch.show(replace(frame, stamp_ns=number * 10**9 // hz), replace(result, frame=number))
    watch.close()
    assert len(left) == shown
    assert left[0] == 0


def test_a_child_that_ends_is_told() -> None:
    mailbox = Mailbox(["-c", "pass"])

    def put_until_told() -> None:
        for _ in range(200):
            mailbox.put((0, np.zeros(100_000)))
            time.sleep(0.05)

    with pytest.raises(HeadvoxError, match="The viewer has ended"):
        put_until_told()
    mailbox.close()


def test_letters_are_read_as_they_were_written() -> None:
    script = "import sys; from headvox.view.mailbox import _write; import numpy as np\n"
    script += "for n in range(3): _write(sys.stdout.buffer, {'n': n, 'a': np.arange(n * 1000)})"
    done = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE)
    assert done.stdout is not None
    with done.stdout as pipe:
        got = list(letters(pipe))
    assert done.wait() == 0
    assert [letter["n"] for letter in got] == [0, 1, 2]
    assert all(np.array_equal(letter["a"], np.arange(letter["n"] * 1000)) for letter in got)


# ------------------------------------------------------------------------------------------------------ the command


def test_run_prints_the_same_with_the_viewer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    printed = []
    for flags in ([], ["--view", str(tmp_path / "run.rrd")]):
        assert main(["run", str(SAMPLE), "--json", "--limit", "3", "--refine", "sphere", *flags]) == 0
        lines = capsys.readouterr().out.splitlines()
        printed.append([line.split('"heads"')[1] for line in lines])
    assert printed[0] == printed[1]
    assert (tmp_path / "run.rrd").stat().st_size > 50_000


def test_what_is_missing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if sys.platform == "linux":
        assert main(["view", str(SAMPLE)]) == 1
        assert "There is no display" in capsys.readouterr().err
    assert main(["view", str(SAMPLE), "-o", str(tmp_path / "no" / "run.rrd")]) == 1
    assert "No such file" in capsys.readouterr().err
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["view", str(SAMPLE)]) == 1
    assert "headvox[view]" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["view", "-o", "run.mp4"], ["run", "--view", "run.mp4"]])
def test_wrong_usage(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    assert "expected a name that ends with .rrd" in capsys.readouterr().err


@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="no xvfb-run: the viewer has no screen here")
def test_the_viewer_draws_it(recording: Path, tmp_path: Path) -> None:
    from headvox.view import viewer

    picture = tmp_path / "screen.png"
    command = [
        "xvfb-run",
        "-a",
        "-s",
        "-screen 0 640x480x24",
        viewer.program(),
        str(recording),
        "--port",
        "auto",
    ]
    command += ["--bind", "127.0.0.1", "--screenshot-to", str(picture), "--window-size", "640x480"]
    done = subprocess.run(
        command, env={**os.environ, **viewer.quiet_environment()}, capture_output=True, timeout=120, text=True
    )
    assert picture.exists(), done.stderr
    with Image.open(picture) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 1000
    assert pixels.std() > 25
    for colour in HEADS[:3]:  # the boxes of the three people, in the images at least
        assert (np.abs(pixels - colour) <= 30).all(axis=2).sum() > 30
