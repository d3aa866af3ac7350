"""How fast clouds come out of bags: the time from one frame to the next, for 10 MB clouds in each kind of bag.

    python bench/bag.py [--frames 60] [--folder DIR]

The cloud is that of an 848x480 camera before a wavy wall: x, y, z and another number, 24 bytes a point with padding.
What is read was just written, and so is in the memory of the operating system: a slow disk is not in the figures.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_typestore

from headvox.bench.input import describe_machine
from headvox.commands.table import table
from headvox.data import Frame
from headvox.sources import open_source

WIDTH, HEIGHT, STEP = 848, 480, 24
NS = 1_000_000_000
REAL_TIME_MS = 1000.0 / 30.0
KIND = "sensor_msgs/msg/PointCloud2"


def cloud(frame: int) -> np.ndarray:
    """Return the bytes of a cloud, (HEIGHT, WIDTH, STEP) uint8."""
    rng = np.random.default_rng(frame)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    z = 2.0 + 0.3 * np.sin(0.02 * u + 0.1 * frame) + rng.normal(0.0, 0.003, (HEIGHT, WIDTH))
    points = np.stack([(u - 423.5) / 430.0 * z, (v - 239.5) / 430.0 * z, z, 0.001 * z], -1).astype("<f4")
    data = np.zeros((HEIGHT, WIDTH, STEP), np.uint8)
    data[..., :16] = points.view(np.uint8).reshape(HEIGHT, WIDTH, 16)
    return data


def messages(store: Any, frames: int) -> Iterator[tuple[int, Any]]:
    """Yield stamps and messages, 30 a second."""
    kinds = store.types
    more = {"seq": 0} if store.fielddefs["std_msgs/msg/Header"][1][0][0] == "seq" else {}
    fields = [
        kinds["sensor_msgs/msg/PointField"](name, 4 * k, 7, 1) for k, name in enumerate(("x", "y", "z", "i"))
    ]
    for frame in range(frames):
        stamp = NS + frame * NS // 30
        header = kinds["std_msgs/msg/Header"](
            stamp=kinds["builtin_interfaces/msg/Time"](*divmod(stamp, NS)), frame_id="world", **more
        )
        data = cloud(frame).ravel()
        yield stamp, kinds[KIND](header, HEIGHT, WIDTH, fields, False, STEP, WIDTH * STEP, data, True)


def write_ros2(path: Path, frames: int, plugin: StoragePlugin, mode: CompressionMode) -> None:
    """Write a bag of ROS 2."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        topic = writer.add_connection("/points", KIND, typestore=store)
        for stamp, message in messages(store, frames):
            writer.write(topic, stamp, store.serialize_cdr(message, KIND))


def write_ros1(path: Path, frames: int, compression: str = "") -> None:
    """Write a bag of ROS 1."""
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = rosbag1.Writer(path)
    if compression:
        writer.set_compression(writer.CompressionFormat[compression])
    with writer:
        topic = writer.add_connection("/points", KIND, typestore=store)
        for stamp, message in messages(store, frames):
            writer.write(topic, stamp, store.serialize_ros1(message, KIND))


KINDS: dict[str, Callable[[Path, int], None]] = {
    "MCAP": lambda path, n: write_ros2(path, n, StoragePlugin.MCAP, CompressionMode.NONE),
    "MCAP, zstd chunks": lambda path, n: write_ros2(path, n, StoragePlugin.MCAP, CompressionMode.STORAGE),
    "sqlite3": lambda path, n: write_ros2(path, n, StoragePlugin.SQLITE3, CompressionMode.NONE),
    "sqlite3, zstd messages": lambda path, n: write_ros2(
        path, n, StoragePlugin.SQLITE3, CompressionMode.MESSAGE
    ),
    "ROS 1": write_ros1,
    "ROS 1, lz4": lambda path, n: write_ros1(path, n, "LZ4"),
}


def clocks() -> np.ndarray:
    """Return the time on the wall and that of this process, in milliseconds."""
    return 1e3 * np.array([time.perf_counter(), time.process_time()])


def read(path: Path) -> np.ndarray:
    """Return the milliseconds, on the wall and of this process, that each frame took to come, but for the first."""
    took = []
    with closing(open_source(path)) as source:
        last = clocks()
        for frame in source:
            assert isinstance(frame, Frame), frame
            assert len(frame.clouds[0].points) == WIDTH * HEIGHT
            now = clocks()
            took.append(now - last)
            last = now
    return np.array(took[1:])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--folder", type=Path, help="where the bags are written for the time of the run")
    args = parser.parse_args()
    rows = []
    for kind, write in KINDS.items():
        with tempfile.TemporaryDirectory(dir=args.folder) as folder:
            path = Path(folder) / "bag"
            write(path, args.frames)
            size = sum(p.stat().st_size for p in [path, *path.rglob("*")] if p.is_file())
            took = read(path)
        (p50, cpu50), (p99, cpu99) = np.percentile(took, (50, 99), axis=0)
        times = [f"{value:.1f}" for value in (p50, p99, cpu50, cpu99)]
        rows.append([kind, f"{size / args.frames / 1e6:.1f}", *times, "yes" if p99 < REAL_TIME_MS else "no"])
    made = describe_machine()
    machine = (
        f"{made['processor']}, {made['cores']} cores, Python {made['python']}, load {made['load_average']}"
    )
    print(f"{WIDTH * HEIGHT * STEP / 1e6:.1f} MB clouds, {args.frames} frames; {machine}\n")
    print(table(["bag", "MB a frame", "wall ms, p50", "p99", "CPU ms, p50", "p99", "30 Hz at p99"], rows))


if __name__ == "__main__":
    main()
