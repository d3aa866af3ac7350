"""What the machine is said to be, and that a verdict can be bad."""

import json
import subprocess
import sys
from importlib.metadata import metadata
from pathlib import Path

import pytest

from headvox.cli import main
from headvox.commands import doctor


def test_everything_is_told_and_heads_are_found(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["good"] is True
    checks = {check["name"]: check for check in told["checks"]}
    assert {"headvox", "Python", "numpy", "numba", "llvmlite", "scipy", "GPU", "RealSense", "ROS 2"} <= set(
        checks
    )
    import numba

    assert checks["numba"]["told"] == numba.__version__
    assert checks["compiled loops"]["good"] is True
    assert checks["detection"]["told"].startswith("3 of 3 heads")


def test_heads_that_are_missed_fail(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "DETECT", "print(2, 3, 0.01, 5.0)")
    monkeypatch.setattr(doctor, "LIBRARIES", ("numpy", "no-such-library"))
    assert main(["doctor"]) == 1
    out = capsys.readouterr().out
    assert "2 of 3 heads" in out
    assert "missing: pip install no-such-library" in out
    assert out.count("FAILED") == 3  # two checks, and the last line


def test_a_check_that_hangs_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "DETECT", "import time; time.sleep(60)")
    monkeypatch.setattr(doctor, "LONG_S", 0.5)
    check = doctor._detection()
    assert check.good is False
    assert "longer than 0.5 s" in check.told


def test_a_distance_that_is_too_large_is_not_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "WITHIN_M", 1e-6)
    assert doctor.find_true_heads()[0] == 0


def test_looking_for_it_imports_nothing_heavy() -> None:
    script = "import sys; from headvox.commands import doctor; "
    script += "doctor._gpu(); doctor._ros(); doctor._extra('view', ('rerun',));"
    script += "print(*{'numba', 'rerun', 'rclpy', 'pyrealsense2'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_an_extra_is_there_when_all_of_its_packages_are(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    packages = [f"of_the_test.{name}" for name in ("compiler", "loader")]
    told = doctor._extra("cuda", ("json", *packages)).told
    assert told == "no of_the_test.compiler, of_the_test.loader: pip install 'headvox[cuda]'"
    (tmp_path / "of_the_test" / "compiler").mkdir(parents=True)
    assert doctor._extra("cuda", ("json", *packages)).told.startswith("no of_the_test.loader:")
    (tmp_path / "of_the_test" / "loader").mkdir()
    assert doctor._extra("cuda", ("json", *packages)).told == "installed"


def test_numba_cuda_alone_is_not_the_extra() -> None:
    """It comes with ``dev``, too, without NVIDIA's compiler."""
    assert {"nvidia.cuda_nvcc", "nvidia.cuda_nvrtc"} < set(doctor.EXTRAS["cuda"])


def test_every_extra_for_users_is_looked_for() -> None:
    extras = set(metadata("headvox").get_all("Provides-Extra") or [])
    assert set(doctor.EXTRAS) == extras - {"dev", "against", "synth"}
