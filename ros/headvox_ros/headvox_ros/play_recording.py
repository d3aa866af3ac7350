"""The node ``play_recording``: a depth recording as if its cameras were here.

It publishes as :mod:`headvox_ros.cameras` says; what the recording knows of the true heads goes out on ``/true_heads``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Container, Iterator
from pathlib import Path

from geometry_msgs.msg import Point, Pose, Quaternion
from rclpy.node import Node

from headvox.data import Frame
from headvox.errors import HeadvoxError
from headvox.evaluate.truth import FILE as TRUTH
from headvox.evaluate.truth import read_truth
from headvox.ros.synchronise import NS
from headvox.sources import open_source
from headvox_ros import processes
from headvox_ros.cameras import Cameras, fixed


class Player(Node):
    """Plays the frames of a recording in memory, at their own pace or another, once or for ever."""

    def __init__(self) -> None:
        super().__init__("play_recording")
        self.path = fixed(self, "recording", "", "Folder of a depth recording.")
        self.rate_hz = fixed(self, "rate_hz", 0.0, "Frames a second; 0 as recorded.")
        self.loops = fixed(self, "loops", 0, "How often to play; 0 for ever.")
        self.depths = fixed(self, "depths", True, "Publish depth images.")
        self.clouds = fixed(self, "clouds", False, "Publish point clouds.")
        self.clock = fixed(self, "clock", False, "Publish /clock, and stamp in the recording's own time.")
        self.rewind = fixed(self, "rewind", False, "With clock: let time jump back at each new loop.")
        self.delay_s = fixed(self, "delay_s", 1.0, "How long to wait for others before the first frame.")
        reliability = fixed(self, "reliability", "reliable", "best_effort or reliable; drivers offer this.")
        self.silent = fixed(
            self, "silent", [""], "Cameras that stop: NAME:FROM:TO in seconds from the first frame."
        )
        if not self.path:
            raise HeadvoxError("There is no recording to play.", "Set it: -p recording:=FOLDER")
        frames = [frame for frame in open_source(self.path) if isinstance(frame, Frame)]
        if not frames or not any(frame.depths for frame in frames):
            raise HeadvoxError(f"{self.path} has no depth images.", "Is it a depth recording?")
        self.frames = frames
        self._truth = _true_heads(Path(self.path))
        images = {image.name: image for frame in reversed(frames) for image in frame.depths}
        self._cameras = Cameras(self, images.values(), self.depths, self.clouds, self.clock, reliability)

    def play(self) -> None:
        """Publish every frame at its time."""
        gone = [self._silence(text) for text in self.silent if text]
        time.sleep(self.delay_s)
        skipped = 0
        start_s = time.monotonic() + 0.1
        start_ns = self.frames[0].stamp_ns if self.clock else time.time_ns() + NS // 10
        print(f"playing {len(self.frames)} frames from {start_ns} ns on", flush=True)
        for frame, since_ns in self._schedule():
            wait = start_s + 1e-9 * since_ns - time.monotonic()
            if wait < -1e-9 * self._step_ns():  # a camera does not fall behind: what it cannot send is lost
                skipped += 1
                continue
            time.sleep(max(wait, 0.0))
            again_ns = since_ns if not self.rewind else frame.stamp_ns - self.frames[0].stamp_ns
            now_s = 1e-9 * since_ns
            missing = {name for name, begin, end in gone if begin <= now_s < end}
            self.publish(frame, start_ns + again_ns, missing)
        self._cameras.finish()
        print(f"done, {skipped} frames skipped", flush=True)

    def _schedule(self) -> Iterator[tuple[Frame, int]]:
        """Yield each frame, and when it is due in nanoseconds from the start."""
        step = self._step_ns()
        stamps = [frame.stamp_ns - self.frames[0].stamp_ns for frame in self.frames]
        if self.rate_hz > 0.0:
            stamps = [k * step for k in range(len(stamps))]
        number = 0
        while self.loops <= 0 or number < self.loops * len(stamps):
            loop, k = divmod(number, len(stamps))
            yield self.frames[k], loop * (stamps[-1] + step) + stamps[k]
            number += 1

    def _step_ns(self) -> int:
        """Return the time from frame to frame."""
        count, first, last = len(self.frames), self.frames[0].stamp_ns, self.frames[-1].stamp_ns
        as_recorded = (last - first) // (count - 1) if count > 1 else NS // 10
        return int(NS / self.rate_hz) if self.rate_hz > 0.0 else as_recorded

    def publish(self, frame: Frame, stamp_ns: int, missing: Container[str] = ()) -> None:
        """Publish what the cameras see in a frame, but those that are ``missing``, with a stamp."""
        self._cameras.publish(frame, stamp_ns, missing, self._truth.get(frame.stamp_ns))

    def _silence(self, text: str) -> tuple[str, float, float]:
        try:
            name, begin, end = text.split(":")
            times = float(begin), float(end)
        except ValueError:
            raise HeadvoxError(f"silent: expected NAME:FROM:TO in seconds, got {text!r}.", "") from None
        if name not in self._cameras.names:
            raise HeadvoxError(
                f"silent: there is no camera {name!r}.", f"There is {', '.join(self._cameras.names)}."
            )
        return (name, *times)


def _true_heads(folder: Path) -> dict[int, list[Pose]]:
    """Return the true heads of each labelled frame by its stamp; those to be ignored are left out."""
    path = folder / TRUTH
    if not path.exists():
        return {}
    return {
        stamp: [
            Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
            for (x, y, z), (qx, qy, qz, qw) in zip(
                heads.centres[~heads.ignored].tolist(),
                heads.quaternions[~heads.ignored].tolist(),
                strict=True,
            )
        ]
        for stamp, heads in read_truth(path).items()
    }


def main(arguments: list[str] | None = None) -> int:
    """Run the node; return its exit code."""
    return processes.run("play_recording", lambda: Player().play(), arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv))
