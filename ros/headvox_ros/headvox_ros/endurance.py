"""The command ``endurance``: the frames of an hour through the node, as fast as it answers; does its memory grow?

It sends a depth recording over and over to a ``head_detector`` of its own, each frame when the one before was answered,
and reads from /proc what that process holds. Linux only.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from operator import contains
from pathlib import Path

from geometry_msgs.msg import PoseArray

from headvox.errors import HeadvoxError
from headvox.ros.messages import stamp_ns
from headvox.ros.synchronise import NS
from headvox_ros import processes
from headvox_ros.play_recording import Player

STEP_NS = NS // 10
HOUR = 36_000  # frames at 10 Hz
ANSWER_S = 30.0
SETTLED = 200  # frames until everything has been met once
QUARTERS = 4


@dataclass(frozen=True, slots=True)
class Held:
    """What a process holds after some frames were answered."""

    frames: int
    seconds: float
    memory_mb: float
    threads: int
    files: int


def endure(recording: str, count: int) -> Iterator[Held]:
    """Let a node answer ``count`` frames; yield what it holds after the first ones, and after each quarter.

    Raises:
        HeadvoxError: the node did not start, ended, or left a frame without an answer.
    """
    marks = {min(SETTLED, count), *(k * count // QUARTERS for k in range(1, QUARTERS + 1))}
    player = Player()
    answered: list[int] = []
    player.create_subscription(
        PoseArray, "/head_detector/poses", lambda message: answered.append(stamp_ns(message.header.stamp)), 10
    )
    depths = processes.topics(recording, "depth/image_rect_raw")
    settings = [f"depths:={depths}", "target_frame:=world", "reliability:=reliable", "sync_wait_s:=1.0"]
    with tempfile.TemporaryFile("w+") as said:
        node = processes.start("head_detector", settings, said)
        try:
            _wait_for_node(player, node, depths)
            begin_s = time.monotonic()
            for k in range(1, count + 1):
                stamp = k * STEP_NS
                player.publish(player.frames[k % len(player.frames)], stamp)
                if not processes.spin_until(player, partial(contains, answered, stamp), ANSWER_S, node):
                    said.seek(0)
                    raise HeadvoxError(f"Frame {k} of {count} was not answered.", said.read().strip()[-500:])
                answered.clear()
                if k in marks:
                    yield _held(node.pid, k, time.monotonic() - begin_s)
        finally:
            processes.end([node])
            player.destroy_node()


def _wait_for_node(player: Player, node: subprocess.Popen[str], depths: Sequence[str]) -> None:
    """Wait until the node hears every camera, and is heard."""

    def is_there() -> bool:
        return (
            all(player.count_subscribers(topic) for topic in depths)
            and player.count_publishers("/head_detector/poses") > 0
        )

    if not processes.spin_until(player, is_there, processes.START_S, node):
        raise HeadvoxError("head_detector did not start.", "Start it by itself to see why.")
    processes.spin_until(player, lambda: False, 1.0, node)  # both ends have to know


def _held(pid: int, frames: int, seconds: float) -> Held:
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    memory_kib, threads = int(status["VmRSS"].split()[0]), int(status["Threads"])
    return Held(frames, seconds, memory_kib * 1024e-6, threads, len(os.listdir(f"/proc/{pid}/fd")))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("recording", help="a depth recording, say the sample that comes with headvox")
    parser.add_argument("--frames", type=int, default=HOUR, help=f"how many ({HOUR}: an hour at 10 Hz)")
    args = parser.parse_args(arguments)
    if args.frames < 1:
        parser.error(f"--frames: expected 1 or more, got {args.frames}")

    def measure() -> None:
        print("  frames  seconds  resident MB  threads  files")
        for row in endure(args.recording, args.frames):
            print(
                f"{row.frames:8d}{row.seconds:9.1f}{row.memory_mb:13.1f}{row.threads:9d}{row.files:7d}",
                flush=True,
            )

    return processes.run(
        "endurance", measure, ["--ros-args", "-p", f"recording:={args.recording}"], measurement=True
    )


if __name__ == "__main__":
    sys.exit(main())
