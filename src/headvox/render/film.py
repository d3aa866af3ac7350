"""Pictures into a file: one png, or a moving gif or mp4.

A file is written beside its place and moved there when it is whole: whatever ends the program, there is either the
whole file or none.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import IO

import numpy as np
from PIL import Image

from headvox.errors import HeadvoxError, MissingExtra
from headvox.render.colours import DEPTH, FAINT, FLOOR, GROUND, HEADS, HEIGHT, INK, NOTHING

SUFFIXES = (".gif", ".mp4", ".png")
FASTEST_HZ, SLOWEST_HZ = 60.0, 0.5
LOOK_AHEAD = 8  # pictures whose stamps tell how fast a film runs
SINGLE_MS = 1000
SHADES = 256


class Film(ABC):
    """Takes pictures of the same size, RGB, with their stamps; :meth:`close` makes the file, if there was any.

    As a context it closes itself, and leaves no file after an error.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            handle, name = tempfile.mkstemp(path.suffix, f".{path.stem}-", path.parent)
        except OSError as error:
            raise HeadvoxError(f"Output {path}: {error.strerror or error}.", "Check the path.") from None
        os.close(handle)
        self._spare = Path(name)
        self._any = False

    @abstractmethod
    def add(self, picture: Image.Image, stamp_ns: int) -> None:
        """Take the next picture."""

    def close(self) -> None:
        """Write what came so far, as a whole file."""
        try:
            if self._any:
                self._finish()
                os.chmod(self._spare, 0o666 & ~_umask())
                self._spare.replace(self.path)
        except OSError as error:
            raise HeadvoxError(f"Output {self.path}: {error.strerror or error}.", "Check the disk.") from None
        finally:
            self.discard()

    def discard(self) -> None:
        """Leave no file."""
        self._any = False
        self._spare.unlink(missing_ok=True)

    def __enter__(self) -> Film:
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        """Make the file, or none after an error."""
        if error is None:
            self.close()
        else:
            self.discard()

    @abstractmethod
    def _finish(self) -> None:
        """Complete the spare file."""


def _umask() -> int:
    mask = os.umask(0o022)
    os.umask(mask)
    return mask


def open_film(path: Path) -> Film:
    """Return what writes ``path``, of the kind that its suffix says; an older file is replaced.

    Raises:
        HeadvoxError: the file cannot be made, or what an mp4 needs is not installed.
    """
    kinds: dict[str, Callable[[Path], Film]] = {".png": Png, ".gif": Gif, ".mp4": Mp4}
    return kinds[path.suffix](path)


class Png(Film):
    """The last of the pictures."""

    def add(self, picture: Image.Image, stamp_ns: int) -> None:
        """Keep ``picture``."""
        self._last, self._any = picture, True

    def _finish(self) -> None:
        self._last.save(self._spare, optimize=True)


class Gif(Film):
    """All pictures, each for as long as the stamps say, with one table of colours, so that nothing flickers."""

    def add(self, picture: Image.Image, stamp_ns: int) -> None:
        """Keep ``picture`` in few colours."""
        if not self._any:
            self._frames: list[Image.Image] = []
            self._stamps: list[int] = []
            self._table = _table(picture)
        self._frames.append(picture.quantize(palette=self._table, dither=Image.Dither.NONE))
        self._stamps.append(stamp_ns)
        self._any = True

    def _finish(self) -> None:
        # 10 ms are the steps of a gif; browsers slow down what is shorter than two of them.
        steps = np.diff(self._stamps) / 1e7
        steps = np.append(steps, np.median(steps) if len(steps) else SINGLE_MS / 10)
        shown_ms = (10 * np.clip(np.round(steps), 2, 100 / SLOWEST_HZ)).astype(int).tolist()
        first, *others = self._frames
        first.save(
            self._spare,
            save_all=True,
            append_images=others,
            duration=shown_ms,
            loop=0,
            optimize=False,
            disposal=1,
        )


def _table(picture: Image.Image) -> Image.Image:
    """Return a picture with the palette of them all: the colours that are drawn with, and mixtures from the first."""
    known = np.concatenate([DEPTH, HEIGHT, np.array([GROUND, NOTHING, INK, FLOOR, FAINT, *HEADS], np.uint8)])
    mixed = picture.quantize(SHADES - len(known), Image.Quantize.MEDIANCUT).getpalette() or []
    table = Image.new("P", (1, 1))
    table.putpalette([*known.reshape(-1).tolist(), *mixed])
    return table


class Mp4(Film):
    """All pictures at an even rate, H.264, encoded by the ffmpeg that comes with imageio-ffmpeg."""

    def __init__(self, path: Path) -> None:
        self._program = _ffmpeg()
        super().__init__(path)
        self._waiting: list[tuple[Image.Image, int]] = []
        self._encoder: subprocess.Popen[bytes] | None = None
        # It lives as long as the encoder, not as long as a block: discard() closes it.
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115

    def add(self, picture: Image.Image, stamp_ns: int) -> None:
        """Encode ``picture``, or keep it until the rate is known."""
        self._any = True
        if self._encoder is not None:
            self._encode(picture)
            return
        self._waiting.append((picture, stamp_ns))
        if len(self._waiting) == LOOK_AHEAD:
            self._start()

    def _start(self) -> None:
        width, height = self._waiting[0][0].size
        rate = f"{_rate([stamp for _, stamp in self._waiting]):.3f}"
        command = [
            self._program, "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
            "-r", rate, "-i", "-", "-c:v", "libx264", "-crf", "20", "-pix_fmt", "yuv420p", "-threads", "1",
            "-fflags", "+bitexact", "-flags:v", "+bitexact", "-movflags", "+faststart", "-f", "mp4", str(self._spare),
        ]  # fmt: skip
        # In a session of its own: Ctrl-C is for headvox, which then has the film finished.
        self._encoder = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            start_new_session=True,
        )
        for picture, _ in self._waiting:
            self._encode(picture)
        self._waiting.clear()

    def _encode(self, picture: Image.Image) -> None:
        assert self._encoder is not None
        assert self._encoder.stdin is not None
        try:
            self._encoder.stdin.write(picture.tobytes())
        except BrokenPipeError:
            self._any = False
            raise self._failed() from None

    def _finish(self) -> None:
        if self._encoder is None:
            self._start()
        assert self._encoder is not None
        assert self._encoder.stdin is not None
        self._encoder.communicate()
        if self._encoder.returncode:
            raise self._failed()

    def discard(self) -> None:
        """Leave no file."""
        if self._encoder is not None:
            self._encoder.kill()
            self._encoder.communicate()
        self._errors.close()
        super().discard()

    def _failed(self) -> HeadvoxError:
        self._errors.seek(0)
        said = self._errors.read().decode(errors="replace").strip().splitlines() or ["nothing"]
        return HeadvoxError(
            f"Output {self.path}: the encoder gave up, and said: {said[-1]}", "Is the disk full?"
        )


def _rate(stamps_ns: Sequence[int]) -> float:
    """Return pictures a second."""
    if len(stamps_ns) < 2:
        return 1000 / SINGLE_MS
    step_s = median(b - a for a, b in pairwise(stamps_ns)) / 1e9
    return min(max(1.0 / step_s, SLOWEST_HZ), FASTEST_HZ) if step_s > 0 else 30.0


def _ffmpeg() -> str:
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return str(get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        raise MissingExtra("An mp4 needs imageio-ffmpeg.", "view", instead="write a gif.") from None
