"""Whether there is a GPU to use, and the searches on it, as a detector asks for them."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from headvox.cuda.readings import Asked, Found
from headvox.data import DepthImage
from headvox.errors import HeadvoxError, MissingExtra
from headvox.lattice import Lattice
from headvox.masks.compile import CompiledCascade
from headvox.voxelize import Rays

if TYPE_CHECKING:
    from headvox.cuda.search import Search

BATCH = 8  # frames that go at once, where several are known


class DeviceLost(Exception):
    """The GPU failed: nothing that is on it can be relied on."""


def is_simulated() -> bool:
    """Return whether Numba simulates a GPU, because NUMBA_ENABLE_CUDASIM is set."""
    from numba.core import config

    return bool(getattr(config, "ENABLE_CUDASIM", 0))


def check_device() -> None:
    """Run something small on the GPU.

    Raises:
        HeadvoxError: numba-cuda is missing, there is no GPU, or its driver is too old.
    """
    if importlib.util.find_spec("numba_cuda") is None:
        raise MissingExtra(
            'The backend "cuda" needs numba-cuda, which is not installed.',
            "cuda",
            instead='use the backend "cpu".',
        )
    try:
        from numba import cuda

        if not cuda.is_available():
            why = str(cuda.cuda_error() or "no device was found").strip().splitlines()
            raise HeadvoxError(
                f'The backend "cuda" finds no NVIDIA GPU to use: {" ".join(line for line in why if line)}',
                'Does nvidia-smi list one? If not, install NVIDIA\'s driver, or use the backend "cpu".',
            )
        from headvox.cuda.compact import count_bits

        bits, counts = cuda.to_device(np.array([[5]], np.uint32)), cuda.device_array((1, 1), np.int32)
        count_bits[1, 1](bits, counts)
        right = counts.copy_to_host()[0, 0] == 2
    except HeadvoxError:
        raise
    except Exception as error:  # whatever numba-cuda, the driver or the compiler behind it say
        raise HeadvoxError(
            f'The backend "cuda" cannot run on this GPU: {" ".join(str(error).split()) or type(error).__name__}',
            'Is NVIDIA\'s driver too old (nvidia-smi tells; CUDA 12 is needed)? Update it, or use the backend "cpu".',
        ) from error
    if not right:
        raise HeadvoxError('The backend "cuda" gets wrong numbers from this GPU.', 'Use the backend "cpu".')


def check_real_device() -> None:
    """As :func:`check_device`, and that it is no simulator: whose times mean nothing.

    Raises:
        HeadvoxError: the same, or NUMBA_ENABLE_CUDASIM is set.
    """
    check_device()
    if is_simulated():
        raise HeadvoxError(
            "NUMBA_ENABLE_CUDASIM is set: the times of a simulated GPU mean nothing.",
            "Unset it to measure a GPU.",
        )


def use_device(backend: str) -> bool:
    """Return whether a detector with this ``backend`` goes to the GPU; with "auto", if there is one.

    Raises:
        HeadvoxError: it is "cuda", and there is none that works.
    """
    if backend == "cpu":
        return False
    try:
        check_device()
    except HeadvoxError:
        if backend == "cuda":
            raise
        return False
    return backend == "cuda" or not is_simulated()


class Device:
    """The searches by one cascade on the GPU: for single frames and for batches, made when they are asked for."""

    def __init__(
        self,
        cascade: CompiledCascade,
        shape: tuple[int, int, int],
        around: npt.NDArray[np.int32],
        most_peaks: int,
        refines: str,
    ) -> None:
        from headvox.cuda.search import Search

        self.cascade, self.shape = cascade, shape
        self._searches: dict[int, Search] = {}
        self._make = partial(Search, cascade, shape, around, most_peaks, refines)

    def for_frames(self, count: int) -> Search:
        """Return the search for so many frames at once."""
        frames = 1 if count == 1 else BATCH
        if frames not in self._searches:
            self._searches[frames] = self._make(frames)
        return self._searches[frames]

    def search(self, asked: Sequence[Asked], rays_of: Callable[[DepthImage, Lattice], Rays]) -> list[Found]:
        """Return what is found in each of ``asked``, at most :data:`BATCH` frames.

        Raises:
            DeviceLost: the GPU failed.
        """
        try:
            return self.for_frames(len(asked)).run(asked, rays_of)
        except Exception as error:
            if not _is_of_device(error):
                raise
            told = " ".join(str(error).split()) or type(error).__name__
            if "OUT_OF_MEMORY" in told:
                told += "; it has too little memory: a smaller max_range_m or larger voxels need less"
            raise DeviceLost(told) from error


def _is_of_device(error: Exception) -> bool:
    """Return whether ``error`` comes from the driver, and is none of Python's or of ours."""
    module = type(error).__module__
    return module.startswith("numba.cuda.") or module.split(".")[0] == "cuda"
