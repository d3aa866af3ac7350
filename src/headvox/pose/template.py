"""The mean head that :mod:`headvox.pose.align` aligns: signed distances, how heads vary, and how far to trust them."""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np

from headvox.data import F64, I64

MODES = 16
FINE_MODES = 10  # those that states are refined with
LINE = 8  # of a cache, in float64
# A voxel is WORDS numbers of 64 bits: two voxels share a line of the cache. In the first lie four numbers of 16 bits,
# in the others as many of 8 bits as there is room for, all signed, the first in the lowest bits.
WORDS, SHORTS, BYTES = 4, 4, 24
DISTANCE_AT, GRADIENT_AT = 0, 1  # of the shorts
SIGMA_AT, MODES_AT = 0, 1  # of the bytes


class Template(NamedTuple):
    """The mean head on a grid in its own frame, made by ``tools/bake_template.py``.

    ``voxels`` (X * Y * Z + 1, WORDS) int64 say of each voxel's centre the signed distance to the surface (above zero
    outside) in ``distance_unit_m``, its gradient (3) in ``gradient_unit``, the standard deviation of a real surface
    from the fitted one in ``sigma_unit_m``, and the change of the distance for a step of one standard deviation along
    each mode of shape in ``mode_units_m`` (MODES,). The last one stands for all that lies outside of the grid: nothing
    there is of any distance, nor changes it. ``shape`` is X, Y, Z, ``low`` (3,) the corner of the first voxel,
    ``radius_m`` the radius of the sphere that fits the mean head.

    The others are learnt from what fits of known heads were off by. The first three turn what a fit costs into
    probabilities: two poses whose evidence differs by ``temperature`` are e times as probable, and the covariances of
    shift and turn are multiplied by ``shift_factor`` and ``turn_factor``. ``centre_of_shape`` (3, 2 + MODES) says where
    the centre (m) of a head that is seen all around is from the fitted one: a linear function of 1, log scale and
    modes, in the axes and at the size of the mean head.
    """

    voxels: I64
    distance_unit_m: float
    gradient_unit: float
    sigma_unit_m: float
    mode_units_m: F64
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
        mean, sigma, modes = asset["mean"], asset["sigma"], asset["modes"]
        units = [float(asset[name]) for name in ("mean_unit_m", "sigma_unit_m")]
        mode_units_m = asset["mode_units_m"]
        temperature, shift, turn = (float(v) for v in asset["calibration"])
        of_shape = asset["centre_of_shape"]
        low, voxel_m, size_m = asset["low_m"], float(asset["voxel_m"]), float(asset["size_m"])
    distance_unit_m, sigma_unit_m = units
    shorts, in_bytes = np.zeros((mean.size + 1, SHORTS), "<i2"), np.zeros((mean.size + 1, BYTES), "<i1")
    shorts[:-1, DISTANCE_AT] = mean.reshape(-1)
    # Half a unit a voxel is the unit of a gradient: differences over two voxels are whole ones of it.
    shorts[:-1, GRADIENT_AT:] = np.stack(np.gradient(2.0 * mean), axis=-1).reshape(-1, 3)
    in_bytes[:, SIGMA_AT] = 1  # outside, too: it is a divisor
    in_bytes[:-1, SIGMA_AT] = sigma.reshape(-1)
    in_bytes[:-1, MODES_AT : MODES_AT + MODES] = modes.reshape(MODES, -1).T
    voxels = _aligned((mean.size + 1, WORDS))
    voxels[:, :1], voxels[:, 1:] = shorts.view("<i8"), in_bytes.view("<i8")
    return Template(
        voxels, distance_unit_m, 0.5 * distance_unit_m / voxel_m, sigma_unit_m, mode_units_m, mean.shape, low, voxel_m,
        0.5 * size_m, temperature, shift, turn, of_shape,
    )  # fmt: skip


def _aligned(shape: tuple[int, int]) -> I64:
    """Return zeros that begin where a line of the cache does."""
    size = shape[0] * shape[1]
    room = np.zeros(size + LINE, np.int64)
    first = -room.ctypes.data // room.itemsize % LINE
    return room[first : first + size].reshape(shape)
