"""The command ``headvox doctor``: what this machine has, what is missing, and whether heads are found on it."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from headvox import __version__
from headvox.commands.flags import GOOD, KNOWN_ERROR, add_command
from headvox.commands.table import printable, table
from headvox.sample import sample_folder

if TYPE_CHECKING:
    from headvox.commands.flags import Commands

LIBRARIES = ("numpy", "numba", "llvmlite", "scipy", "pillow")
EXTRAS = {
    "view": ("rerun", "imageio_ffmpeg"),
    "plot": ("matplotlib",),
    "bag": ("rosbags", "mcap"),
    "eval": ("motmetrics",),
    "evolve": ("lightgbm", "cmaes"),
    "cluster": ("distributed", "fsspec"),
    "realsense": ("pyrealsense2",),
    "cuda": ("numba_cuda", "nvidia.cuda_nvcc", "nvidia.cuda_nvrtc"),
    "completion": ("shtab",),
    "sim": ("mujoco",),
}
SHORT_S, LONG_S = 10, 240  # compiling everything takes a minute or two on a slow machine
WITHIN_M = 0.10
CAMERAS = """
import pyrealsense2 as rs
for device in rs.context().devices:
    print(device.get_info(rs.camera_info.name))
"""
DETECT = "from headvox.commands.doctor import find_true_heads; print(*find_true_heads())"


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that was looked at; ``good`` is None where it does not matter to the verdict."""

    name: str
    told: str
    good: bool | None = None


def add_to(commands: Commands) -> None:
    """Add ``headvox doctor`` to the command line."""
    doctor = add_command(commands, "doctor", _doctor, "tell what is installed, and whether it works")
    doctor.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")


def _doctor(args: argparse.Namespace) -> int:
    checks = examine()
    good = all(check.good is not False for check in checks)
    if args.json:
        print(json.dumps({"good": good, "checks": [asdict(check) for check in checks]}))
    else:
        marks = {True: "ok", False: "FAILED", None: ""}
        print(table([], [[check.name, printable(check.told), marks[check.good]] for check in checks]))
        print("\nheadvox works here." if good else "\nheadvox does not work here: see what FAILED.")
    return GOOD if good else KNOWN_ERROR


def examine() -> list[Check]:
    """Look at everything; nothing that is absent is imported, and nothing takes longer than its limit."""
    checks = [
        Check("headvox", __version__),
        Check("Python", f"{platform.python_version()}, {sys.executable}"),
    ]
    checks += [_library(name) for name in LIBRARIES]
    checks += [
        Check("processor", _processor()),
        Check("cores", f"{_cores()} of {os.cpu_count()} may be used"),
    ]
    checks += [_cache(), _gpu(), _cameras(), _ros()]
    checks += [_extra(name, modules) for name, modules in EXTRAS.items()]
    return [*checks, _detection()]


def _library(name: str) -> Check:
    try:
        return Check(name, version(name), True)
    except PackageNotFoundError:
        return Check(name, f"missing: pip install {name}", False)


def _processor() -> str:
    """Return the name of the processor."""
    name = platform.processor() or platform.machine()
    if sys.platform == "linux":
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as told:
            names = [line.partition(":")[2].strip() for line in told if line.startswith("model name")]
        name = names[0] if names else name
    return name


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _cache() -> Check:
    """Tell where compiled loops are kept, how wide their vectors are, and whether they are there already."""
    code = (
        "import os; from headvox.warmup import cache_folder, kept_loops; from headvox.machine.simd import LANES; "
        "f = cache_folder(); near = f if f.exists() else f.parent; print(f); print(os.access(near, os.W_OK)); "
        "print(kept_loops()); print(LANES)"
    )
    done = _python(code, SHORT_S * 3)
    lines = [] if done is None else done.stdout.splitlines()
    if len(lines) != 4:
        return Check("compiled loops", f"cannot be kept: {_last_line(done)}; set NUMBA_CACHE_DIR", False)
    folder, writable, count, lanes = lines
    kept = f"{count} kept" if int(count) else "none yet: the first run compiles, `headvox warmup` does it now"
    told = f"{folder}, {kept}; vectors of {lanes} numbers"
    if writable != "True":
        return Check("compiled loops", f"{told}; cannot be written: set NUMBA_CACHE_DIR", int(count) > 0)
    return Check("compiled loops", told, True)


def _gpu() -> Check:
    program = shutil.which("nvidia-smi")
    if program is None:
        return Check("GPU", "none found; none is needed")
    done = _run([program, "--query-gpu=name,driver_version", "--format=csv,noheader"], SHORT_S)
    found = done is not None and done.returncode == 0 and done.stdout.strip()
    return Check(
        "GPU", ", ".join(done.stdout.split("\n")).strip(", ") if done and found else "nvidia-smi finds none"
    )


def _cameras() -> Check:
    if importlib.util.find_spec("pyrealsense2") is None:
        return Check("RealSense", "cannot be asked without the extra")
    done = _python(CAMERAS, SHORT_S)
    if done is None or done.returncode:
        return Check("RealSense", f"cannot be asked: {_last_line(done)}")
    return Check("RealSense", ", ".join(done.stdout.split("\n")).strip(", ") or "no camera is connected")


def _ros() -> Check:
    if importlib.util.find_spec("rclpy") is None:
        return Check("ROS 2", "no rclpy: source /opt/ros/DISTRO/setup.bash, for the nodes")
    return Check("ROS 2", os.environ.get("ROS_DISTRO") or "rclpy found")


def _extra(name: str, modules: tuple[str, ...]) -> Check:
    missing = [module for module in modules if not _is_there(module)]
    told = "installed" if not missing else f"no {', '.join(missing)}: pip install 'headvox[{name}]'"
    return Check(f"extra {name}", told)


def _is_there(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # not even the package that it is in
        return False


def _detection() -> Check:
    """Find the heads of the sample's first frame, in a process that can be stopped."""
    done = _python(DETECT, LONG_S)
    if done is None:
        return Check("detection", f"took longer than {LONG_S} s", False)
    if done.returncode:
        return Check("detection", _last_line(done), False)
    found, true, worst_m, ms = done.stdout.split()
    told = f"{found} of {true} heads of the sample's first frame, {100 * float(worst_m):.1f} cm off at most, {ms} ms"
    return Check("detection", told, found == true)


def find_true_heads() -> tuple[int, int, str, str]:
    """Return how many of the true heads of the sample's first frame are found, of how many, how far off, in what time.

    Found is what is closer than 10 cm; the distance is in metres, the time in milliseconds.
    """
    import time

    import numpy as np

    from headvox.data import Frame
    from headvox.pipeline import Detector
    from headvox.sources import open_source

    detector = Detector()
    with (sample_folder() / "heads.jsonl").open(encoding="utf-8") as lines:
        true = np.array([head["centre"] for head in json.loads(next(lines))["heads"]])
    frame = next(iter(open_source(sample_folder())))
    assert isinstance(frame, Frame)
    detector.detect_frame(frame)  # compiles
    begun = time.perf_counter()
    heads = detector.detect_frame(frame)
    ms = 1e3 * (time.perf_counter() - begun)
    away = np.linalg.norm(true[:, None] - heads.centres, axis=2).min(axis=1, initial=np.inf)
    found = away < WITHIN_M
    return int(found.sum()), len(true), f"{away[found].max(initial=0.0):.4f}", f"{ms:.1f}"


def _python(code: str, seconds: float) -> subprocess.CompletedProcess[str] | None:
    return _run([sys.executable, "-c", code], seconds)


def _run(command: list[str], seconds: float) -> subprocess.CompletedProcess[str] | None:
    """Run a command; None when it takes longer."""
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        return None


def _last_line(done: subprocess.CompletedProcess[str] | None) -> str:
    if done is None:
        return "it takes too long"
    return (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
