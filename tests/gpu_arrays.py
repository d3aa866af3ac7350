"""Arrays on a GPU, or in Numba's simulator of one, as the tests of the back end for GPUs make them."""

import sys
import threading

import numpy as np
import scenes
from numba import cuda

from headvox import Cloud, Frame
from headvox.cuda import fits as fits_module
from headvox.cuda import (
    readings,
    search,
    suppress,
)
from headvox.cuda.device import is_simulated
from headvox.integral import integral_volume
from headvox.masks.read import parse_cascade
from headvox.pose import fit as pose_on_cpu

sys.setswitchinterval(2e-5)  # the simulator's threads wait for each other busily

METRES, RADIANS = 1e-6, 1e-6
"""How far what is fitted may be from the CPU's: sums have another order, and functions other last bits."""
STAGES = parse_cascade(scenes.STAGES, "test")
VOTES = parse_cascade(scenes.VOTES, "test")
REGION = scenes.region(0.3, -0.2, 0.2)
UPRIGHT, ANYHOW = pose_on_cpu.upright_turns(), pose_on_cpu.all_turns()


def shared_array(self, shape, dtype, alignment=None):
    """Stand for the simulator's shared.array, which gives two threads that ask at once an array each."""
    asking = sys._getframe(1)
    place = asking.f_code.co_filename, asking.f_lineno
    with SHARING:
        if place not in self._allocations:
            self._allocations[place] = np.empty(shape, dtype)
        return self._allocations[place]


SHARING = threading.Lock()
if is_simulated():
    from numba.cuda.simulator.kernelapi import FakeCUDAShared

    FakeCUDAShared.array = shared_array


def on(frames=1, sensors=1):
    """Return a launch of a few blocks."""
    return (2, frames, sensors), search.THREADS


def to_device(*arrays):
    return [cuda.to_device(np.ascontiguousarray(array)) for array in arrays]


def words_for(asked):
    """Return how long a row is that has room for each of these."""
    return -(-max(readings.words_of(one) for one in asked) // readings.OCTET) * readings.OCTET


def zeros(*shape, dtype=np.uint32):
    return cuda.to_device(np.zeros(shape, dtype))


def volume_of(cells):
    """Return the integral volume of a grid on the device, as a batch of one."""
    return cuda.to_device(integral_volume(cells)[None])


def random_parts(rng, shape, share=0.15):
    return (rng.integers(0, 256, shape) * (rng.random(shape) < share)).astype(np.uint8)


def places_of(cells, shape):
    """Return the places of cells: see headvox.cuda.gate."""
    x, y, z = (np.asarray(cells).reshape(-1, 3) + 1).T
    return ((x * (shape[1] + 2) + y) * (shape[2] + 2) + z).astype(np.int32)[None]


def counts_with(which, count, frames=1):
    counts = np.zeros((frames, suppress.HEADS + 1), np.int32)
    counts[:, which] = count
    return cuda.to_device(counts)


def cloud_of(points):
    return Frame(0, clouds=(Cloud("cloud", np.array(points, np.float32).reshape(-1, 3)),))


def use_few_turns(monkeypatch):
    """Let both start from few turns: the simulator takes seconds for what a CPU does in a millisecond."""
    for module in (pose_on_cpu, fits_module):
        monkeypatch.setattr(module, "upright_turns", lambda: UPRIGHT[::5].copy())
        monkeypatch.setattr(module, "all_turns", lambda: ANYHOW[::20].copy())
