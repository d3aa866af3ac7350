"""What the compiler for GPUs makes of every kernel: it needs NVIDIA's libNVVM (extra "cuda"), but no GPU.

test_cuda.py runs this file in a process of its own: it stands in for the device that numba-cuda asks, and instead of
being launched, a kernel is compiled for the arguments that it would be given.
"""

import importlib.util
import os
import re
import subprocess
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numba
import numpy as np
import pytest
import scenes
from numba import cuda
from numba.cuda import dispatcher

from headvox.data import Cloud, Frame
from headvox.lattice import Lattice
from headvox.masks.compile import compile_cascade
from headvox.masks.read import load_cascade, parse_cascade
from headvox.suppress import AROUND

KERNELS = 24
MOST_THREADS, REGISTERS = 256, 1 << 16  # of a block
FITS = {"fit_spheres", "gather", "fit_starts", "settle_heads"}  # within a tolerance of the CPU's


class OnHost(np.ndarray):
    """An array that stands for one on the device."""

    def copy_to_device(self, other, stream=0):
        np.copyto(self, other)

    def copy_to_host(self, other, stream=0):
        np.copyto(other, self)


def type_of(value):
    if hasattr(value, "_fields"):
        return numba.types.NamedTuple([type_of(item) for item in value], type(value))
    if isinstance(value, tuple):
        return numba.types.Tuple([type_of(item) for item in value])
    if isinstance(value, np.ndarray):
        return numba.types.Array(numba.typeof(np.asarray(value)).dtype, value.ndim, "C")
    return numba.typeof(value)


@pytest.fixture
def compiled(monkeypatch):
    """Return a dictionary that fills with the PTX of what is launched."""
    ptx = {}

    def compile_instead(kernel, _):
        def launch(*args):
            types = tuple(type_of(value) for value in args)
            name = kernel.py_func.__name__
            if (name, types) not in ptx:
                ptx[name, types], _ = cuda.compile_ptx(kernel.py_func, types, cc=(9, 0))

        return launch

    monkeypatch.setattr(dispatcher, "get_current_device", lambda: SimpleNamespace(compute_capability=(9, 0)))
    monkeypatch.setattr(dispatcher.CUDADispatcher, "__getitem__", compile_instead)
    monkeypatch.setattr(cuda, "device_array", lambda shape, dtype: np.zeros(shape, dtype).view(OnHost))
    monkeypatch.setattr(cuda, "pinned_array", lambda shape, dtype: np.zeros(shape, dtype))
    monkeypatch.setattr(cuda, "to_device", lambda array: np.array(array).view(OnHost))
    monkeypatch.setattr(cuda, "stream", lambda: SimpleNamespace(synchronize=lambda: None))
    return ptx


def assembles(ptx):
    """Whether the code for the device lacks nothing, fits a block's registers and shared memory, and spills nothing."""
    ptxas = Path(importlib.util.find_spec("nvidia").submodule_search_locations[0]) / "cuda_nvcc/bin/ptxas"
    with tempfile.NamedTemporaryFile("w", suffix=".ptx") as file:
        file.write(ptx)
        file.flush()
        done = subprocess.run(
            [ptxas, "-arch=sm_90", "-v", "-o", os.devnull, file.name],
            capture_output=True,
            text=True,
            check=False,
        )
    told = done.stdout + done.stderr
    assert done.returncode == 0, told
    registers = int(re.search(r"Used (\d+) registers", told)[1])
    return registers * MOST_THREADS <= REGISTERS and "0 bytes spill stores" in told


def test_every_kernel_compiles_and_rounds_every_product(compiled):
    """No a * b + c became one operation that rounds once, which the CPU does not have."""
    from headvox.cuda.readings import Asked
    from headvox.cuda.search import Search

    frame = Frame(0, clouds=(Cloud("c", np.zeros((1, 3), np.float32)),))
    for cascade in (
        parse_cascade(scenes.STAGES, "test"),
        parse_cascade(scenes.VOTES, "test"),
        load_cascade("default"),
    ):
        lattice = Lattice.over(scenes.region(), cascade.voxel_m, cascade.subdivision)
        made = compile_cascade(cascade)
        search = Search(made, lattice.shape, AROUND[made.gate.spacing], 256, "pose", 1)
        search.run([Asked(frame, lattice, False, 0)], lambda *_: pytest.fail("no camera"))
    assert len({name for name, _ in compiled}) == KERNELS
    for (name, _), text in compiled.items():
        assert ".visible .entry" in text
        assert name in FITS or not re.search(r"\b(fma|mad)\.(rn\.)?f(32|64)", text), name
    assert all(assembles(text) for text in compiled.values())
    assert "mul.rn.f32" in next(text for (name, _), text in compiled.items() if name == "mark")
