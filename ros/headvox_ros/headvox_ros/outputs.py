"""Heads -> ROS messages. Frames are REP 103's: a head's x is out of its face, y to its left, z up through its crown."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point, Pose, PoseArray, Quaternion, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from scipy.spatial.transform import Rotation
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from headvox.data import F64, Heads, State, Tracks

vision: Any = None
with contextlib.suppress(ImportError):  # a ROS without vision_msgs: the topic is left out
    vision = importlib.import_module("vision_msgs.msg")

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


def pose_of(head: HeadNow) -> Pose:
    """Return centre and orientation; an unknown orientation is that of the frame (a message must hold one)."""
    x, y, z, w = head.quaternion.tolist() if head.is_turned else (0.0, 0.0, 0.0, 1.0)
    return Pose(position=_point(head.centre), orientation=Quaternion(x=x, y=y, z=z, w=w))


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


def box_size(radius: float) -> Vector3:
    """Return the box of a head, along its own axes, whose fitted sphere has ``radius``."""
    length = 2.0 * radius
    return Vector3(x=length, y=WIDTH_TO_LENGTH * length, z=HEIGHT_TO_LENGTH * length)


def poses(header: Header, heads: Sequence[HeadNow]) -> PoseArray:
    """Return the poses, in the order of the detections."""
    return PoseArray(header=header, poses=[pose_of(head) for head in heads])


def detections(header: Header, heads: Sequence[HeadNow]) -> Any:
    """Return a vision_msgs/Detection3DArray: class "head", the cascade's score, the track's number as id."""
    found = []
    for head in heads:
        hypothesis = vision.ObjectHypothesisWithPose()
        hypothesis.hypothesis.class_id = "head"
        hypothesis.hypothesis.score = head.score
        hypothesis.pose.pose = pose_of(head)
        hypothesis.pose.covariance = pose_covariance(head)
        box = vision.BoundingBox3D(center=pose_of(head), size=box_size(head.radius))
        name = str(head.id) if head.id else ""
        found.append(vision.Detection3D(header=header, results=[hypothesis], bbox=box, id=name))
    return vision.Detection3DArray(header=header, detections=found)


def tracks(header: Header, heads: Sequence[HeadNow]) -> list[Odometry]:
    """Return an Odometry for each head that has an id: its twist is in its own axes, as child_frame_id says."""
    messages = []
    for head in heads:
        if not head.id:
            continue
        message = Odometry(header=header, child_frame_id=frame_of(head))
        message.pose.pose = pose_of(head)
        message.pose.covariance = pose_covariance(head)
        R = Rotation.from_quat(head.quaternion).as_matrix() if head.is_turned else np.eye(3)
        message.twist.twist.linear = _vector(R.T @ head.velocity)
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = R.T @ head.velocity_covariance @ R
        message.twist.covariance = [float(v) for v in covariance.ravel()]
        messages.append(message)
    return messages


def frames(header: Header, heads: Sequence[HeadNow]) -> list[TransformStamped]:
    """Return the transform of each head that has an id and a known orientation."""
    made = []
    for head in heads:
        if head.id and head.is_turned:
            transform = TransformStamped(header=header, child_frame_id=frame_of(head))
            transform.transform.translation = _vector(head.centre)
            transform.transform.rotation = pose_of(head).orientation
            made.append(transform)
    return made


def frame_of(head: HeadNow) -> str:
    """Return the name of a head's frame."""
    return f"head_{head.id}"


class MarkerBoard:
    """The markers of the last frame, so that those of heads that are gone are deleted."""

    def __init__(self, lifetime_s: float) -> None:
        self._lifetime = Duration(sec=int(lifetime_s), nanosec=int(lifetime_s % 1.0 * 1e9))
        self._shown: set[tuple[str, int]] = set()

    def show(self, header: Header, heads: Sequence[HeadNow]) -> MarkerArray:
        """Return the markers of ``heads``, and the deletion of those shown before and not now."""
        markers: list[Marker] = []
        for n, head in enumerate(heads):
            markers += self._markers(header, head, head.id or -1 - n)
        now = {(marker.ns, marker.id) for marker in markers}
        for ns, number in sorted(self._shown - now):
            markers.append(Marker(header=header, ns=ns, id=number, action=Marker.DELETE))
        self._shown = now
        return MarkerArray(markers=markers)

    def _markers(self, header: Header, head: HeadNow, number: int) -> list[Marker]:
        colour = COLOURS[number % len(COLOURS)] if head.id else GREY
        common = {"header": header, "id": number, "action": Marker.ADD, "lifetime": self._lifetime}
        shape = Marker(
            **common, ns="head", pose=pose_of(head), color=_rgba(colour, 0.5 if head.is_seen else 0.2)
        )
        if head.is_turned:
            shape.type, shape.scale = Marker.CUBE, box_size(head.radius)
        else:  # a cube would look turned
            shape.type, shape.scale = Marker.SPHERE, _vector(np.full(3, 2.0 * head.radius))
        label = Marker(**common, ns="label", type=Marker.TEXT_VIEW_FACING, color=_rgba((1.0, 1.0, 1.0), 1.0))
        label.pose.position = _point(head.centre + np.array([0.0, 0.0, 2.0 * head.radius]))
        label.scale.z = 0.12
        label.text = str(head.id) if head.id else f"{head.score:.1f}"
        made = [shape, label]
        if head.is_turned:
            axis = Marker(
                **common, ns="axis", type=Marker.ARROW, pose=pose_of(head), color=_rgba(colour, 0.9)
            )
            axis.points = [Point(), Point(x=3.0 * head.radius)]
            axis.scale = Vector3(x=0.02, y=0.04, z=0.05)
            made.append(axis)
        return made


def _rgba(colour: Sequence[float], opacity: float) -> ColorRGBA:
    return ColorRGBA(r=colour[0], g=colour[1], b=colour[2], a=opacity)


def _point(xyz: F64) -> Point:
    return Point(x=float(xyz[0]), y=float(xyz[1]), z=float(xyz[2]))


def _vector(xyz: F64) -> Vector3:
    return Vector3(x=float(xyz[0]), y=float(xyz[1]), z=float(xyz[2]))
