"""Any source -> a bag: MCAP with the standard messages of ROS 2, which needs no ROS to be written or read."""

from __future__ import annotations

import itertools
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from headvox.data import F64, BadFrame, Cloud, DepthImage, Frame
from headvox.ros.bagfile import CAMERA_INFO, CLOUD, IMAGE, TRANSFORMS
from headvox.ros.mcapfile import McapFile
from headvox.ros.messages import MILLIMETRE
from headvox.ros.outputs import Content, header_of, xyz_of
from headvox.run import check_any
from headvox.sources import Source

WORLD = "world"


def convert(
    source: Source,
    path: Path,
    on_frame: Callable[[int], None] = lambda done: None,
    on_bad: Callable[[int, str], None] = lambda index, reason: None,
) -> tuple[int, int]:
    """Write the frames of ``source`` to an MCAP file; return how many, and how many could not be read.

    Depth images are 16UC1 in millimetres, or 32FC1 where a recording has another scale; each has its CameraInfo beside
    it. Where a sensor stands is told on /tf with every frame. Nothing here tells where the heads are. ``on_bad`` is
    told of each frame that cannot be read: its index, the reason.

    Raises:
        HeadvoxError: the file cannot be made, the source not be read, or there is no frame in it that could be used: an
            older file stays then.
    """
    file, names = McapFile(path), dict[str, str]()
    done = bad = 0
    try:
        for frame in source:
            if isinstance(frame, BadFrame):
                on_bad(done, frame.reason)
                bad += 1
            else:
                _write(file, frame, names)
            done += 1
            on_frame(done)
    finally:
        file.close()
    check_any(source, done, bad)
    return done, bad


def _write(file: McapFile, frame: Frame, names: dict[str, str]) -> None:
    """Write a frame; ``names`` keeps what the images of each sensor are called in the bag."""
    stamp = frame.stamp_ns
    places = []
    for image in frame.depths:
        name = names.setdefault(image.name, _name_apart(image.name, names))
        header = header_of(stamp, f"{name}_depth_optical_frame")
        places.append(_place(stamp, header["frame_id"], image.T_world_camera))
        file.write(f"/{name}/depth/camera_info", CAMERA_INFO, stamp, camera_info(header, image))
        file.write(f"/{name}/depth/image_rect_raw", IMAGE, stamp, depth_message(header, image))
    for number, cloud in enumerate(frame.clouds):  # a folder of clouds has another name for each
        name = f"cloud_{number}"
        header = header_of(stamp, WORLD if cloud.T_world_sensor is None else f"{name}_sensor")
        if cloud.T_world_sensor is not None:
            places.append(_place(stamp, header["frame_id"], cloud.T_world_sensor))
        file.write(f"/{name}/points", CLOUD, stamp, cloud_message(header, cloud))
    file.write("/tf", TRANSFORMS[0], stamp, {"transforms": places})


def topic_name(name: str) -> str:
    """Return a name that ROS takes for a topic and a frame."""
    return re.sub(r"[^A-Za-z0-9_]+", "_", name).strip("_") or "sensor"


def _name_apart(name: str, names: dict[str, str]) -> str:
    """Return a name as of :func:`topic_name` that no other sensor in ``names`` has."""
    plain, taken = topic_name(name), set(names.values())
    numbered = (f"{plain}_{number}" for number in itertools.count(2))
    return plain if plain not in taken else next(name for name in numbered if name not in taken)


def depth_message(header: Content, image: DepthImage) -> Content:
    """Return a sensor_msgs/Image as REP 118 has depth."""
    height, width = image.depth.shape
    scale = image.intrinsics.depth_scale
    values = image.depth if scale == MILLIMETRE else image.depth * np.float32(scale)
    return {
        "header": header,
        "height": height,
        "width": width,
        "encoding": "16UC1" if scale == MILLIMETRE else "32FC1",
        "is_bigendian": int(sys.byteorder == "big"),
        "step": width * values.itemsize,
        "data": np.ascontiguousarray(values).view(np.uint8).ravel(),
    }


def camera_info(header: Content, image: DepthImage) -> Content:
    """Return the sensor_msgs/CameraInfo of a depth image without distortion."""
    lens = image.intrinsics
    fx, fy, cx, cy = lens.fx, lens.fy, lens.cx, lens.cy
    return {
        "header": header,
        "width": lens.width,
        "height": lens.height,
        "distortion_model": "plumb_bob",
        "d": [0.0] * 5,
        "k": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "p": [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    }


def cloud_message(header: Content, cloud: Cloud) -> Content:
    """Return a sensor_msgs/PointCloud2 of x, y and z as float32."""
    count = len(cloud.points)
    fields = [{"name": name, "offset": 4 * k, "datatype": 7, "count": 1} for k, name in enumerate("xyz")]
    return {
        "header": header,
        "height": 1,
        "width": count,
        "fields": fields,
        "is_bigendian": sys.byteorder == "big",
        "point_step": 12,
        "row_step": 12 * count,
        "data": cloud.points.view(np.uint8).ravel(),
        "is_dense": bool(np.isfinite(cloud.points).all()),
    }


def _place(stamp_ns: int, child: str, T_world_child: F64) -> Content:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(T_world_child[:3, :3]).as_quat().tolist()
    transform = {
        "translation": xyz_of(T_world_child[:3, 3]),
        "rotation": {"x": x, "y": y, "z": z, "w": w},
    }
    return {"header": header_of(stamp_ns, WORLD), "child_frame_id": child, "transform": transform}
