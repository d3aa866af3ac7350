"""What a frame has to be before anything is looked for in it, and why there may be nothing to look at."""

from __future__ import annotations

import math
from dataclasses import fields

import numpy as np

from headvox.data import F64, BadFrame, Cloud, DepthImage, Frame, Intrinsics
from headvox.errors import HeadvoxError
from headvox.frames import as_rigid
from headvox.fuse import Region
from headvox.scale import wrong_scale

STAMP_LIMIT_NS = 2**62
NUMBERS = (int, float, np.integer, np.floating)


def origins_of(frame: Frame) -> F64:
    """Return where the sensors of ``frame`` stand, (S, 3), as far as is known."""
    placed = [cloud.T_world_sensor for cloud in frame.clouds if cloud.T_world_sensor is not None]
    placed += [image.T_world_camera for image in frame.depths]
    return np.array([T[:3, 3] for T in placed], dtype=np.float64).reshape(-1, 3)


def knows_an_origin(frame: Frame) -> bool:
    """Return whether it is known where any of the sensors stands."""
    return len(frame.depths) > 0 or any(cloud.T_world_sensor is not None for cloud in frame.clouds)


def check_frame(frame: Frame | BadFrame) -> None:
    """Raise HeadvoxError where a reading has another shape or type than it should, or a place that is not rigid."""
    if isinstance(frame, BadFrame):
        raise HeadvoxError(f"There is nothing in a bad frame: {frame.reason}", "Leave it out.")
    check_kind(frame, Frame, "detect_frame")
    as_stamp(frame.stamp_ns)
    _check_readings(frame.clouds, Cloud, "clouds")
    _check_readings(frame.depths, DepthImage, "depths")
    if not frame.clouds and not frame.depths:
        raise HeadvoxError(
            "The frame has neither points nor depth images.", "Give at least one sensor's reading."
        )
    for cloud in frame.clouds:
        _check_cloud(cloud)
    for image in frame.depths:
        _check_image(image)


def _check_readings(readings: object, kind: type, name: str) -> None:
    if not isinstance(readings, (tuple, list)):
        got = f"expected a tuple of {kind.__name__}, got {type(readings).__name__}"
        raise HeadvoxError(f"{name} of the frame: {got}.", f"Write {name}=(reading,).")
    for reading in readings:
        check_kind(reading, kind, f"{name} of the frame")


def check_kind(thing: object, kind: type, where: str) -> None:
    """Raise HeadvoxError where ``thing`` is no ``kind``, a dataclass of headvox; ``where`` says what it was for."""
    if not isinstance(thing, kind):
        made = f"{kind.__name__}({', '.join(field.name for field in fields(kind))})"
        raise HeadvoxError(
            f"{where}: expected headvox.{kind.__name__}, got {type(thing).__name__}.",
            f"Make it by headvox.{made}.",
        )


def _check_unmasked(array: object, name: str, invalid: str) -> None:
    if isinstance(array, np.ma.MaskedArray):
        raise HeadvoxError(f"{name}: expected a plain array, got a masked one.", f"Take .filled({invalid}).")


def _check_place(T: object, name: str) -> None:
    if not isinstance(T, np.ndarray):
        what = f"{name}: expected an array of shape (4, 4), got {type(T).__name__}."
        raise HeadvoxError(what, "Use np.array(T, dtype=np.float64).")
    as_rigid(T, name)


def _check_cloud(cloud: Cloud) -> None:
    points = cloud.points
    _check_unmasked(points, cloud.name, "np.nan")
    if not isinstance(points, np.ndarray) or points.ndim != 2 or points.shape[1] != 3:
        shape = getattr(points, "shape", type(points).__name__)
        raise HeadvoxError(f"{cloud.name}: expected points of shape (N, 3), got {shape}.", "Reshape them.")
    if points.dtype != np.float32 or not points.flags.c_contiguous:
        raise HeadvoxError(
            f"{cloud.name}: expected C-contiguous float32 points, got {points.dtype} in strides {points.strides}.",
            "Use np.ascontiguousarray(points, dtype=np.float32).",
        )
    if len(points) == 0:
        raise HeadvoxError(f"{cloud.name}: the cloud is empty.", "Is the sensor running?")
    if cloud.T_world_sensor is not None:
        _check_place(cloud.T_world_sensor, f"{cloud.name}: T_world_sensor")


def _check_image(image: DepthImage) -> None:
    depth, camera = image.depth, image.intrinsics
    _check_unmasked(depth, image.name, "0")
    if not isinstance(depth, np.ndarray) or depth.dtype != np.uint16 or depth.ndim != 2:
        got = f"{getattr(depth, 'dtype', type(depth).__name__)} {getattr(depth, 'shape', '')}"
        expected = "expected a (height, width) uint16 depth image"
        raise HeadvoxError(f"{image.name}: {expected}, got {got}.", "Convert it.")
    check_kind(camera, Intrinsics, f"{image.name}: intrinsics")
    if depth.size == 0 or depth.shape != (camera.height, camera.width):
        raise HeadvoxError(
            f"{image.name}: the image is {depth.shape[1]}x{depth.shape[0]}, its camera "
            f"{camera.width}x{camera.height}.",
            "Give the intrinsics of this image size.",
        )
    _check_lens(camera, image.name)
    _check_place(image.T_world_camera, f"{image.name}: T_world_camera")


def as_stamp(stamp_ns: float) -> int:
    """Return ``stamp_ns`` as a whole number.

    Raises:
        HeadvoxError: it is none, or so large that the time between two of them has no place in an int64.
    """
    if not (isinstance(stamp_ns, NUMBERS) and abs(stamp_ns) < STAMP_LIMIT_NS and stamp_ns == int(stamp_ns)):
        raise HeadvoxError(
            f"stamp_ns: expected whole nanoseconds, less than 2**62 (146 years), got {stamp_ns!r}.",
            "Of seconds, take round(1e9 * seconds).",
        )
    return int(stamp_ns)


def _check_lens(camera: Intrinsics, name: str) -> None:
    for key in ("fx", "fy", "cx", "cy", "depth_scale"):
        value, may_be_any = getattr(camera, key), key in ("cx", "cy")
        if not (isinstance(value, NUMBERS) and math.isfinite(value) and (may_be_any or float(value) > 0)):
            expected = "a finite number" if may_be_any else "a finite number above 0"
            raise HeadvoxError(f"{name}: {key}: expected {expected}, got {value!r}.", "Check the intrinsics.")


def nothing_in_range(frame: Frame, region: Region) -> HeadvoxError:
    """Say why no point was kept: nothing measured at all, another unit, or another place."""
    where = f"within {region.radius_m:g} m of ({', '.join(f'{v:.2f}' for v in region.centre)})"
    for cloud in frame.clouds:
        finite = cloud.points[np.isfinite(cloud.points).all(axis=1)].astype(np.float64)
        if len(finite) == 0:
            what = f"{cloud.name}: all {len(cloud.points)} points are NaN or infinite."
            return HeadvoxError(what, "Is the sensor covered, or too near?")
        error = _wrong_scale_of(cloud, finite, region)
        if error is not None:
            return error
        nearest = float(np.linalg.norm(finite, axis=1).min())
        return HeadvoxError(
            f"{cloud.name}: none of {len(cloud.points)} points is {where} and between {region.min_height_m:g} m and "
            f"{region.max_height_m:g} m high (nearest: {nearest:.2f} m from the origin of its frame).",
            "Set centre, max_range_m, min_height_m or max_height_m, or give the sensor's transform (of files and "
            "bags: --mount).",
        )
    if all(not image.depth.any() for image in frame.depths):
        return HeadvoxError(
            f"{frame.depths[0].name}: the depth image has no return at all.", "Is the sensor running?"
        )
    return HeadvoxError(
        f"{frame.depths[0].name}: no return is {where} and between {region.min_height_m:g} m and "
        f"{region.max_height_m:g} m high.",
        "Check T_world_camera and depth_scale, or set max_range_m, min_height_m or max_height_m.",
    )


def _wrong_scale_of(cloud: Cloud, finite: F64, region: Region) -> HeadvoxError | None:
    """Judge a cloud's finite points where it has them if its sensor's place is known, else about the region."""
    return wrong_scale(finite, cloud.name, region.centre if cloud.T_world_sensor is None else None)
