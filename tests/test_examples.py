"""The programs in examples/ are run as a user would: without an argument, and with a source that cannot be used."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
from dataclasses import replace
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import headvox

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
READING = ("file", "two_cameras", "own_sink", "speed_and_separation")


def loaded(name: str) -> ModuleType:
    spec = spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(EXAMPLES / f"{name}.py"), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def printed(name: str) -> list[str]:
    done = run(name)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()


def test_every_example_is_short_and_tested() -> None:
    files = sorted(EXAMPLES.glob("*.py"))
    assert {path.stem for path in files} == {*READING, "live_camera", "own_source"}
    assert all(len(path.read_text("utf-8").splitlines()) < 60 for path in files)


def test_a_file() -> None:
    lines = printed("file")
    assert all(re.search(r"head \d+", line) for line in lines)
    assert set(re.findall(r"head (\d+)", "\n".join(lines))) >= {"1", "2", "3"}
    last = [line for line in lines if line.startswith("2.300 s")]
    true = next(line for line in reversed((headvox.sample_folder() / "heads.jsonl").read_text().splitlines()))
    centres = re.findall(r'"centre": \[([^\]]+)\]', true)
    found = np.array([[float(v) for v in line.split()[-4:-1]] for line in last])
    for centre in centres:
        assert np.linalg.norm(found - np.array([float(v) for v in centre.split(",")]), axis=1).min() < 0.1


def test_two_cameras_see_more_together() -> None:
    counts = {line.split()[0]: [int(v) for v in re.findall(r"\d+", line)] for line in printed("two_cameras")}
    assert list(counts) == ["left", "right", "together"]
    assert counts["together"][1] > max(counts["left"][1], counts["right"][1])


def test_a_source_of_ones_own() -> None:
    assert printed("own_source") == ["10 heads in 10 frames, 1 with an id"]


def test_a_sink_of_ones_own(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(10)
        loaded("own_sink").main(headvox.sample_folder(), listener.getsockname())
        assert listener.recv(65_536).startswith(b'{"stamp_ns": 0, "frame": 0,')
    assert capsys.readouterr().out.startswith("sent 24 lines to 127.0.0.1:")


def test_speed_and_separation() -> None:
    words = [line.rsplit(": ", 1)[1] for line in printed("speed_and_separation")]
    assert len(words) == 24
    assert set(words) == {"go on", "stop"}


def test_the_protective_distance_is_what_the_parts_add_up_to() -> None:
    example = loaded("speed_and_separation")
    # 1.6 m/s for 0.4 s; 0.5 m/s for 0.1 s, and half of it for 0.3 s; 0.85 m; 3 (0.01 + 0.005) m
    assert example.protective_distance(0.0, 0.01) == pytest.approx(0.64 + 0.05 + 0.075 + 0.85 + 0.045)
    assert example.protective_distance(3.0, 0.01) == pytest.approx(1.2 + 0.05 + 0.075 + 0.85 + 0.045)
    assert not example.protective_distance(0.0, float("nan")) < 1e9


def test_a_live_camera_by_what_it_would_send(capsys: pytest.CaptureFixture[str]) -> None:
    frames = list(headvox.open_source(headvox.sample_folder()))
    assert isinstance(frames[0], headvox.Frame)
    dark = [replace(image, depth=np.zeros_like(image.depth)) for image in frames[0].depths]
    bad = headvox.BadFrame(0, "the cable"), replace(frames[0], depths=tuple(dark))
    loaded("live_camera").main([*bad, *frames])
    out, err = capsys.readouterr()
    lines = out.splitlines()
    told = err.splitlines()
    assert told[0] == "skipped: the cable"
    assert told[1].startswith("skipped: left: the depth image has no return at all.")
    assert len(lines) == 24
    assert lines[0].startswith("0 heads, nobody, ")
    assert re.match(r"[34] heads, nearest [12]\.\d\d m, ", lines[-1])


def test_a_live_camera_that_is_not_there() -> None:
    done = run("live_camera", "000000000000")
    assert (done.returncode, done.stdout) == (1, "")
    told = r"realsense: (no RealSense camera is plugged in|there is no camera 0)|RealSense cameras need the package"
    assert re.match(told, done.stderr)


@pytest.mark.parametrize("name", READING)
def test_a_source_that_is_not_there_is_one_line(name: str) -> None:
    done = run(name, "nowhere")
    assert (done.returncode, done.stdout) == (1, "")
    assert len(done.stderr.splitlines()) == 1
    assert "nowhere" in done.stderr
