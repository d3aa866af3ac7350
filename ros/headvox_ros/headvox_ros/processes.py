"""Nodes of this package in processes of their own, for the commands that measure them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import IO, Any

import rclpy
from rclpy.signals import SignalHandlerOptions

from headvox.errors import HeadvoxError
from headvox.sources import open_source

PROFILE = "config/fastdds_large_clouds.xml"
START_S = 90.0  # the first run compiles
END_S = 20.0


def start(module: str, parameters: Sequence[str], said: IO[str]) -> subprocess.Popen[str]:
    """Start a node with ``NAME:=VALUE`` parameters; what it says goes to ``said``."""
    command = [sys.executable, "-m", f"headvox_ros.{module}", "--ros-args"]
    for parameter in parameters:
        command += ["-p", parameter]
    return subprocess.Popen(command, stdout=said, stderr=subprocess.STDOUT, text=True)


def end(processes: Iterable[subprocess.Popen[str]]) -> None:
    """Let processes that still run end by themselves; kill one that does not."""
    for process in processes:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def spin_until(
    listener: Any, happened: Callable[[], bool], seconds: float, node: subprocess.Popen[str]
) -> bool:
    """Let ``listener`` hear until ``happened()``, the time is over, or ``node`` ended; return whether it happened."""
    over = time.monotonic() + seconds
    while not (done := happened()) and time.monotonic() < over and node.poll() is None:
        rclpy.spin_once(listener, timeout_sec=0.1)
    return done


def run(
    name: str, work: Callable[[], None], arguments: Sequence[str] | None = None, *, measurement: bool = False
) -> int:
    """Do ``work`` within ROS, and return the exit code: 0, or 1 where it failed.

    SIGINT and SIGTERM raise KeyboardInterrupt, so that what was started can be ended. A node then ends with 0; a
    ``measurement``, which is not complete, with 130. One of those also keeps to this machine, and lets large clouds go
    through shared memory, unless the environment says otherwise.
    """
    try:
        if measurement:
            os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
            os.environ.setdefault("FASTDDS_DEFAULT_PROFILES_FILE", str(profile()))
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        work()
    except HeadvoxError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130 if measurement else 0
    finally:
        rclpy.try_shutdown()
    return 0


def topics(recording: str, topic: str) -> list[str]:
    """Return the topics ``/CAMERA/topic`` of a recording's cameras."""
    cameras = {image.name for frame in open_source(recording) for image in getattr(frame, "depths", ())}
    return [f"/{camera}/{topic}" for camera in sorted(cameras)]


def profile() -> Path:
    """Return the Fast DDS profile: beside the sources, or where colcon installed it."""
    here = Path(__file__).resolve()
    installed = [parent / "share" / "headvox_ros" / PROFILE for parent in here.parents]
    found = [path for path in (here.parents[1] / PROFILE, *installed) if path.is_file()]
    if not found:
        raise HeadvoxError(f"There is no {PROFILE}.", "Build the package with colcon.")
    return found[0]
