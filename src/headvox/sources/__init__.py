"""Where frames come from.

The contract: a source is iterated once, in time order; it yields a :class:`~headvox.data.Frame` for what it
could read and a :class:`~headvox.data.BadFrame` for what it could not; ``len`` frames in all, or ``length``
is None when nobody knows; ``close`` may be called at any time and more than once. A source raises
:class:`~headvox.errors.HeadvoxError` when the input as a whole cannot be used.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from headvox.data import BadFrame, Frame
from headvox.errors import HeadvoxError

if TYPE_CHECKING:
    from headvox.sources.mounting import Mounting
    from headvox.sources.options import SourceOptions


class Source(Protocol):
    """Something that yields frames."""

    name: str
    length: int | None

    def __iter__(self) -> Iterator[Frame | BadFrame]:
        """Yield the frames in time order."""
        ...

    def close(self) -> None:
        """Release files and devices."""
        ...


def open_source(
    path: str | os.PathLike[str],
    options: SourceOptions | None = None,
    say: Callable[[str], None] | None = None,
) -> Source:
    """Open whatever lies at a path; its kind is told by its content, never by its name.

    A folder with a ``recording.json`` (or that file itself) is a depth recording; a folder with a ``metadata.yaml``, or
    a file that begins like one, is a bag of ROS 1 or ROS 2; any other folder is a sequence of point-cloud files in
    natural order of their names, 1/30 s apart unless ``options`` say otherwise, and a file is one cloud: ply, pcd, npy
    or npz. A bag that the SDK of RealSense recorded is played by it. ``realsense:`` is the camera that is plugged in,
    ``realsense:SERIAL,SERIAL`` are several.

    Args:
        path: of a file or a folder, or ``realsense:``.
        options: what a bag or a camera does not tell by itself; a depth recording takes ``extrinsics``, clouds in
            files ``T_world_mount``, and a folder of them ``rate_hz``.
        say: told what is assumed about a bag or a cloud, or overruled or not read in a recording, a line each; by
            default these are warnings.

    Returns:
        A source: it yields each :class:`~headvox.data.Frame` once, in time order, and a
        :class:`~headvox.data.BadFrame` for what could not be read. ``close`` it in the end.

    Raises:
        HeadvoxError: there is nothing there, or nothing that headvox can read; Undecided, which is one, where a bag
            can be read in several ways.
    """
    # The kinds are imported here: `import headvox.sources` is to cost nothing.
    from headvox.ros.bagfile import is_bag
    from headvox.sources.cloudfile import CloudFileSource
    from headvox.sources.folder import FolderSource
    from headvox.sources.options import SourceOptions, check_stamped, check_unused
    from headvox.sources.recording import FILE

    place = Path(path)
    if os.fspath(path).startswith("realsense:") and not place.exists():
        from headvox.sources.realsense import RealSenseLive

        serials = [serial for serial in os.fspath(path).partition(":")[2].split(",") if serial]
        check_stamped(options or SourceOptions(), os.fspath(path))
        return RealSenseLive(serials, options or SourceOptions(), say or _warn)
    try:
        is_recording = place.name == FILE or (place / FILE).is_file()
        if not is_recording and is_bag(place):
            return _open_bag(place, options or SourceOptions(), say or _warn)
        if is_recording:
            return _open_recording(place if place.is_dir() else place.parent, options, say or _warn)
        if place.is_dir():
            options = options or SourceOptions()
            check_unused(replace(options, rate_hz=None, T_world_mount=None), place.name)
            return FolderSource(place, options.rate_hz, _mounting(options, say or _warn))
        options = options or SourceOptions()
        check_unused(replace(options, T_world_mount=None), place.name)
    except OSError as error:
        raise HeadvoxError(f"{place}: cannot be read: {error.strerror}.", "Check the path.") from None
    except ValueError as error:  # a NUL in the path
        raise HeadvoxError(f"{place}: cannot be read: {error}.", "Check the path.") from None
    return CloudFileSource(place, _mounting(options, say or _warn))


def _mounting(options: SourceOptions, say: Callable[[str], None]) -> Mounting:
    from headvox.sources.mounting import Mounting

    return Mounting(options.T_world_mount, say)


def _open_recording(folder: Path, options: SourceOptions | None, say: Callable[[str], None]) -> Source:
    from headvox.sources.extrinsics import read_extrinsics
    from headvox.sources.options import SourceOptions, check_unused
    from headvox.sources.recording import RecordingSource

    options = options or SourceOptions()
    check_unused(replace(options, extrinsics=None), folder.name)
    placed = {} if options.extrinsics is None else read_extrinsics(options.extrinsics)
    source = RecordingSource(folder, placed)
    if source.unread:
        some = ", ".join(source.unread[:4]) + (", .." if len(source.unread) > 4 else "")
        say(
            f"{folder.name}: recording.json says of a camera what is not read: {some}; images are taken to be those "
            "of pinhole cameras without distortion"
        )
    frozen = [camera for camera in source.moving() if camera in placed]
    if frozen:
        say(
            f"{folder.name}: --extrinsics holds cameras still that move in the recording: {', '.join(frozen)}; "
            "its poses of them are not used"
        )
    return source


def _open_bag(place: Path, options: SourceOptions, say: Callable[[str], None]) -> Source:
    from headvox.ros.bagfile import Bag
    from headvox.sources.bag import BagSource
    from headvox.sources.options import check_stamped
    from headvox.sources.realsense import RealSenseFile, is_recorded

    check_stamped(options, place.name)
    bag = Bag(place)
    if is_recorded(bag.topics):
        bag.close()
        return RealSenseFile(place, options, say)
    return BagSource(bag, options, say)


def _warn(text: str) -> None:
    warnings.warn(text, stacklevel=3)
