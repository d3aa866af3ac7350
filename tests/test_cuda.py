"""The back end for GPUs, as far as a machine without one can tell; on_gpu.py has what runs on the device."""

import importlib.util
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import scenes

from headvox import Cloud, Detector, Frame, HeadvoxError
from headvox.cli import main
from headvox.config import DetectorConfig
from headvox.cuda import device

TESTS = Path(__file__).parent
INSTALLED = importlib.util.find_spec("numba_cuda") is not None


def there_is_a_gpu() -> bool:
    if not INSTALLED:
        return False
    from numba import cuda

    return bool(cuda.is_available())


GPU = there_is_a_gpu()
without_gpu = pytest.mark.skipif(GPU, reason="there is a GPU")


def run_pytest(file: str, **environment: str) -> None:
    """Run the tests of ``file`` in a process of its own, and fail with what it printed."""
    done = subprocess.run(
        [sys.executable, "-m", "pytest", str(TESTS / file)],
        env={**os.environ, **environment},
        cwd=TESTS.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.skipif(not INSTALLED, reason="numba-cuda is not installed")
def test_the_same_heads_on_a_gpu_or_in_the_simulator():
    """The variable has to be set before Numba is imported: so it needs a process of its own."""
    run_pytest("on_gpu.py", **({} if GPU else {"NUMBA_ENABLE_CUDASIM": "1"}))


@pytest.mark.skipif(
    not INSTALLED or importlib.util.find_spec("nvidia") is None, reason="needs headvox[cuda]: libNVVM"
)
def test_every_kernel_compiles_for_a_gpu():
    run_pytest("ptx_of_kernels.py")


SURE = DetectorConfig(min_score=-100.0, refine="sphere")
BUST = Frame(0, clouds=(Cloud("c", scenes.bust(np.random.default_rng(0), (0.0, 0.0, 1.5), 6000)),))


@without_gpu
def test_without_a_gpu_auto_is_the_cpu_and_says_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        detector = Detector(SURE, backend="auto")
        heads = detector.detect_frame(BUST)
    assert not detector.on_device
    assert len(heads) > 0
    assert heads.centres.tobytes() == Detector(SURE).detect_frame(BUST).centres.tobytes()


@without_gpu
def test_without_a_gpu_cuda_is_a_clear_error():
    with pytest.raises(HeadvoxError) as error:
        Detector(backend="cuda")
    assert 'The backend "cuda"' in error.value.what
    assert "\n" not in error.value.what + error.value.do
    assert "headvox[cuda]" in error.value.do or "nvidia-smi" in error.value.do


def test_without_numba_cuda_it_says_how_to_install_it(monkeypatch):
    monkeypatch.setattr(device.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(HeadvoxError, match=r"pip install 'headvox\[cuda\]'"):
        Detector(backend="cuda")
    assert not Detector(backend="auto").on_device


@without_gpu
def test_the_commands_end_with_1_and_one_clear_line(capsys):
    for command in (["run", "--limit", "1", "--backend", "cuda"], ["bench", "--backend", "cuda"]):
        assert main(command) == 1
        said = capsys.readouterr()
        assert said.out == ""
        assert '\nheadvox: error: The backend "cuda"' in f"\n{said.err}"
        assert "Traceback" not in said.err


@without_gpu
def test_run_with_auto_is_run_on_the_cpu(capsys):
    found = []
    for backend in ("auto", "cpu"):
        assert main(["run", "--limit", "2", "--no-track", "--json", "--backend", backend]) == 0
        said = capsys.readouterr()
        assert "GPU" not in said.err
        found.append([json.loads(line)["heads"] for line in said.out.splitlines()])
    assert found[0] == found[1] != []


def test_the_backend_is_a_setting():
    assert DetectorConfig().backend == "cpu"
    assert Detector(DetectorConfig(backend="auto"), backend="cpu").config.backend == "cpu"
    with pytest.raises(HeadvoxError, match='backend: expected "cpu", "cuda" or "auto"'):
        DetectorConfig(backend="gpu")


def test_a_batch_on_the_cpu_is_frame_by_frame():
    detector = Detector(SURE)
    alone = detector.detect_frame(BUST)
    batch = detector.detect_batch([BUST, BUST])
    assert [heads.centres.tobytes() for heads in batch] == 2 * [alone.centres.tobytes()]
    assert len(alone) > 0
    assert detector.detect_batch([]) == []


def test_a_detector_on_the_cpu_loads_nothing_of_cuda():
    script = "import sys, headvox; headvox.Detector(); print(any(n.startswith('numba.cuda.') for n in sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
