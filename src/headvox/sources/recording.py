"""Depth recordings: a folder with recording.json and 16-bit PNG images."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np

from headvox.data import F64, U16, BadFrame, DepthImage, Frame, Intrinsics
from headvox.errors import HeadvoxError
from headvox.frames import as_rigid, is_moving

FILE = "recording.json"
FORMAT, VERSION = "headvox-recording", 1
LENS = ("fx", "fy", "cx", "cy", "depth_scale")
KEYS = {"width", "height", *LENS, "T_world_camera"}
"""What is read of a camera."""
_MAX_JSON_BYTES = 64 << 20
_MAX_PIXELS = 8_000_000  # eight times the largest depth sensor
_PNG = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera of a recording; ``T_world_camera`` (4, 4) is None where every frame brings its own."""

    intrinsics: Intrinsics
    T_world_camera: F64 | None


@dataclass(frozen=True, slots=True)
class Shot:
    """An image of a frame: ``file`` is relative to the folder and stays inside it by its text."""

    camera: str
    file: str
    T_world_camera: F64


@dataclass(frozen=True, slots=True)
class RecordedFrame:
    """What recording.json says of a frame."""

    stamp_ns: int
    shots: tuple[Shot, ...]


class RecordingSource:
    """A depth recording: recording.json is checked at once, the images are decoded one frame at a time.

    A frame with an image that is missing, damaged, of another size than its camera's, not 16-bit grey, or
    outside the folder through a link is a :class:`~headvox.data.BadFrame`. Ground truth in the folder is not
    read.
    """

    length: int | None

    def __init__(self, folder: Path, placed: Mapping[str, F64] | None = None) -> None:
        """Open a folder; ``placed`` cameras stand there (T_world_camera), whatever the recording says.

        Raises:
            HeadvoxError: recording.json is missing or says anything that cannot be used, or does not know a camera.
        """
        name = str(folder / FILE)
        content = _load(folder / FILE)
        self.name = folder.resolve().name
        self._folder = folder.resolve()
        _check_version(content, name)
        self.cameras = _cameras(content, name)
        self.unread = _unread(content["cameras"])
        """What recording.json says of its cameras that nobody reads: distortion, for example."""
        self.frames = _frames(content, self.cameras, name)
        self.length = len(self.frames)
        self._placed = dict(placed or {})
        for camera in self._placed:
            if camera not in self.cameras:
                raise HeadvoxError(
                    f"{name}: has no camera {camera}, only {', '.join(self.cameras)}.",
                    "Correct the extrinsics.",
                )
        self._open = True

    def __iter__(self) -> Iterator[Frame | BadFrame]:
        """Yield the frames in time order, until closed."""
        for recorded in self.frames:
            if not self._open:
                return
            yield self.read(recorded)

    def read(self, recorded: RecordedFrame) -> Frame | BadFrame:
        """Decode the images of one frame."""
        try:
            return Frame(recorded.stamp_ns, depths=tuple(self._image(shot) for shot in recorded.shots))
        except HeadvoxError as error:
            return BadFrame(recorded.stamp_ns, str(error))

    def moving(self) -> list[str]:
        """Return the names of the cameras that move, by what the recording says."""
        places: dict[str, list[F64]] = {camera: [] for camera in self.cameras}
        for frame in self.frames:
            for shot in frame.shots:
                places[shot.camera].append(shot.T_world_camera)
        return [camera for camera, each in places.items() if is_moving(each)]

    def close(self) -> None:
        """End the iteration."""
        self._open = False

    def _image(self, shot: Shot) -> DepthImage:
        intrinsics = self.cameras[shot.camera].intrinsics
        data = _read_inside(self._folder, shot.file, _most_png_bytes(intrinsics))
        depth = decode_depth(data, intrinsics.width, intrinsics.height, shot.file)
        return DepthImage(shot.camera, depth, intrinsics, self._placed.get(shot.camera, shot.T_world_camera))


def decode_depth(data: bytes, width: int, height: int, name: str) -> U16:
    """Return the (height, width) uint16 image of a 16-bit grey PNG.

    Its size is compared before anything is decoded, so a small file cannot fill the memory.

    Raises:
        HeadvoxError: no PNG, another size, not 16-bit grey, or damaged.
    """
    from PIL import Image  # here, so that reading clouds needs no Pillow

    if len(data) < 26 or data[:8] != _PNG or data[12:16] != b"IHDR":
        raise HeadvoxError(f"{name}: expected a PNG image, it begins with {data[:8]!r}.", "Is it complete?")
    got_width, got_height, bits, colour = struct.unpack_from(">IIBB", data, 16)
    if (got_width, got_height) != (width, height):
        raise HeadvoxError(
            f"{name}: the image is {got_width}x{got_height}, expected {width}x{height} as its camera has.",
            "Correct width and height in recording.json.",
        )
    if (bits, colour) != (16, 0):
        raise HeadvoxError(
            f"{name}: expected a 16-bit grey PNG, got {bits} bits and colour type {colour}.",
            "Save raw depth, not a picture of it.",
        )
    try:
        with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
            depth = np.ascontiguousarray(image, dtype=np.uint16)  # older Pillow gives 32 bits
    except Exception as error:  # Pillow raises a dozen kinds on damaged files
        reason = (str(error).splitlines() or [type(error).__name__])[0][:120]
        raise HeadvoxError(f"{name}: the PNG is damaged: {reason}.", "Record or copy it again.") from None
    if depth.shape != (height, width):
        raise HeadvoxError(f"{name}: the PNG is damaged: it decodes to {depth.shape}.", "Copy it again.")
    return depth


def _most_png_bytes(intrinsics: Intrinsics) -> int:
    return 4 * intrinsics.width * intrinsics.height + (
        1 << 20
    )  # twice what noise needs, and room for comments


def _read_inside(folder: Path, file: str, most: int) -> bytes:
    """Return the bytes of a regular file that lies in a resolved folder, links followed."""
    try:
        path = (folder / file).resolve(strict=True)
        if not path.is_relative_to(folder):
            raise HeadvoxError(
                f"{file}: the link leads out of the recording.", "Copy the file into the folder."
            )
        if not path.is_file():  # a pipe could block for ever
            raise HeadvoxError(f"{file}: expected a file.", "Record or copy it again.")
        if path.stat().st_size > most:
            raise HeadvoxError(
                f"{file}: {path.stat().st_size} bytes, expected at most {most} for this camera.",
                "Correct width and height in recording.json.",
            )
        return path.read_bytes()
    except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: links in a circle
        reason = getattr(error, "strerror", None) or str(error)
        raise HeadvoxError(f"{file}: cannot be read: {reason}.", "Record or copy it again.") from None


def _load(path: Path) -> dict[str, Any]:
    name = str(path)
    try:
        if not path.is_file():
            raise HeadvoxError(f"{name}: there is no such file.", "Give the folder of a recording.")
        if path.stat().st_size > _MAX_JSON_BYTES:
            raise HeadvoxError(
                f"{name}: expected at most {_MAX_JSON_BYTES} bytes.", "Cut the recording in pieces."
            )
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise HeadvoxError(f"{name}: cannot be read: {error.strerror}.", "Check its permissions.") from None
    except RecursionError:
        raise HeadvoxError(f"{name}: nested too deeply.", "Write it as the recording format says.") from None
    except ValueError as error:  # broken JSON or text, or a number without end
        raise HeadvoxError(f"{name}: not valid JSON: {str(error)[:120]}.", "Is it complete?") from None
    return _object(content, name)


def _check_version(content: Mapping[str, Any], name: str) -> None:
    got = _get(content, "format", name), _get(content, "version", name)
    if got[0] != FORMAT:
        raise HeadvoxError(f"{name}: format is {_short(got[0])}, expected {FORMAT!r}.", "Is it a recording?")
    if type(got[1]) is not int or got[1] != VERSION:
        raise HeadvoxError(
            f"{name}: version is {_short(got[1])}, expected {VERSION}.", "Update headvox to read it."
        )


def _cameras(content: Mapping[str, Any], name: str) -> dict[str, Camera]:
    cameras = _object(_get(content, "cameras", name), f"{name}: cameras")
    if not cameras:
        raise HeadvoxError(f"{name}: there are no cameras, expected at least one.", "Describe the camera.")
    return {label: _camera(entry, f"{name}: camera {_short(label)}") for label, entry in cameras.items()}


def _camera(entry: Any, name: str) -> Camera:
    camera = _object(entry, name)
    width, height = (_integer(_get(camera, key, name), f"{name}: {key}") for key in ("width", "height"))
    if not (width > 0 and height > 0 and width * height <= _MAX_PIXELS):
        raise HeadvoxError(
            f"{name}: the size is {_short(width)}x{_short(height)}, expected 1x1 to {_MAX_PIXELS} pixels.",
            "Give width and height of the depth image in pixels.",
        )
    fx, fy, cx, cy, scale = (_number(_get(camera, key, name), f"{name}: {key}") for key in LENS)
    for key, value in (("fx", fx), ("fy", fy)):
        if not value > 0.0:
            raise HeadvoxError(f"{name}: {key} is {value}, expected more than 0.", "Give it in pixels.")
    if not 1e-6 <= scale <= 0.1:
        raise HeadvoxError(
            f"{name}: depth_scale is {scale:g}, expected 0.000001 to 0.1 metres a unit.",
            "It is 0.001 for an image in millimetres.",
        )
    pose = camera.get("T_world_camera")
    return Camera(
        Intrinsics(width, height, fx, fy, cx, cy, scale),
        None if pose is None else _pose(pose, f"{name}: T_world_camera"),
    )


def _unread(cameras: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the keys of cameras that nobody reads; those that say nothing, or only zeros, are left out."""
    said = {
        key: None
        for camera in cameras.values()
        for key, value in camera.items()
        if key not in KEYS and (any(value) if isinstance(value, list) else value)
    }
    return [_short(key) for key in said]


def _frames(content: Mapping[str, Any], cameras: Mapping[str, Camera], name: str) -> list[RecordedFrame]:
    entries = _get(content, "frames", name)
    if not isinstance(entries, list) or not entries:
        raise HeadvoxError(
            f"{name}: frames is {_short(entries)}, expected a list with frames.", "Record some."
        )
    frames: list[RecordedFrame] = []
    for index, entry in enumerate(entries):
        frame = _frame(entry, cameras, f"{name}: frame {index}")
        if frames and frame.stamp_ns < frames[-1].stamp_ns:
            raise HeadvoxError(
                f"{name}: frame {index} has stamp_ns {frame.stamp_ns} after one with "
                f"{frames[-1].stamp_ns}, expected time order.",
                "Sort the frames by stamp_ns.",
            )
        frames.append(frame)
    return frames


def _frame(entry: Any, cameras: Mapping[str, Camera], name: str) -> RecordedFrame:
    frame = _object(entry, name)
    stamp_ns = _integer(_get(frame, "stamp_ns", name), f"{name}: stamp_ns")
    files = _object(_get(frame, "depth", name), f"{name}: depth")
    poses = _object(frame.get("T_world_camera", {}), f"{name}: T_world_camera")
    for label in (*files, *poses):
        if label not in cameras:
            raise HeadvoxError(
                f"{name}: there is no camera {_short(label)}, the cameras are {_short(', '.join(cameras))}.",
                "Describe it under cameras.",
            )
    shots = []
    for label, file in files.items():
        T_world_camera = cameras[label].T_world_camera
        if label in poses:
            T_world_camera = _pose(poses[label], f"{name}: T_world_camera of {_short(label)}")
        if T_world_camera is None:
            raise HeadvoxError(
                f"{name}: camera {_short(label)} has no T_world_camera, neither here nor under cameras.",
                "Say where the camera stands; it is never guessed.",
            )
        shots.append(Shot(label, _inside(file, f"{name}: depth of {_short(label)}"), T_world_camera))
    return RecordedFrame(stamp_ns, tuple(shots))


def _inside(file: Any, name: str) -> str:
    """Refuse a path that is absolute or climbs up, on any system."""
    if not isinstance(file, str) or not file or not file.isprintable():
        raise HeadvoxError(
            f"{name}: expected a file name, got {_short(file)}.", "Give it relative to the folder."
        )
    posix, windows = PurePosixPath(file), PureWindowsPath(file)
    if posix.is_absolute() or windows.anchor or ".." in (*posix.parts, *windows.parts):
        raise HeadvoxError(
            f"{name}: the path {_short(file)} leaves the recording, expected one inside.",
            "Copy the image into the folder and give its relative path.",
        )
    return file


def _pose(value: Any, name: str) -> F64:
    if not (
        isinstance(value, list)
        and len(value) == 4
        and all(isinstance(row, list) and len(row) == 4 and all(map(_is_number, row)) for row in value)
    ):
        raise HeadvoxError(f"{name}: no 4x4 matrix but {_short(value)}.", "Give four rows of four numbers.")
    return as_rigid([[float(number) for number in row] for row in value], name)


def _get(entry: Mapping[str, Any], key: str, name: str) -> Any:
    if key not in entry:
        raise HeadvoxError(f"{name}: the key {key!r} is missing.", "Add it.")
    return entry[key]


def _object(value: Any, name: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise HeadvoxError(f"{name}: expected an object in braces, got {_short(value)}.", "Correct the JSON.")
    return value


def _integer(value: Any, name: str) -> int:
    if type(value) is not int or not -(2**63) <= value < 2**63:
        size = " of 64 bits" if type(value) is int else ""
        raise HeadvoxError(
            f"{name}: expected a whole number{size}, got {_short(value)}.", "Correct the JSON."
        )
    return value


def _number(value: Any, name: str) -> float:
    if not _is_number(value):
        raise HeadvoxError(f"{name}: expected a finite number, got {_short(value)}.", "Correct the JSON.")
    return float(value)


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < 1e300  # neither NaN nor infinite


def _short(value: Any) -> str:
    """Show a JSON value in a message, however large or deep it is."""
    if isinstance(value, (dict, list)):
        return f"{'a list' if isinstance(value, list) else 'an object'} of {len(value)}"
    return repr(value)[:60] if not isinstance(value, int) or abs(value) < 2**70 else "a huge number"
