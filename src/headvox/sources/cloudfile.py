"""One point cloud in one file, whatever its format."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from headvox.data import Cloud, Frame
from headvox.errors import HeadvoxError
from headvox.sources.check import check_cloud
from headvox.sources.content import CloudFile

if TYPE_CHECKING:
    from headvox.sources.mounting import Mounting

MAX_FILE_BYTES = 4 << 30
PNG = b"\x89PNG"
SUFFIXES = (".ply", ".pcd", ".npy", ".npz")
OF_DEPTH = (
    'Depth images need a recording.json, with camera and pose: see "Depth recordings" in docs/conventions.md.'
)


class CloudFileSource:
    """A single file as a source of one frame at ``stamp_ns`` 0."""

    length: int | None = 1

    def __init__(self, path: Path, mounting: Mounting | None = None) -> None:
        """Raise HeadvoxError where the file is missing or no known point-cloud file; it is read later."""
        self.name = path.name
        self.path = path
        self.mounting = mounting
        _reader(_head(path), path.name)

    def __iter__(self) -> Iterator[Frame]:
        """Yield the one frame, or raise HeadvoxError when the file cannot be used."""
        yield Frame(0, clouds=(read_cloud(self.path, self.mounting),))

    def close(self) -> None:
        """Do nothing: the file is open only while it is read."""


def read_cloud(path: Path, mounting: Mounting | None = None) -> Cloud:
    """Read one file as a cloud with points in it, placed by ``mounting``.

    Raises:
        HeadvoxError: the file is missing, damaged or of unknown kind, or check_cloud refuses its points.
    """
    file = read_cloud_file(path)
    cloud = Cloud(path.name, file.points, file.T_world_sensor)
    return cloud if mounting is None else mounting.placed(cloud)


def read_cloud_file(path: Path) -> CloudFile:
    """Read one file with all that is known about it; errors as for :func:`read_cloud`."""
    reader = _reader(_head(path), path.name)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise _unreadable(path.name, error) from None
    cloud = reader(data, path.name)
    check_cloud(cloud.points, path.name)
    return cloud


def _head(path: Path) -> bytes:
    """Return the first bytes of a regular file; a pipe or a device could block for ever."""
    try:
        if path.exists() and not path.is_file():
            raise HeadvoxError(f"{path.name}: expected a file or a folder, this is neither.", "Give a file.")
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise HeadvoxError(
                f"{path.name}: {size} bytes, expected at most {MAX_FILE_BYTES}.", "Cut it into frames."
            )
        with path.open("rb") as file:
            return file.read(4096)
    except FileNotFoundError:
        raise HeadvoxError(f"{path}: there is no such file.", "Check the path.") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise _unreadable(path.name, error) from None


def _unreadable(name: str, error: Exception) -> HeadvoxError:
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return HeadvoxError(f"{name}: cannot be read: {reason}.", "Check the path and its permissions.")


def _reader(head: bytes, name: str) -> Callable[[bytes, str], CloudFile]:
    """Choose the reader by how the file begins. The modules are imported only when one is needed."""
    if head[:3] == b"ply" and head[3:4] in (b"\n", b"\r"):
        from headvox.sources.ply import read_ply

        return read_ply
    if head[:6] == b"\x93NUMPY":
        from headvox.sources.arrays import read_npy

        return read_npy
    if head[:2] == b"PK":
        from headvox.sources.arrays import read_npz

        return read_npz
    if _begins_like_pcd(head):
        from headvox.sources.pcd import read_pcd

        return read_pcd
    expected = "expected a bag, or a ply, pcd, npy or npz file"
    if head.startswith(PNG):
        raise HeadvoxError(f"{name}: {expected}, it is a PNG image.", OF_DEPTH)
    raise HeadvoxError(
        f"{name}: {expected}, it begins with {head[:12]!r}."
        if head
        else f"{name}: the file is empty, {expected}.",
        "Convert it to one of these, or give the folder of a recording.",
    )


def _begins_like_pcd(head: bytes) -> bool:
    for line in head.splitlines():
        if line.strip() and not line.startswith(b"#"):
            return line.split()[0] in (b"VERSION", b"FIELDS", b"COLUMNS")
    return head.startswith(b"# .PCD")
