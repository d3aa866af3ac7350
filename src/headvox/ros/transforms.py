"""Where frames are, from what /tf and /tf_static say: a tree of rigid transforms over the last seconds.

It answers what tf2's buffer answers (``lookup_transform`` at a time), and, like it, never guesses: what is not known
at that very time is an error. It is our own because tf2_ros is not to be had wherever rclpy is, and because one buffer
that every test runs through is worth more than two of which one is tried.
"""

from __future__ import annotations

import threading
import time
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from headvox.data import F64
from headvox.errors import HeadvoxError
from headvox.frames import inverse, placed
from headvox.ros.synchronise import NS

UNIT_TOLERANCE = 0.01  # how far a quaternion's length may be from 1: as tf2
STOPPED_NS = NS  # a transform that is older than this is not late, it has stopped
LOOK_UP_EVERY_S = 0.05  # while waiting, for whoever wants us to stop
LONGEST_CHAIN = 100  # frames from one to the root: more is a loop


class NoTransform(HeadvoxError):
    """A transform that is not known; ``hopeless`` when it is not worth waiting for."""

    def __init__(self, what: str, do: str, hopeless: bool) -> None:
        super().__init__(what, do)
        self.hopeless = hopeless


@dataclass(slots=True)
class _Edge:
    """What is known of a frame in its parent, in the order of time; one place for ever when it is static."""

    parent: str
    is_static: bool
    stamps: list[int] = field(default_factory=list)
    places: list[tuple[F64, F64]] = field(default_factory=list)
    """Translation (3,) in metres and quaternion (4,) x y z w."""

    def insert(self, stamp_ns: int, translation: F64, quaternion: F64) -> None:
        at = bisect_left(self.stamps, stamp_ns)
        repeated = at < len(self.stamps) and self.stamps[at] == stamp_ns
        self.stamps[at : at + repeated] = [stamp_ns]
        self.places[at : at + repeated] = [(translation, quaternion)]

    def drop_before(self, stamp_ns: int) -> None:
        if self.stamps[len(self.stamps) // 2] < stamp_ns:  # seldom, and much at once
            old = bisect_left(self.stamps, stamp_ns)
            del self.stamps[:old], self.places[:old]


class TransformBuffer:
    """Transforms of the last ``keep_s`` seconds; any thread may ask while another one fills it in."""

    def __init__(self, keep_s: float = 10.0) -> None:
        self.refused = 0
        """Transforms that were no rigid transform between two frames."""
        self._keep_ns = round(keep_s * NS)
        self._edges: dict[str, _Edge] = {}
        self._changed = threading.Condition()

    def set(
        self,
        parent: str,
        child: str,
        stamp_ns: int,
        translation: F64,
        quaternion: F64,
        is_static: bool = False,
    ) -> None:
        """Note where ``child`` is in ``parent``: ``translation`` (3,) metres, ``quaternion`` (4,) x y z w."""
        parent, child = _name(parent), _name(child)
        length = float(np.linalg.norm(quaternion))
        good = np.isfinite(translation).all() and abs(length - 1.0) < UNIT_TOLERANCE
        with self._changed:
            if not good or not parent or not child or parent == child:
                self.refused += 1
                return
            edge = self._edges.get(child)
            if edge is None or edge.parent != parent or edge.is_static != is_static or is_static:
                edge = self._edges[child] = _Edge(parent, is_static)
            edge.insert(stamp_ns, translation, quaternion / length)
            edge.drop_before(edge.stamps[-1] - self._keep_ns)
            self._changed.notify_all()

    def forget_moving(self) -> None:
        """Forget what is not static: time began again."""
        with self._changed:
            self._edges = {child: edge for child, edge in self._edges.items() if edge.is_static}

    def lookup(self, target: str, source: str, stamp_ns: int) -> F64:
        """Return T_target_source (4, 4) at a time.

        Raises:
            NoTransform: a frame is not known, the two are not connected, or it is not known at that time.
        """
        with self._changed:
            return self._lookup(_name(target), _name(source), stamp_ns)

    def wait_for(
        self,
        target: str,
        source: str,
        stamp_ns: int,
        timeout_s: float,
        stop: Callable[[], bool] = lambda: False,
    ) -> F64:
        """Return T_target_source as soon as it is known, but wait no longer than ``timeout_s`` for it.

        Raises:
            NoTransform: as :meth:`lookup`, after the wait; at once when no wait can help, or when ``stop`` says so.
        """
        deadline = time.monotonic() + timeout_s
        with self._changed:
            found = self._lookup_or_why(target, source, stamp_ns)
            while isinstance(found, NoTransform):
                left = deadline - time.monotonic()
                if found.hopeless or left <= 0.0 or stop():
                    raise found
                self._changed.wait(min(left, LOOK_UP_EVERY_S))
                found = self._lookup_or_why(target, source, stamp_ns)
            return found

    def _lookup_or_why(self, target: str, source: str, stamp_ns: int) -> F64 | NoTransform:
        try:
            return self._lookup(_name(target), _name(source), stamp_ns)
        except NoTransform as error:
            return error

    def _lookup(self, target: str, source: str, stamp_ns: int) -> F64:
        if target == source:
            return np.eye(4)
        above_source, above_target = self._chain(source), self._chain(target)
        common = next((frame for frame in above_source if frame in above_target), None)
        if common is None:
            missing = [frame for frame in (target, source) if not self._is_known(frame)]
            if missing:
                what = f"Frame {missing[0]!r} is not in the transform tree."
                raise NoTransform(what, "Does anybody publish it?", hopeless=True)
            what = f"Frames {target!r} and {source!r} are not connected."
            raise NoTransform(what, "A transform between them is missing.", hopeless=True)
        T_common_source = self._along(above_source[: above_source.index(common)], stamp_ns)
        T_common_target = self._along(above_target[: above_target.index(common)], stamp_ns)
        return inverse(T_common_target) @ T_common_source

    def above(self, frame: str) -> list[str]:
        """Return ``frame`` and the frames above it, up to the root.

        Raises:
            NoTransform: the transforms go round in a loop.
        """
        with self._changed:
            return self._chain(_name(frame))

    def _is_known(self, frame: str) -> bool:
        return frame in self._edges or any(edge.parent == frame for edge in self._edges.values())

    def _chain(self, frame: str) -> list[str]:
        """Return ``frame`` and the frames above it, up to the root."""
        chain = [frame]
        while chain[-1] in self._edges:
            chain.append(self._edges[chain[-1]].parent)
            if len(chain) > LONGEST_CHAIN:
                what = f"The transforms above frame {frame!r} go round in a loop."
                raise NoTransform(what, "Two nodes disagree.", hopeless=True)
        return chain

    def _along(self, frames: list[str], stamp_ns: int) -> F64:
        """Return the transform that ``frames``, each the child of the next, add up to."""
        T = np.eye(4)
        for frame in frames:
            T = _at(frame, self._edges[frame], stamp_ns) @ T
        return T


def set_from(buffer: TransformBuffer, message: Any, is_static: bool) -> None:
    """Note what a tf2_msgs/TFMessage says."""
    for stamped in message.transforms:
        t, q = stamped.transform.translation, stamped.transform.rotation
        stamp = stamped.header.stamp
        buffer.set(
            stamped.header.frame_id,
            stamped.child_frame_id,
            stamp.sec * NS + stamp.nanosec,
            np.array([t.x, t.y, t.z]),
            np.array([q.x, q.y, q.z, q.w]),
            is_static,
        )


def _name(frame: str) -> str:
    return frame.lstrip("/")  # as tf2: names of ROS 1 began with a slash


def _at(child: str, edge: _Edge, stamp_ns: int) -> F64:
    """Return T_parent_child at a time: linear between two translations, along the arc between two rotations."""
    if edge.is_static:
        return placed(*edge.places[0])
    first, last = edge.stamps[0], edge.stamps[-1]
    if stamp_ns > last:
        what = (
            f"The newest transform of {child!r} is {1e-6 * (stamp_ns - last):.0f} ms older than the reading."
        )
        raise NoTransform(what, "Is it late, or did it stop?", hopeless=stamp_ns - last > STOPPED_NS)
    if stamp_ns < first:
        what = (
            f"The oldest transform of {child!r} is {1e-6 * (first - stamp_ns):.0f} ms newer than the reading."
        )
        raise NoTransform(what, "Has it just begun?", hopeless=True)
    at = bisect_left(edge.stamps, stamp_ns)
    if edge.stamps[at] == stamp_ns:
        return placed(*edge.places[at])
    share = (stamp_ns - edge.stamps[at - 1]) / (edge.stamps[at] - edge.stamps[at - 1])
    (from_translation, from_quaternion), (to_translation, to_quaternion) = edge.places[at - 1 : at + 1]
    translation = (1.0 - share) * from_translation + share * to_translation
    return placed(translation, _slerp(from_quaternion, to_quaternion, share))


def _slerp(a: F64, b: F64, share: float) -> F64:
    dot = float(a @ b)
    if dot < 0.0:  # q and -q are the same turn: take the short way
        a, dot = -a, -dot
    angle = np.arccos(min(dot, 1.0))
    if angle < 1e-6:
        return (1.0 - share) * a + share * b
    mixed: F64 = (np.sin((1.0 - share) * angle) * a + np.sin(share * angle) * b) / np.sin(angle)
    return mixed
