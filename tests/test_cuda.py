"""The back end for GPUs, as far as a machine without one can tell; on_gpu*.py have what runs on the device."""

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
without_gpu = pytest.mark.skipif(GPU, reason="there is a GPU: this is about machines without")


def run_pytest(*files: str, **environment: str) -> None:
    """Run the tests of ``files`` in a process of its own, and fail with what it printed."""
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *(str(TESTS / file) for file in files)],
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
    run_pytest(
        "on_gpu.py", "on_gpu_fits.py", "on_gpu_frames.py", **({} if GPU else {"NUMBA_ENABLE_CUDASIM": "1"})
    )


@pytest.mark.skipif(
    not INSTALLED or importlib.util.find_spec("nvidia") is None, reason="needs headvox[against]: libNVVM"
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


def fails_with(text):
    """Return a stand-in for a kernel that the driver does not run."""
    from numba.cuda.cudadrv.driver import CudaAPIError

    class Kernel:
        def __getitem__(self, launch):
            raise CudaAPIError(222, text)

    return Kernel()


@pytest.mark.skipif(not INSTALLED, reason="numba-cuda is not installed")
@pytest.mark.parametrize("available", [True, False])
def test_a_driver_that_is_too_old_is_a_clear_error(monkeypatch, available):
    """It may be told at once, or by the first kernel."""
    from numba import cuda

    from headvox.cuda import compact

    told = "CUDA driver version is insufficient\nfor CUDA runtime version"
    monkeypatch.setattr(cuda, "is_available", lambda: available)
    monkeypatch.setattr(cuda, "cuda_error", lambda: None if available else told)
    monkeypatch.setattr(cuda, "to_device", lambda array: array)
    monkeypatch.setattr(cuda, "device_array", lambda shape, dtype: np.empty(shape, dtype))
    monkeypatch.setattr(compact, "count_bits", fails_with(told))
    with pytest.raises(HeadvoxError) as error:
        Detector(backend="cuda")
    assert "CUDA driver version is insufficient for CUDA runtime version" in error.value.what
    assert "nvidia-smi" in error.value.do
    assert "\n" not in error.value.what + error.value.do
    assert not Detector(backend="auto").on_device


@pytest.mark.skipif(not INSTALLED, reason="numba-cuda is not installed")
def test_what_comes_from_the_driver_is_told_from_our_own_faults():
    from numba.cuda.cudadrv import driver, error

    for of_device in (driver.CudaAPIError(719, "gone"), error.CudaSupportError("none")):
        assert device._is_of_device(of_device)
    for ours in (KeyError("a"), MemoryError(), HeadvoxError("a", "b"), ValueError("c")):
        assert not device._is_of_device(ours)


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
