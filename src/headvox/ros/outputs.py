"""Heads -> the contents of ROS messages, as dictionaries that any ROS, or none, makes messages of.

Frames are REP 103's: a head's x is out of its face, y to its left, z up through its crown.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from headvox.data import F64, Heads, State, Tracks
from headvox.ros.synchronise import NS

Content = dict[str, Any]
"""The fields of a message that are not zero, by name; messages within are contents, too."""

SPHERE, CUBE, ARROW, TEXT = 2, 1, 0, 9  # visualization_msgs/Marker
ADD, DELETE = 0, 2
GREY = (0.7, 0.7, 0.7)
UNKNOWN_TURN_RAD2 = float(np.pi**2)  # variance about each axis of an orientation that is not known at all
WIDTH_TO_LENGTH = 0.8  # of a head; its length from forehead to back is that of the fitted sphere
HEIGHT_TO_LENGTH = 1.2
COLOURS = ((0.12, 0.47, 0.71), (1.0, 0.5, 0.05), (0.17, 0.63, 0.17), (0.84, 0.15, 0.16), (0.58, 0.4, 0.74))


@dataclass(frozen=True, slots=True)
class HeadNow:
    """One head in the target frame; NaN where something is not known.

    ``id`` is from 1 on, 0 without a track; ``is_seen`` says whether it was found in this very frame.
    """

    id: int
    is_seen: bool
    centre: F64
    quaternion: F64
    radius: float
    score: float
    centre_covariance: F64
    rotation_covariance: F64
    velocity: F64
    velocity_covariance: F64

    @property
    def is_turned(self) -> bool:
        """Whether its orientation is known."""
        return bool(np.isfinite(self.quaternion).all())


def of_detections(heads: Heads) -> list[HeadNow]:
    """Return detections as they are: without ids and velocities."""
    unknown, unknown3 = np.full(3, np.nan), np.full((3, 3), np.nan)
    rows = zip(heads, heads.centre_covariances, heads.rotation_covariances, strict=True)
    return [
        HeadNow(0, True, h.centre, h.quaternion, h.radius, h.score, centre_cov, turn_cov, unknown, unknown3)
        for h, centre_cov, turn_cov in rows
    ]


def of_tracks(tracks: Tracks) -> list[HeadNow]:
    """Return what a tracker knows: heads it is not sure of yet (id 0), those it sees, and those it waits for."""
    return [
        HeadNow(
            track.id,
            track.state != State.COASTING,
            track.centre,
            track.quaternion,
            track.radius,
            track.score,
            covariance[:3, :3],
            turn_covariance,
            np.asarray(track.velocity, dtype=np.float64),
            covariance[3:, 3:],
        )
        for track, covariance, turn_covariance in zip(
            tracks, tracks.covariances, tracks.rotation_covariances, strict=True
        )
    ]


def header_of(stamp_ns: int, frame: str) -> Content:
    """Return a std_msgs/Header."""
    return {"stamp": time_of(stamp_ns), "frame_id": frame}


def time_of(stamp_ns: int) -> Content:
    """Return a builtin_interfaces/Time, or a Duration."""
    sec, nanosec = divmod(stamp_ns, NS)
    return {"sec": sec, "nanosec": nanosec}


def pose_of(head: HeadNow) -> Content:
    """Return centre and orientation; an unknown orientation is that of the frame (a message must hold one)."""
    return {"position": xyz_of(head.centre), "orientation": _orientation(head)}


def _orientation(head: HeadNow) -> Content:
    x, y, z, w = head.quaternion.tolist() if head.is_turned else (0.0, 0.0, 0.0, 1.0)
    return {"x": x, "y": y, "z": z, "w": w}


def pose_covariance(head: HeadNow) -> list[float]:
    """Return the 6x6 of geometry_msgs/PoseWithCovariance: x, y, z and turns about the fixed axes of the frame.

    An unknown position block is 0, ROS's "not known"; an unknown orientation has a variance of pi^2 rad^2.
    """
    covariance = np.zeros((6, 6))
    if np.isfinite(head.centre_covariance).all():
        covariance[:3, :3] = head.centre_covariance
    if not head.is_turned:
        covariance[3:, 3:] = UNKNOWN_TURN_RAD2 * np.eye(3)
    elif np.isfinite(head.rotation_covariance).all():
        R = Rotation.from_quat(head.quaternion).as_matrix()  # the library's is about the head's own axes
        covariance[3:, 3:] = R @ head.rotation_covariance @ R.T
    return [float(v) for v in covariance.ravel()]


def box_size(radius: float) -> Content:
    """Return the box of a head, along its own axes, whose fitted sphere has ``radius``."""
    length = 2.0 * radius
    return {"x": length, "y": WIDTH_TO_LENGTH * length, "z": HEIGHT_TO_LENGTH * length}


def poses(header: Content, heads: Sequence[HeadNow]) -> Content:
    """Return a geometry_msgs/PoseArray, in the order of the detections."""
    return {"header": header, "poses": [pose_of(head) for head in heads]}


def detections(header: Content, heads: Sequence[HeadNow]) -> Content:
    """Return a vision_msgs/Detection3DArray: class "head", the cascade's score, the track's number as id."""
    found = []
    for head in heads:
        pose = {"pose": pose_of(head), "covariance": pose_covariance(head)}
        hypothesis = {"hypothesis": {"class_id": "head", "score": head.score}, "pose": pose}
        box = {"center": pose_of(head), "size": box_size(head.radius)}
        name = str(head.id) if head.id else ""
        found.append({"header": header, "results": [hypothesis], "bbox": box, "id": name})
    return {"header": header, "detections": found}


def tracks(header: Content, heads: Sequence[HeadNow]) -> list[Content]:
    """Return a nav_msgs/Odometry for each head that has an id: its twist is in its own axes, as child_frame_id says."""
    messages = []
    for head in heads:
        if not head.id:
            continue
        R = Rotation.from_quat(head.quaternion).as_matrix() if head.is_turned else np.eye(3)
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = R.T @ head.velocity_covariance @ R
        twist = {"linear": xyz_of(R.T @ head.velocity)}
        messages.append(
            {
                "header": header,
                "child_frame_id": frame_of(head),
                "pose": {"pose": pose_of(head), "covariance": pose_covariance(head)},
                "twist": {"twist": twist, "covariance": [float(v) for v in covariance.ravel()]},
            }
        )
    return messages


def frames(header: Content, heads: Sequence[HeadNow]) -> Content:
    """Return a tf2_msgs/TFMessage: the transform of each head that has an id and a known orientation."""
    made = [
        {
            "header": header,
            "child_frame_id": frame_of(head),
            "transform": {"translation": xyz_of(head.centre), "rotation": _orientation(head)},
        }
        for head in heads
        if head.id and head.is_turned
    ]
    return {"transforms": made}


def frame_of(head: HeadNow) -> str:
    """Return the name of a head's frame."""
    return f"head_{head.id}"


class MarkerBoard:
    """The markers of the last frame, so that those of heads that are gone are deleted."""

    def __init__(self, lifetime_s: float) -> None:
        self._lifetime = time_of(round(lifetime_s * NS))
        self._shown: set[tuple[str, int]] = set()

    def show(self, header: Content, heads: Sequence[HeadNow]) -> Content:
        """Return a visualization_msgs/MarkerArray: ``heads``, and the deletion of those shown before and not now."""
        markers: list[Content] = []
        for n, head in enumerate(heads):
            markers += self._markers(header, head, head.id or -1 - n)
        now = {(marker["ns"], marker["id"]) for marker in markers}
        for ns, number in sorted(self._shown - now):
            markers.append({"header": header, "ns": ns, "id": number, "action": DELETE})
        self._shown = now
        return {"markers": markers}

    def _markers(self, header: Content, head: HeadNow, number: int) -> list[Content]:
        colour = COLOURS[number % len(COLOURS)] if head.id else GREY
        common = {"header": header, "id": number, "action": ADD, "lifetime": self._lifetime}
        shape = {
            **common,
            "ns": "head",
            # a cube would look turned where the orientation is not known
            "type": CUBE if head.is_turned else SPHERE,
            "scale": box_size(head.radius) if head.is_turned else xyz_of(np.full(3, 2.0 * head.radius)),
            "pose": pose_of(head),
            "color": _rgba(colour, 0.5 if head.is_seen else 0.2),
        }
        label = {
            **common,
            "ns": "label",
            "type": TEXT,
            "pose": {
                "position": xyz_of(head.centre + np.array([0.0, 0.0, 2.0 * head.radius])),
                "orientation": {"w": 1.0},
            },
            "scale": {"z": 0.12},
            "color": _rgba((1.0, 1.0, 1.0), 1.0),
            "text": str(head.id) if head.id else f"{head.score:.1f}",
        }
        if not head.is_turned:
            return [shape, label]
        axis = {
            **common,
            "ns": "axis",
            "type": ARROW,
            "pose": pose_of(head),
            "scale": {"x": 0.02, "y": 0.04, "z": 0.05},
            "color": _rgba(colour, 0.9),
            "points": [xyz_of(np.zeros(3)), xyz_of(np.array([3.0 * head.radius, 0.0, 0.0]))],
        }
        return [shape, label, axis]


def _rgba(colour: Iterable[float], opacity: float) -> Content:
    r, g, b = colour
    return {"r": r, "g": g, "b": b, "a": opacity}


def xyz_of(xyz: F64) -> Content:
    """Return a geometry_msgs/Point or Vector3."""
    x, y, z = xyz.tolist()
    return {"x": x, "y": y, "z": z}
