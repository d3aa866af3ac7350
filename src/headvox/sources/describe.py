"""What a source holds, in words, for ``headvox info``."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from itertools import islice
from pathlib import Path

import numpy as np

from headvox.data import F64, BadFrame, Cloud, Frame
from headvox.errors import HeadvoxError
from headvox.frames import is_moving, transform, unproject
from headvox.sources import Source, open_source
from headvox.sources.bag import BagSource
from headvox.sources.cloudfile import CloudFileSource, read_cloud_file
from headvox.sources.content import CloudFile
from headvox.sources.folder import FolderSource
from headvox.sources.mounting import Mounting
from headvox.sources.options import SourceOptions, listed
from headvox.sources.realsense import RealSenseFile
from headvox.sources.recording import Camera, RecordedFrame, RecordingSource

Rows = list[tuple[str, str]]

_LOOKED_AT = 10  # frames of a recording that are decoded: enough for a box, and quick


def describe(
    source_path: str | os.PathLike[str],
    options: SourceOptions | None = None,
    say: Callable[[str], None] | None = None,
) -> Rows:
    """Return (what, value) rows about a source: metres, degrees, and printable characters only.

    A recording is described by its ``recording.json`` and ten frames spread over it, a bag by its topics and its first
    frames, a folder by its first file that can be read. ``options`` and ``say`` are those of
    :func:`~headvox.sources.open_source`.

    Raises:
        HeadvoxError: the source, or every file of a folder, cannot be used.
    """
    source = open_source(source_path, options, say)
    match source:
        case RecordingSource():
            rows = _recording_rows(source)
        case FolderSource():
            rows = _folder_rows(source)
        case CloudFileSource():
            rows = [
                ("frames", "1"),
                *_file_rows(source.path.name, read_cloud_file(source.path), source.mounting),
            ]
        case BagSource():
            rows = _bag_rows(source)
        case RealSenseFile():
            rows = [("kind", "RealSense recording"), ("camera", source.words), *_seen_rows(source)]
        case _:
            rows = [("frames", "not known" if source.length is None else str(source.length))]
    source.close()
    return [(_printable(what), _printable(value)) for what, value in [("name", source.name), *rows]]


def _file_rows(name: str, cloud: CloudFile, mounting: Mounting | None) -> Rows:
    finite = cloud.points[np.isfinite(cloud.points[:, 0])].astype(np.float64)
    rows = [("kind", cloud.format), ("points", f"{len(cloud.points)}")]
    if cloud.faces:
        sampled = len(cloud.points) - cloud.vertices
        rows.append(
            ("faces", f"{cloud.faces}: {cloud.vertices} vertices and {sampled} samples of the surface")
        )
    rows.append(("finite", f"{len(finite) / len(cloud.points):.1%}"))
    placed = Cloud(name, cloud.points, cloud.T_world_sensor)
    T = (mounting.placed(placed) if mounting else placed).T_world_sensor
    if T is None:
        rows.append(("box", _box(finite)))
    else:
        told = [] if cloud.T_world_sensor is None else ["its VIEWPOINT"]
        told += ["--mount"] if mounting and mounting.T_world_mount is not None else []
        rows.append(("box", _box(transform(T, finite)) + ", world frame"))
        rows.append(("sensor", f"{_where(T)} by {' and '.join(told)}"))
    rows.append(("other fields", ", ".join(cloud.extra) or "none"))
    return rows


def _folder_rows(source: FolderSource) -> Rows:
    count = len(source.paths)
    apart = "are taken to be 1/30 s apart" if source.rate_hz is None else f"are {source.rate_hz:g} a second"
    seconds = source.stamp_ns(count - 1) / 1e9
    rows = [
        ("frames", f"{count} files"),
        ("duration", f"{seconds:.2f} s, files have no stamps and {apart}"),
    ]
    path, cloud = _first_readable(source.paths)
    return [*rows, ("described file", path.name), *_file_rows(path.name, cloud, source.mounting)]


def _bag_rows(source: BagSource) -> Rows:
    rows = [("kind", source.bag.kind), ("heads are in", source.placing.words)]
    read = {sensor.topic: sensor for sensor in source.sensors}
    for name, sensor in read.items():
        rows.append((f"reads {name}", f"{sensor.words}, {source.bag.topics[name].count} messages"))
    others = [
        f"{topic.name} ({topic.count})" for topic in source.bag.topics.values() if topic.name not in read
    ]
    rows.append(("other topics", listed(others)))
    return rows + _seen_rows(source)


def _seen_rows(source: Source) -> Rows:
    frames = list(islice(source, _LOOKED_AT))
    good = [frame for frame in frames if isinstance(frame, Frame)]
    unread = len(frames) - len(good)
    placed = [(image.name, image.T_world_camera) for frame in good[:1] for image in frame.depths]
    return [
        ("looked at", f"the first {len(frames)} frames, {unread} of them cannot be read"),
        *((f"camera {name}", f"{_where(T)}, {_tilt(T)}") for name, T in placed),
        ("box", _box(_corners(good))),
    ]


def _corners(frames: Iterable[Frame]) -> F64:
    """Return the corners of the box about each reading, (2 N, 3), in the world."""
    corners = [np.empty((0, 3))]
    for frame in frames:
        sets = [unproject(image.depth, image.intrinsics, image.T_world_camera) for image in frame.depths]
        for cloud in frame.clouds:
            finite = cloud.points[np.isfinite(cloud.points).all(axis=1)].astype(np.float64)
            T = cloud.T_world_sensor
            sets.append(finite if T is None else transform(T, finite))
        for points in sets:
            if len(points):
                corners += [points.min(axis=0)[None], points.max(axis=0)[None]]
    return np.concatenate(corners)


def _first_readable(paths: list[Path]) -> tuple[Path, CloudFile]:
    for path in paths[:-1]:
        with suppress(HeadvoxError):
            return path, read_cloud_file(path)
    return paths[-1], read_cloud_file(paths[-1])


def _recording_rows(source: RecordingSource) -> Rows:
    first, last = source.frames[0].stamp_ns, source.frames[-1].stamp_ns
    rows = [
        ("kind", "depth recording"),
        ("frames", str(len(source.frames))),
        ("duration", f"{(last - first) / 1e9:.2f} s"),
    ]
    for label, camera in source.cameras.items():
        rows.append((f"camera {label}", _camera(label, camera, source.frames)))
    return rows + _depth_rows(source)


def _camera(label: str, camera: Camera, frames: list[RecordedFrame]) -> str:
    shots = [(frame.stamp_ns, shot) for frame in frames for shot in frame.shots if shot.camera == label]
    size = f"{camera.intrinsics.width}x{camera.intrinsics.height}"
    if not shots:
        return f"{size}, no images"
    seconds = (shots[-1][0] - shots[0][0]) / 1e9
    rate = f"{(len(shots) - 1) / seconds:.1f} fps" if seconds > 0 else "one moment"
    first = shots[0][1].T_world_camera
    moves = ", moving" if is_moving(shot.T_world_camera for _, shot in shots) else ""
    return f"{size}, {len(shots)} images, {rate}, {_where(first)}, {_tilt(first)}{moves}"


def _where(T_world_sensor: F64) -> str:
    x, y, z = T_world_sensor[:3, 3]
    return f"{z:.2f} m above the floor at x {x:.2f} y {y:.2f} m"


def _tilt(T_world_camera: F64) -> str:
    """How far the optical axis leaves the horizontal."""
    down = -float(np.degrees(np.arcsin(np.clip(T_world_camera[2, 2], -1.0, 1.0))))
    return f"tilted {abs(down):.1f}° {'down' if down >= 0 else 'up'}"


def _depth_rows(source: RecordingSource) -> Rows:
    count = len(source.frames)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _LOOKED_AT)).astype(int))
    bad = pixels = returns = 0
    corners = np.empty((0, 3))
    for frame in (source.read(source.frames[i]) for i in chosen):
        if isinstance(frame, BadFrame):
            bad += 1
            continue
        for image in frame.depths:
            points = unproject(image.depth, image.intrinsics, image.T_world_camera)
            pixels, returns = pixels + image.depth.size, returns + len(points)
            if len(points):
                corners = np.vstack([corners, points.min(axis=0), points.max(axis=0)])
    return [
        ("looked at", f"{len(chosen)} of {count} frames, {bad} of them cannot be read"),
        ("points", f"{pixels} pixels in them"),
        ("finite", f"{returns / max(pixels, 1):.1%} of the pixels have a return"),
        ("box", _box(corners)),
    ]


def _box(points: F64) -> str:
    if len(points) == 0:
        return "no points"
    low, high = (np.round(corner, 2) + 0.0 for corner in (points.min(axis=0), points.max(axis=0)))  # no -0.00
    return ", ".join(f"{axis} {a:.2f} to {b:.2f} m" for axis, a, b in zip("xyz", low, high, strict=True))


def _printable(text: str) -> str:
    """Names come from files: nothing in them is to steer a terminal."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)
