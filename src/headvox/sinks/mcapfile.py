"""Heads as ROS 2 messages in an MCAP file, which Foxglove and rerun open: what the ROS node publishes."""

from __future__ import annotations

from pathlib import Path

from headvox.ros import outputs
from headvox.ros.mcapfile import McapFile
from headvox.sinks.result import Result

NODE = "/head_detector"
_LIFETIME_S = 0.5


class McapSink:
    """Writes detections, poses, markers, tracks and the frames of heads, with the stamps of the frames.

    ``frame`` is the name of the world; a robot's own, where the source has one.
    """

    def __init__(self, path: Path, frame: str = "world") -> None:
        self._file = McapFile(path)
        self._frame = frame
        self._board = outputs.MarkerBoard(_LIFETIME_S)

    def write(self, result: Result) -> None:
        """Write the messages of one frame."""
        heads = (
            outputs.of_detections(result.heads) if result.tracks is None else outputs.of_tracks(result.tracks)
        )
        seen = [head for head in heads if head.is_seen]
        stamp = result.stamp_ns
        header = outputs.header_of(stamp, self._frame)
        put = self._file.write
        put(f"{NODE}/heads", "vision_msgs/msg/Detection3DArray", stamp, outputs.detections(header, seen))
        put(f"{NODE}/poses", "geometry_msgs/msg/PoseArray", stamp, outputs.poses(header, seen))
        put(f"{NODE}/markers", "visualization_msgs/msg/MarkerArray", stamp, self._board.show(header, heads))
        for track in outputs.tracks(header, heads):
            put(f"{NODE}/tracks", "nav_msgs/msg/Odometry", stamp, track)
        put("/tf", "tf2_msgs/msg/TFMessage", stamp, outputs.frames(header, heads))

    def close(self) -> None:
        """Finish the file."""
        self._file.close()
