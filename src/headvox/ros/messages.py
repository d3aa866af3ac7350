"""Point clouds and depth images out of ROS messages, whatever their layout; nothing here imports ROS.

A message comes from anywhere: every size is checked against the bytes that are really there before it is used, and what
does not fit is a :class:`~headvox.HeadvoxError` that says what was expected and what came.
"""

from __future__ import annotations

import math
import re
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from headvox.data import F32, U16, Intrinsics
from headvox.errors import HeadvoxError

# sensor_msgs/PointField: INT8 .. FLOAT64
FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# sensor_msgs/image_encodings: millimetres, the same by its other name, metres (REP 118)
DEPTH_TYPES = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
MILLIMETRE = 0.001
_RECTIFIED = re.compile(r"(?<![a-z])rect(ified)?(?![a-z])")


class Time(Protocol):
    """builtin_interfaces/Time."""

    sec: int
    nanosec: int


def stamp_ns(stamp: Time) -> int:
    """Return a stamp as nanoseconds."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def cloud_points(message: Any) -> F32:
    """Return the points of a sensor_msgs/PointCloud2, (N, 3) float32 metres in its frame, invalid ones not finite.

    The fields x, y and z may lie anywhere in a point and have any number type; the cloud may be organised, padded,
    and of either byte order. Points that are as they should be already are not copied.

    Raises:
        HeadvoxError: a coordinate is missing or reaches beyond its point, the data is shorter than the header says, or
            there is no point.
    """
    height, width, point_step = int(message.height), int(message.width), int(message.point_step)
    if height * width == 0:
        raise HeadvoxError(f"The cloud has {width} x {height} points.", "Is the sensor running?")
    row_step = int(message.row_step) if height > 1 else width * point_step
    if row_step < width * point_step:
        raise HeadvoxError(
            f"The cloud's row_step is {row_step}, expected {width} points of {point_step} bytes or more.",
            "Is this a PointCloud2 of another layout?",
        )
    data = _bytes(message.data, (height - 1) * row_step + width * point_step, "cloud")
    fields = {field.name: field for field in message.fields}
    columns = []
    for name in ("x", "y", "z"):
        if name not in fields:
            names = ", ".join(sorted(fields)) or "none"
            raise HeadvoxError(f"The cloud has no field {name!r}, its fields are: {names[:80]}.", "")
        columns.append(
            _column(data, fields[name], point_step, row_step, (height, width), message.is_bigendian)
        )
    offsets = [fields[name].offset for name in ("x", "y", "z")]
    if all(column.dtype == np.float32 for column in columns) and np.diff(offsets).tolist() == [4, 4]:
        strides = (row_step, point_step, 4)
        together = np.ndarray((height, width, 3), np.float32, data, offsets[0], strides)
        return np.require(together, requirements=["C", "A"]).reshape(-1, 3)
    points = np.empty((height, width, 3), np.float32)
    with np.errstate(
        over="ignore", invalid="ignore"
    ):  # what float32 cannot hold is infinite: an invalid point
        for axis, column in enumerate(columns):
            points[..., axis] = column
    return points.reshape(-1, 3)


def _column(
    data: npt.NDArray[np.uint8],
    field: Any,
    point_step: int,
    row_step: int,
    shape: tuple[int, int],
    is_bigendian: bool,
) -> npt.NDArray[Any]:
    """Return one coordinate of every point, (height, width): a view."""
    if field.datatype not in FIELD_TYPES:
        raise HeadvoxError(f"Field {field.name!r} has datatype {field.datatype}, expected 1 to 8.", "")
    if field.count > 1:
        raise HeadvoxError(f"Field {field.name!r} has {field.count} values a point, expected 1.", "")
    dtype = np.dtype((">" if is_bigendian else "<") + FIELD_TYPES[field.datatype])
    if field.offset < 0 or field.offset + dtype.itemsize > point_step:
        end = field.offset + dtype.itemsize
        raise HeadvoxError(
            f"Field {field.name!r} ends at byte {end} of a point of {point_step} bytes.", "Check its offset."
        )
    return np.ndarray(shape, dtype, data, field.offset, (row_step, point_step))


def depth_image(message: Any) -> U16:
    """Return the depth of a sensor_msgs/Image, (height, width) uint16 in millimetres, C-contiguous, 0 = no return.

    Rows may be padded and of either byte order. 16UC1 is millimetres, 32FC1 metres; what is not a depth from 0.5 mm to
    65.535 m is no return. An image that is as it should be already is not copied.

    Raises:
        HeadvoxError: another encoding, no pixel, or data shorter than the header says.
    """
    height, width, step = int(message.height), int(message.width), int(message.step)
    if message.encoding not in DEPTH_TYPES:
        raise HeadvoxError(
            f"The image's encoding is {message.encoding[:40]!r}, expected 16UC1 or 32FC1.",
            "Is it a depth image?",
        )
    if height * width == 0:
        raise HeadvoxError(f"The image has {width} x {height} pixels.", "Is the camera running?")
    dtype = np.dtype((">" if message.is_bigendian else "<") + DEPTH_TYPES[message.encoding])
    row = width * dtype.itemsize
    if height > 1 and step < row:
        raise HeadvoxError(f"The image's step is {step}, expected {row} bytes a row or more.", "")
    step = step if height > 1 else row
    data = _bytes(message.data, (height - 1) * step + row, "image")
    values = np.ndarray((height, width), dtype, data, 0, (step, dtype.itemsize))
    if dtype.kind == "u":
        return np.ascontiguousarray(values, dtype=np.uint16)
    with np.errstate(over="ignore", invalid="ignore"):
        millimetres = np.rint(values * np.float32(1000.0))
        return np.where((millimetres >= 1.0) & (millimetres <= 65535.0), millimetres, 0.0).astype(np.uint16)


def info_topic(depth_topic: str) -> str:
    """Return where a depth image's CameraInfo is by convention: ``camera_info`` beside it."""
    return depth_topic.rpartition("/")[0] + "/camera_info"


def intrinsics(info: Any) -> Intrinsics:
    """Return the intrinsics in a sensor_msgs/CameraInfo, for depth in millimetres.

    The projection matrix P is that of the rectified image, which a depth image is; K where P is empty.

    Raises:
        HeadvoxError: no calibration in it, or binning or a region of interest, which are not supported.
    """
    P, K = list(info.p), list(info.k)
    fx, cx, fy, cy = (P[0], P[2], P[5], P[6]) if P[0] != 0.0 else (K[0], K[2], K[4], K[5])
    width, height = int(info.width), int(info.height)
    if not (math.isfinite(fx) and math.isfinite(fy) and fx > 0.0 and fy > 0.0 and width > 0 and height > 0):
        raise HeadvoxError(
            f"The camera_info is of {width} x {height} pixels with fx = {fx:g}, fy = {fy:g}.",
            "Calibrate the camera.",
        )
    if not (-width < cx < 2 * width and -height < cy < 2 * height):
        raise HeadvoxError(
            f"The camera_info has its principal point at ({cx:g}, {cy:g}), far outside {width} x {height} pixels.",
            "",
        )
    roi = info.roi
    if max(info.binning_x, info.binning_y) > 1 or roi.x_offset or roi.y_offset:
        raise HeadvoxError(
            "The camera_info has binning or a region of interest, which is not supported.", "Switch it off."
        )
    return Intrinsics(width, height, float(fx), float(fy), float(cx), float(cy), MILLIMETRE)


def distortion_remark(info: Any, depth_topic: str) -> str:
    """Return what to say where a depth image may not be rectified, and is read as if it were; empty where it is.

    Its CameraInfo has distortion, and its topic does not say that it was taken out. Whether the image itself has it
    nobody knows: drivers give the distortion of the lens beside rectified images, too.
    """
    if not any(value != 0.0 for value in info.d) or _RECTIFIED.search(depth_topic.lower()):
        return ""
    return (
        f"{depth_topic}: its camera_info has distortion ({info.distortion_model[:40]!r}), the image is "
        "read as a rectified one. If it is not, rectify it first: image_proc does."
    )


def _bytes(data: Any, needed: int, what: str) -> npt.NDArray[np.uint8]:
    view = np.frombuffer(data, np.uint8) if len(data) else np.empty(0, np.uint8)
    if len(view) < needed:
        raise HeadvoxError(
            f"The {what} has {len(view)} bytes of data, its header says {needed}.",
            "Was it cut off on the way?",
        )
    return view
