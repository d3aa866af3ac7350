"""The mean head that :mod:`headvox.pose.align` aligns: signed distances, how heads vary, and how far to trust them."""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np

from headvox.data import F32, F64

MODES = 16
FINE_MODES = 10  # those that lie in one line of the cache with all before them
LINE = 16  # of a cache, in float32
ROW = 2 * LINE  # distance, gradient (3), sigma, modes, the rest unused


class Template(NamedTuple):
    """The mean head on a grid in its own frame, made by ``tools/bake_template.py``.

    ``rows`` (X * Y * Z, ROW) float32: of each voxel's centre the signed distance to the surface (m, above zero
    outside), its gradient, the standard deviation (m) of a real surface from the fitted one, and the change of the
    distance (m) for a step of one standard deviation along each mode of shape. ``shape`` is X, Y, Z, ``low`` (3,) the
    corner of the first voxel, ``radius_m`` the radius of the sphere that fits the mean head.

    The others are learnt from what fits of known heads were off by. The first three turn what a fit costs into
    probabilities: two poses whose evidence differs by ``temperature`` are e times as probable, and the covariances of
    shift and turn are multiplied by ``shift_factor`` and ``turn_factor``. ``centre_of_shape`` (3, 2 + MODES) says where
    the centre (m) of a head that is seen all around is from the fitted one: a linear function of 1, log scale and
    modes, in the axes and at the size of the mean head.
    """

    rows: F32
    shape: tuple[int, int, int]
    low: F64
    voxel_m: float
    radius_m: float
    temperature: float
    shift_factor: float
    turn_factor: float
    centre_of_shape: F64


@lru_cache(maxsize=1)
def load_template() -> Template:
    """Read the template that comes with headvox, once."""
    path = files("headvox").joinpath("assets/template.npz")
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as asset:
        mean = asset["mean"] * np.float32(asset["mean_unit_m"])
        modes = asset["modes"] * asset["mode_units_m"].astype(np.float32)[:, None, None, None]
        sigma = asset["sigma"] * np.float32(asset["sigma_unit_m"])
        temperature, shift, turn = (float(v) for v in asset["calibration"])
        of_shape = asset["centre_of_shape"]
        low, voxel_m, size_m = asset["low_m"], float(asset["voxel_m"]), float(asset["size_m"])
    rows = _aligned((*mean.shape, ROW))
    rows[..., 0] = mean
    rows[..., 1:4] = np.stack(np.gradient(mean, voxel_m), axis=-1)
    rows[..., 4] = sigma
    rows[..., 5 : 5 + MODES] = np.moveaxis(modes, 0, -1)
    flat = rows.reshape(-1, ROW)
    return Template(flat, mean.shape, low, voxel_m, 0.5 * size_m, temperature, shift, turn, of_shape)


def _aligned(shape: tuple[int, ...]) -> F32:
    """Return zeros that begin where a line of the cache does."""
    size = int(np.prod(shape))
    room = np.zeros(size + LINE, np.float32)
    first = -room.ctypes.data // room.itemsize % LINE
    return room[first : first + size].reshape(shape)
