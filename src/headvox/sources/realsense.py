"""RealSense cameras: live, and recorded by their SDK. pyrealsense2 is imported when one is opened."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from headvox.data import F64, BadFrame, DepthImage, Frame, Intrinsics
from headvox.errors import HeadvoxError, MissingExtra, Undecided
from headvox.machine.latest import Latest
from headvox.ros.synchronise import Reading, Synchroniser
from headvox.sources.extrinsics import read_extrinsics
from headvox.sources.options import ASSUMED, SourceOptions, assumed_mount, mounted

PREFIX = "realsense:"
FIRST_FRAME_S = 5.0  # a camera takes a second or two to begin
SILENT_S = 2.0  # after its first frame
_TOLERANCE_NS = 20_000_000  # images whose stamps differ by no more belong to one frame
_WAIT_S = 0.05
_POLL_MS = 200


def is_recorded(topics: Iterable[str]) -> bool:
    """Tell whether a bag with these topics was recorded by the SDK, which has a layout of its own."""
    names = list(topics)
    return "/file_version" in names and any(name.startswith("/device_0/") for name in names)


class RealSenseFile:
    """A recording of the SDK (.bag, .db3), played as fast as it is read, without a camera."""

    length: int | None = None

    def __init__(self, path: Path, options: SourceOptions, say: Callable[[str], None]) -> None:
        """Open the file; ``say`` is told what is assumed.

        Raises:
            HeadvoxError: pyrealsense2 is not installed, or there is no depth in the file.
        """
        rs = _pyrealsense2()
        self.name = path.name
        self._pipeline = rs.pipeline()
        config = rs.config()
        self._stopped = rs.playback_status.stopped
        self._open = False
        try:
            config.enable_device_from_file(str(path), repeat_playback=False)
            config.enable_stream(rs.stream.depth)
            device = config.resolve(rs.pipeline_wrapper(self._pipeline)).get_device()
            self._playback = device.as_playback()
            # Before it starts: in real time, what nobody waits for is lost.
            self._playback.set_real_time(False)
            started = self._pipeline.start(config)
            self._open = True
            serial = device.get_info(rs.camera_info.serial_number)
            profile = started.get_stream(rs.stream.depth).as_video_stream_profile()
            scale = _depth_scale(rs, device.query_sensors())
            self._camera = _intrinsics(profile, scale)
            self.words = f"{serial}, {self._camera.width}x{self._camera.height}"
            self._T_world_camera = _places(self.name, [serial], options, say)[serial]
        except RuntimeError as error:
            self.close()
            raise HeadvoxError(f"{self.name}: {_one_line(error)}.", "Has it a depth stream?") from None
        except BaseException:
            self.close()
            raise

    def __iter__(self) -> Iterator[Frame | BadFrame]:
        """Yield a frame for each depth image, until the end or until closed."""
        silent_since = time.monotonic()
        while self._open:
            # Asked before the wait: the last image may still be on its way when the player has stopped.
            is_over = self._playback.current_status() == self._stopped
            good, frames = self._pipeline.try_wait_for_frames(_POLL_MS)
            if good:
                silent_since = time.monotonic()
                depth = frames.get_depth_frame()
                if depth:
                    yield self._frame(depth)
            elif is_over:
                return
            elif time.monotonic() - silent_since > FIRST_FRAME_S:
                yield BadFrame(0, f"{self.name}: nothing came for {FIRST_FRAME_S:g} s.")
                return

    def _frame(self, depth: Any) -> Frame | BadFrame:
        image = DepthImage("depth", np.array(depth.get_data()), self._camera, self._T_world_camera)
        return _checked(_stamp_ns(depth), [image])

    def close(self) -> None:
        """Stop."""
        if self._open:
            self._open = False
            with suppress(RuntimeError):
                self._pipeline.stop()


class RealSenseLive:
    """Cameras that are plugged in, images of one moment together; the newest wins when nobody keeps up."""

    length: int | None = None

    def __init__(
        self,
        serials: Sequence[str],
        options: SourceOptions,
        say: Callable[[str], None],
        devices: Sequence[Any] | None = None,
    ) -> None:
        """Start cameras; ``say`` is told what is assumed.

        Args:
            serials: of those to open; by default those in the extrinsics, else all there are.
            options: where they stand.
            say: told what is assumed.
            devices: of pyrealsense2 to choose from, instead of those that are plugged in.

        Raises:
            HeadvoxError: pyrealsense2 is not installed, a camera is not there or does not start.
        """
        rs = _pyrealsense2()
        known = rs.context().query_devices() if devices is None else devices
        there = {device.get_info(rs.camera_info.serial_number): device for device in known}
        self.name = PREFIX.rstrip(":")
        wanted = list(serials)
        if not wanted and options.extrinsics is not None:
            wanted = sorted(read_extrinsics(options.extrinsics))
        wanted = wanted or sorted(there)
        for serial in wanted or ["any"]:
            if serial not in there:
                what = "no RealSense camera is plugged in" if not there else f"there is no camera {serial}"
                plugged = (
                    f"Plugged in: {', '.join(sorted(there))}."
                    if there
                    else "Check the cable, and USB rights."
                )
                raise HeadvoxError(f"{self.name}: {what}.", plugged)
        self._places = _places(self.name, wanted, options, say)
        self._synchroniser = Synchroniser(_TOLERANCE_NS, _WAIT_S, SILENT_S, frozenset(wanted))
        self._lock = threading.Lock()
        self._sets: Latest[list[Reading]] = Latest()
        self._heard = dict.fromkeys(wanted, time.monotonic() + FIRST_FRAME_S - SILENT_S)
        self._sensors: list[Any] = []
        self._cameras: dict[str, Intrinsics] = {}
        self._open = True
        try:
            for serial in wanted:
                self._start(rs, serial, there[serial])
        except RuntimeError as error:
            self.close()
            raise HeadvoxError(
                f"{self.name}: camera {serial} does not start: {_one_line(error)}.",
                "Does another program use it?",
            ) from None
        except BaseException:
            self.close()
            raise

    def _start(self, rs: Any, serial: str, device: Any) -> None:
        found = [
            (sensor, profile)
            for sensor in device.query_sensors()
            for profile in sensor.get_stream_profiles()
            if profile.stream_type() == rs.stream.depth and profile.format() == rs.format.z16
        ]
        if not found:
            raise HeadvoxError(f"{self.name}: camera {serial} has no depth stream.", "Choose another.")
        sensor, profile = next((pair for pair in found if pair[1].is_default()), found[0])
        self._cameras[serial] = _intrinsics(profile.as_video_stream_profile(), _depth_scale(rs, [sensor]))
        is_alone = len(self._places) == 1
        sensor.open(profile)
        self._sensors.append(sensor)
        sensor.start(lambda frame: self._on_frame(rs, serial, frame, is_alone))

    def _on_frame(self, rs: Any, serial: str, frame: Any, is_alone: bool) -> None:
        """Sort an image in; in a thread of the SDK, that must not raise."""
        if not self._open or frame.get_profile().stream_type() != rs.stream.depth:
            return
        now = time.monotonic()
        self._heard[serial] = now
        # The clocks of cameras differ, unless the SDK has brought them together with the host's.
        has_own_clock = frame.get_frame_timestamp_domain() == rs.timestamp_domain.hardware_clock
        stamp = time.time_ns() if has_own_clock and not is_alone else _stamp_ns(frame)
        reading = Reading(serial, stamp, now, np.array(frame.get_data()))
        with self._lock:  # each camera has a thread of its own
            for readings in self._synchroniser.add(reading):
                self._sets.put(readings)

    def __iter__(self) -> Iterator[Frame | BadFrame]:
        """Yield the newest set of images, until closed.

        Raises:
            HeadvoxError: a camera gives no images: it was unplugged, perhaps.
        """
        while self._open:
            readings = self._sets.take(_WAIT_S)
            for serial, heard in self._heard.items():
                if time.monotonic() - heard > SILENT_S:
                    raise HeadvoxError(
                        f"{self.name}: camera {serial} gives no images (any more).",
                        "Is it plugged in? Try another cable.",
                    )
            if readings is not None:
                yield self._frame(readings)

    def _frame(self, readings: Sequence[Reading]) -> Frame | BadFrame:
        images = [
            DepthImage(r.sensor, r.message, self._cameras[r.sensor], self._places[r.sensor]) for r in readings
        ]
        return _checked(max(reading.stamp_ns for reading in readings), images)

    def close(self) -> None:
        """Stop the cameras, and let whoever waits for a frame go."""
        self._open = False
        self._sets.close()
        sensors, self._sensors = self._sensors, []
        for sensor in sensors:
            for end in (sensor.stop, sensor.close):
                with suppress(RuntimeError):  # it was unplugged
                    end()


def _pyrealsense2() -> Any:
    try:
        import pyrealsense2
    except ModuleNotFoundError:
        raise MissingExtra("RealSense cameras need the package 'pyrealsense2'.", "realsense") from None
    except ImportError as error:  # a library of the system is missing
        raise HeadvoxError(
            f"The package 'pyrealsense2' cannot be loaded: {error}.", "On Debian: apt install libusb-1.0-0"
        ) from None
    return pyrealsense2


def _places(
    name: str, serials: Sequence[str], options: SourceOptions, say: Callable[[str], None]
) -> Mapping[str, F64]:
    """Return T_world_camera of each camera.

    Raises:
        HeadvoxError: nothing tells where a camera stands; Undecided where that cannot be assumed.
    """
    if options.extrinsics is not None:
        told = read_extrinsics(options.extrinsics)
        for serial in serials:
            if serial not in told:
                raise HeadvoxError(
                    f"{options.extrinsics}: camera {serial} is not in it.", f"Add [cameras.{serial}]."
                )
        return {serial: told[serial] for serial in serials}
    if len(serials) > 1:
        raise Undecided(
            f"{name}: there are {len(serials)} cameras, and nothing tells where they stand.",
            "Give --extrinsics FILE (docs/conventions.md), or choose one of:",
            tuple(f"{PREFIX}{serial}" for serial in serials),
        )
    if options.T_world_mount is None:
        say(f"{name}: the camera {ASSUMED}")
    T_world_mount = assumed_mount() if options.T_world_mount is None else options.T_world_mount
    return {serials[0]: mounted(T_world_mount, is_optical=True)}


def _checked(stamp_ns: int, images: Sequence[DepthImage]) -> Frame | BadFrame:
    for image in images:
        expected = (image.intrinsics.height, image.intrinsics.width)
        if image.depth.shape != expected or image.depth.dtype != np.uint16:
            return BadFrame(stamp_ns, f"{image.name}: the image is {image.depth.shape}, expected {expected}.")
    return Frame(stamp_ns, depths=tuple(images))


def _intrinsics(profile: Any, scale: float) -> Intrinsics:
    lens = profile.get_intrinsics()
    return Intrinsics(lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy, scale)


def _depth_scale(rs: Any, sensors: Iterable[Any]) -> float:
    """Return metres a unit; the SDK has it as float32, in which 0.001 is 0.00100000005."""
    for sensor in sensors:
        if sensor.supports(rs.option.depth_units):
            return float(f"{sensor.get_option(rs.option.depth_units):.6g}")
    return 0.001


def _stamp_ns(frame: Any) -> int:
    stamp_ms: float = frame.get_timestamp()
    return round(stamp_ms * 1e6)


def _one_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:160].rstrip(".")
