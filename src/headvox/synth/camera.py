"""Simulated depth sensors: from what a camera should see to what it delivers.

Each imperfection is a small function on the disparity image (float32, pixels, 0 = nothing). Structured-light
and stereo cameras measure disparity d = f B / z, so that errors are simple there: an error of s pixels is
sigma_z = z^2 s / (f B) in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from headvox.data import F32, F64, U16, Cloud, Intrinsics
from headvox.synth.rays import NOTHING, ROOM_ID, Mesh, View, spin

Mask = npt.NDArray[np.bool_]
Shape = tuple[int, int]

HIGHLIGHT_LEAST = 0.35  # the gloss from which a highlight can blind a pixel that faces the camera
HIGHLIGHT_SLOPE = 12.0  # how fast that fades with the angle: at gloss 0.6 it is gone at 12 degrees
SIGNAL_REFERENCE_M = 4.0


@dataclass(frozen=True, slots=True)
class Sensor:
    """What a kind of depth camera gets wrong, and by how much. Zeros everywhere is the ideal camera.

    ``baseline_m``   distance to the second imager or the projector; negative: it is on the left
    ``noise_px``     standard deviation of the disparity; ``noise_size_px`` how far neighbours share it
    ``step_px``      the disparity is delivered in such steps
    ``fatten_px``    things grow by so much at their edges, because blocks of pixels are matched
    ``wobble_px``    how far contours wander, for the same reason
    ``flying``       share of the pixels at an edge that lie between foreground and background
    ``shadow``       pixels that only one of imager and projector sees have no return
    ``weak``         signal that is still seen, as a share of what albedo 0.5 sends straight back from 4 m
    ``edge_holes``   0..1, ragged holes along the edges of things and of the image
    ``hole_px``      how large the blobs are in which returns are lost
    ``salt``         share of the pixels lost for no reason
    ``near_m`` ``far_m``  the range that is delivered
    ``border_px``    columns and rows without return: left, right, top, bottom
    ``cut_out``      the background was removed: only people are left (ids from 2 on)
    """

    name: str
    baseline_m: float = 0.05
    noise_px: float = 0.0
    noise_size_px: float = 2.0
    step_px: float = 0.0
    fatten_px: int = 0
    wobble_px: float = 0.0
    flying: float = 0.0
    shadow: bool = False
    weak: float = 0.0
    edge_holes: float = 0.0
    hole_px: float = 4.0
    salt: float = 0.0
    near_m: float = 0.0
    far_m: float = 60.0
    border_px: tuple[int, int, int, int] = (0, 0, 0, 0)
    cut_out: bool = False


IDEAL = Sensor("ideal")


def d435i(rng: np.random.Generator | None = None) -> Sensor:
    """An Intel RealSense D435i; with ``rng``, one of those seen in the field, from clean to terrible."""
    usual = Sensor(
        "d435i",
        baseline_m=0.050,
        noise_px=0.08,
        noise_size_px=2.0,
        step_px=1.0 / 32.0,
        fatten_px=1,
        wobble_px=0.8,
        flying=0.35,
        shadow=True,
        weak=0.06,
        edge_holes=0.2,
        salt=0.001,
        near_m=0.28,
        far_m=8.0,
    )
    if rng is None:
        return usual
    bad = rng.uniform()
    return replace(
        usual,
        noise_px=float(rng.uniform(0.03, 0.08 + 0.10 * bad)),
        noise_size_px=float(rng.uniform(1.0, 3.5)),
        fatten_px=int(rng.integers(0, 3)),
        wobble_px=float(rng.uniform(0.0, 0.6 + 1.2 * bad)),
        hole_px=float(rng.uniform(2.0, 6.0)),
        flying=float(rng.uniform(0.0, 0.2 + 0.6 * bad)),
        shadow=bool(rng.uniform() < 0.85),
        weak=float(np.exp(rng.uniform(np.log(0.008), np.log(0.03 + 0.25 * bad)))),
        edge_holes=float(rng.uniform(0.0, 0.1 + 0.5 * bad)),
        salt=float(rng.uniform(0.0, 0.008) * bad),
        far_m=float(rng.uniform(3.5, 6.0) if rng.uniform() < 0.25 else rng.uniform(6.0, 12.0)),
    )


def kinect(rng: np.random.Generator | None = None) -> Sensor:
    """A Kinect v1 or an Asus Xtion; with ``rng``, one of those seen in the field, from clean to terrible."""
    usual = Sensor(
        "kinect",
        baseline_m=0.075,
        noise_px=0.07,
        noise_size_px=3.0,
        hole_px=6.0,
        step_px=1.0 / 8.0,
        fatten_px=1,
        wobble_px=1.5,
        flying=0.02,
        shadow=True,
        weak=0.06,
        edge_holes=0.4,
        salt=0.0005,
        near_m=0.5,
        far_m=6.0,
        border_px=(0, 8, 0, 0),
    )
    if rng is None:
        return usual
    bad = rng.uniform()
    return replace(
        usual,
        baseline_m=0.075 if rng.uniform() < 0.5 else -0.075,
        noise_px=float(rng.uniform(0.03, 0.08 + 0.05 * bad)),
        noise_size_px=float(rng.uniform(1.5, 5.0)),
        fatten_px=int(rng.integers(0, 3)),
        wobble_px=float(rng.uniform(0.5, 1.2 + 1.5 * bad)),
        hole_px=float(rng.uniform(4.0, 10.0)),
        flying=float(rng.uniform(0.0, 0.06)),
        weak=float(np.exp(rng.uniform(np.log(0.01), np.log(0.05 + 0.25 * bad)))),
        edge_holes=float(rng.uniform(0.0, 0.3 + 0.7 * bad)),
        salt=float(rng.uniform(0.0, 0.004) * bad),
        far_m=float(rng.uniform(3.2, 6.0) if rng.uniform() < 0.3 else rng.uniform(6.0, 10.0)),
        border_px=_border(rng),
    )


def _border(rng: np.random.Generator) -> tuple[int, int, int, int]:
    kind = rng.uniform()
    if kind < 0.6:
        return (0, 8, 0, 0)
    if kind < 0.8:  # depth that was mapped into the colour camera keeps a frame of nothing
        left, right, top, bottom = (int(n) for n in rng.integers(5, 40, 4))
        return (left, right, top, bottom)
    return (0, 0, 0, 0)


def measure(
    view: View, intrinsics: Intrinsics, sensor: Sensor, lasting: np.random.Generator, rng: np.random.Generator
) -> U16:
    """Turn a perfect view into the depth image of a sensor: (height, width) uint16, 0 = no return.

    ``lasting`` draws what stays from frame to frame (seed it the same for every frame of a still camera),
    ``rng`` what is new in each.
    """
    if sensor.noise_px == 0.0 and sensor.step_px == 0.0 and sensor.wobble_px == 0.0:
        return _to_image(view.distance_m, sensor, intrinsics.depth_scale)
    focal_baseline = intrinsics.fx * abs(sensor.baseline_m)
    with np.errstate(divide="ignore"):
        perfect = np.float32(focal_baseline) / view.distance_m  # nothing is infinitely far: disparity 0
    edges = edge_strength(perfect)
    hole = weak_returns(view, sensor.weak, sensor.hole_px, lasting, rng)
    hole |= ragged_edges(edges, sensor.edge_holes, sensor.hole_px, lasting, rng)
    hole |= salt(perfect.shape, sensor.salt, rng)
    hole |= border(perfect.shape, sensor.border_px)
    if sensor.cut_out:
        hole |= view.ids <= ROOM_ID
    if sensor.shadow:
        hole |= shadow(perfect, sensor.baseline_m < 0.0)
    disparity = fattened(perfect, sensor.fatten_px)
    disparity = wobble(disparity, sensor.wobble_px, rng)
    disparity = flying_pixels(disparity, edges, sensor.flying, rng)
    disparity = noisy(disparity, sensor.noise_px, sensor.noise_size_px, rng)
    disparity = in_steps(disparity, sensor.step_px)
    with np.errstate(divide="ignore"):
        distance = np.where(
            hole | (disparity <= 0.0), np.float32(np.inf), np.float32(focal_baseline) / disparity
        )
    return _to_image(distance.astype(np.float32), sensor, intrinsics.depth_scale)


def _to_image(distance_m: F32, sensor: Sensor, depth_scale: float) -> U16:
    seen = (distance_m >= sensor.near_m) & (distance_m <= min(sensor.far_m, 65535 * depth_scale))
    return np.where(seen, np.rint(np.where(seen, distance_m, 0.0) / depth_scale), 0.0).astype(np.uint16)


def noise_field(rng: np.random.Generator, shape: Shape, size_px: float) -> F32:
    """Normal noise (height, width) float32 of unit variance whose neighbours within ``size_px`` are alike."""
    stride = max(1, int(size_px / 1.5))
    coarse = (shape[0] // stride + 2, shape[1] // stride + 2)
    sigma = size_px / stride
    white = rng.standard_normal(coarse, dtype=np.float32)
    smooth = ndimage.gaussian_filter(white, sigma, mode="wrap", truncate=3.0)
    smooth /= max(float(smooth.std()), 1e-6)
    if stride == 1:
        return np.ascontiguousarray(smooth[: shape[0], : shape[1]])
    rows = _stretch(smooth, shape[0], stride)
    return np.ascontiguousarray(_stretch(rows.T, shape[1], stride).T)


def _stretch(coarse: F32, length: int, stride: int) -> F32:
    """Linear interpolation of the first axis to ``length`` rows, ``stride`` fine rows a coarse one."""
    position = np.arange(length) / stride
    below = position.astype(np.int64)
    share = (position - below).astype(np.float32)[:, None]
    return np.asarray(coarse[below] * (1.0 - share) + coarse[below + 1] * share, np.float32)


def edge_strength(disparity: F32) -> F32:
    """How far (0..1) each pixel is inside a few pixels' reach of a jump in depth: (height, width) float32."""
    limit = 0.03 * np.maximum(disparity, 1.0)  # 3 % of the distance is a jump, a slanted floor is not
    down = np.abs(np.diff(disparity, axis=0)) > limit[:-1]
    right = np.abs(np.diff(disparity, axis=1)) > limit[:, :-1]
    jump = np.zeros(disparity.shape, np.bool_)
    jump[:-1] |= down
    jump[1:] |= down
    jump[:, :-1] |= right
    jump[:, 1:] |= right
    return np.asarray(ndimage.gaussian_filter(jump.astype(np.float32), 2.0, truncate=2.0))


def shadow(disparity: F32, second_is_left: bool) -> Mask:
    """Pixels that the second imager (or the projector) does not see, because something nearer hides them."""
    columns = np.arange(disparity.shape[1], dtype=np.float32)
    if second_is_left:
        elsewhere = columns + disparity
        dark = elsewhere < np.maximum.accumulate(elsewhere, axis=1) - 1.0
    else:
        elsewhere = columns - disparity
        dark = elsewhere > np.minimum.accumulate(elsewhere[:, ::-1], axis=1)[:, ::-1] + 1.0
    return without_slits(dark)


def without_slits(hole: Mask) -> Mask:
    """Holes without those thinner than three pixels: blocks of pixels are matched, which bridges them."""
    return np.asarray(ndimage.binary_opening(hole, np.ones((3, 3), np.bool_)))


def weak_returns(
    view: View, weak: float, hole_px: float, lasting: np.random.Generator, rng: np.random.Generator
) -> Mask:
    """Pixels whose light comes back too weak, in blobs: dark, slanted, far or glossy surfaces.

    What a glossy surface mirrors is lost, but where it faces the camera: there the highlight blinds the pixel.
    """
    if weak <= 0.0:
        return np.zeros(view.ids.shape, np.bool_)
    with np.errstate(divide="ignore", invalid="ignore"):
        scattered = view.albedo * (1.0 - view.gloss)
        signal = (scattered / 0.5) * view.cosine * (SIGNAL_REFERENCE_M / view.distance_m) ** 2
        strength = np.log(signal / weak)
    shape = view.ids.shape
    blobs = 0.45 * noise_field(lasting, shape, hole_px) + 0.25 * noise_field(rng, shape, 0.6 * hole_px)
    dazzled = view.gloss * (1.0 + blobs) > HIGHLIGHT_SLOPE * (1.0 - view.cosine) + HIGHLIGHT_LEAST
    return without_slits((~(strength + blobs > 0.0) | dazzled) & (view.ids != NOTHING))


def ragged_edges(
    edges: F32, strength: float, hole_px: float, lasting: np.random.Generator, rng: np.random.Generator
) -> Mask:
    """Ragged holes that eat into the edges of things and of the image."""
    if strength <= 0.0:
        return np.zeros(edges.shape, np.bool_)
    shape = edges.shape
    blobs = 0.7 * noise_field(lasting, shape, hole_px) + 0.7 * noise_field(rng, shape, 0.6 * hole_px)
    frame = np.zeros(shape, np.float32)
    frame[:2], frame[-2:], frame[:, :2], frame[:, -2:] = 1.0, 1.0, 1.0, 1.0
    reach = np.maximum(edges, ndimage.gaussian_filter(frame, 3.0, truncate=2.0))
    return np.asarray((reach > 0.02) & (reach * 4.0 * strength + 0.6 * blobs > 1.0))


def salt(shape: Shape, share: float, rng: np.random.Generator) -> Mask:
    """Lost single pixels, and some small clusters."""
    if share <= 0.0:
        return np.zeros(shape, np.bool_)
    lost = rng.random(shape, dtype=np.float32)
    clusters = ndimage.binary_dilation(lost < share / 20.0, iterations=2)
    return np.asarray(clusters | (lost > 1.0 - share / 2.0))


def border(shape: Shape, border_px: tuple[int, int, int, int]) -> Mask:
    """The columns and rows that never have a return: left, right, top, bottom."""
    left, right, top, bottom = border_px
    outside = np.ones(shape, np.bool_)
    outside[top : shape[0] - bottom, left : shape[1] - right] = False
    return outside


def fattened(disparity: F32, fatten_px: int) -> F32:
    """Let near things cover ``fatten_px`` pixels more at their edges."""
    if fatten_px <= 0:
        return disparity
    nearest = ndimage.maximum_filter(disparity, 2 * fatten_px + 1)
    return np.where(nearest > 1.03 * np.maximum(disparity, 1.0), nearest, disparity)


def wobble(disparity: F32, wobble_px: float, rng: np.random.Generator) -> F32:
    """Let contours wander: each pixel looks a little beside itself, its neighbours likewise."""
    if wobble_px <= 0.0:
        return disparity
    height, width = disparity.shape
    dv = np.rint(wobble_px * noise_field(rng, disparity.shape, 3.0)).astype(np.int64)
    du = np.rint(wobble_px * noise_field(rng, disparity.shape, 3.0)).astype(np.int64)
    v = np.clip(np.arange(height)[:, None] + dv, 0, height - 1)
    u = np.clip(np.arange(width) + du, 0, width - 1)
    beside = disparity[v, u]
    # Only contours wander: on a surface that is all of a piece the pixel's own depth stays.
    return np.where(np.abs(beside - disparity) > 0.03 * np.maximum(disparity, 1.0), beside, disparity)


def flying_pixels(disparity: F32, edges: F32, share: float, rng: np.random.Generator) -> F32:
    """Some pixels at an edge get a depth between the thing and what is behind it."""
    if share <= 0.0:
        return disparity
    chosen = np.nonzero((edges > 0.3) & (rng.random(edges.shape, dtype=np.float32) < share))
    front = ndimage.maximum_filter(disparity, 3)[chosen]
    back = ndimage.minimum_filter(disparity, 3)[chosen]
    mixed = disparity.copy()
    mixed[chosen] = back + (front - back) * rng.random(len(front), dtype=np.float32)
    return mixed


def noisy(disparity: F32, noise_px: float, size_px: float, rng: np.random.Generator) -> F32:
    """Add noise of standard deviation ``noise_px``, most of it shared within ``size_px``, some wider."""
    if noise_px <= 0.0:
        return disparity
    fine = noise_field(rng, disparity.shape, size_px)
    wide = noise_field(rng, disparity.shape, 8.0 * size_px)
    noise = np.float32(noise_px) * (np.float32(np.sqrt(0.8)) * fine + np.float32(np.sqrt(0.2)) * wide)
    return np.where(disparity > 0.0, disparity + noise, np.float32(0.0))


def in_steps(disparity: F32, step_px: float) -> F32:
    """Round to whole steps."""
    if step_px <= 0.0:
        return disparity
    return np.asarray(np.rint(disparity / np.float32(step_px)) * np.float32(step_px))


@dataclass(frozen=True, slots=True)
class Lidar:
    """A spinning LiDAR: rings of beams between two elevations."""

    name: str = "lidar"
    rings: int = 32
    columns: int = 1024
    lowest_rad: float = -0.436
    highest_rad: float = 0.262
    noise_m: float = 0.015
    lost: float = 0.02
    near_m: float = 0.3
    far_m: float = 40.0

    def elevations(self) -> F64:
        """Elevations of the rings (rings,) float64, ascending."""
        return np.linspace(self.lowest_rad, self.highest_rad, self.rings)


def sweep(mesh: Mesh, lidar: Lidar, T_world_sensor: F64, rng: np.random.Generator) -> tuple[Cloud, View]:
    """One turn of a LiDAR: the cloud in the sensor's frame (lost beams are NaN) and the perfect view."""
    view, rays = spin(mesh, lidar.elevations(), lidar.columns, T_world_sensor)
    distance = view.distance_m + np.float32(lidar.noise_m) * rng.standard_normal(
        view.ids.shape, dtype=np.float32
    )
    weak = (view.albedo / 0.5) * view.cosine * (10.0 / np.maximum(view.distance_m, 0.1)) ** 2 < 0.05
    lost = weak | (rng.random(view.ids.shape, dtype=np.float32) < lidar.lost)
    lost |= ~((distance > lidar.near_m) & (distance < lidar.far_m))
    points = np.where(lost[..., None], np.nan, rays * np.where(lost, 0.0, distance)[..., None])
    cloud = Cloud(lidar.name, np.ascontiguousarray(points.reshape(-1, 3), dtype=np.float32), T_world_sensor)
    return cloud, view
