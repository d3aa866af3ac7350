"""What flows through headvox: frames in, heads out.

Units are metres and nanoseconds. The world frame is right-handed with z up; camera frames are optical (x right,
y down, z forward); a head frame is x out of the face, y to the person's left, z up through the crown.
``T_a_b`` is a 4x4 matrix that maps coordinates in b to coordinates in a.

What holds arrays is equal to itself only, and may be in a set: compare the arrays.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from headvox.errors import HeadvoxError

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I16 = npt.NDArray[np.int16]
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
U16 = npt.NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A pinhole depth camera without distortion.

    ``width height fx fy cx cy`` are in pixels, pixel centres at whole numbers; metres along the optical axis = value *
    ``depth_scale``, 0 = no return.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    depth_scale: float = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class DepthImage:
    """One depth image.

    ``name`` is what errors call the camera. ``depth`` is (height, width) uint16, C-contiguous, in units of the camera's
    ``depth_scale``; ``T_world_camera`` (4, 4) float64, rigid, places the camera's optical frame in the world.
    """

    name: str
    depth: U16
    intrinsics: Intrinsics
    T_world_camera: F64


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """One point cloud.

    ``name`` is what errors call the sensor. ``points`` is (N, 3) float32 in metres, C-contiguous, invalid points NaN.
    ``T_world_sensor`` is (4, 4) float64, rigid, and places the sensor's frame in the world; ``None`` says that the
    points are world coordinates already and that nobody knows where the sensor stood. With it, a cloud that a pinhole
    camera's driver made of a depth image is looked at as that image: see :mod:`headvox.organise`.
    """

    name: str
    points: F32
    T_world_sensor: F64 | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """What all sensors saw at one moment: ``clouds`` and ``depths``, either of which may be empty, but not both.

    ``stamp_ns`` is the moment in whole nanoseconds of any clock that goes on evenly, less than 2**62 (146 years).
    """

    stamp_ns: int
    clouds: tuple[Cloud, ...] = ()
    depths: tuple[DepthImage, ...] = ()


@dataclass(frozen=True, slots=True)
class BadFrame:
    """A frame that a source could not read, and the ``reason``; the run reports and counts it, and goes on."""

    stamp_ns: int
    reason: str


def _empty(*shape: int) -> F64:
    return np.empty(shape, dtype=np.float64)


def unknown(*shape: int) -> F64:
    """Return NaN for each number."""
    numbers = np.empty(shape)  # np.full takes longer than all else that a head is stated with
    numbers.fill(np.nan)
    return numbers


_ROWS: dict[str, tuple[int, ...]] = {
    "centres": (3,), "quaternions": (4,), "radii": (), "scores": (),
    "centre_covariances": (3, 3), "rotation_covariances": (3, 3), "sure": (),
}  # fmt: skip
"""What a head has in each array of :class:`Heads`."""


@dataclass(frozen=True, slots=True, eq=False)
class Heads:
    """The heads found in one frame, as a structure of arrays, best score first.

    ``centres``     (N, 3) float64, metres, world frame
    ``quaternions`` (N, 4) float64, x y z w, world from head; a row of NaN where the orientation is not known
    ``radii``       (N,)   float64, metres, of the sphere that fits the skull
    ``scores``      (N,)   float64, the cascade's score; higher is surer
    ``centre_covariances``   (N, 3, 3) float64, m², world axes; NaN where not known
    ``rotation_covariances`` (N, 3, 3) float64, rad², of the small turn d in R_true = R_stated exp(d), head axes; NaN
                             where the orientation is not known
    ``sure``        (N,) bool; False where the score is below the threshold, and the head was kept only because a
                             tracker expected one there
    """

    centres: F64 = field(default_factory=lambda: _empty(0, 3))
    quaternions: F64 = field(default_factory=lambda: _empty(0, 4))
    radii: F64 = field(default_factory=lambda: _empty(0))
    scores: F64 = field(default_factory=lambda: _empty(0))
    centre_covariances: F64 = field(default_factory=lambda: _empty(0))
    rotation_covariances: F64 = field(default_factory=lambda: _empty(0))
    sure: npt.NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, np.bool_))

    def __post_init__(self) -> None:
        n = len(self.scores)
        if len(self.sure) == 0:
            object.__setattr__(self, "sure", np.ones(n, np.bool_))
        for name in ("centre_covariances", "rotation_covariances"):
            if len(getattr(self, name)) == 0:
                object.__setattr__(self, name, unknown(n, 3, 3))
        for name, row in _ROWS.items():
            if getattr(getattr(self, name), "shape", None) != (n, *row):
                raise _other_shape(name, (n, *row), getattr(self, name))

    def __len__(self) -> int:
        return len(self.scores)

    def __getitem__(self, n: int) -> Head:
        return Head(self.centres[n], self.quaternions[n], float(self.radii[n]), float(self.scores[n]))

    def __iter__(self) -> Iterator[Head]:
        return (self[n] for n in range(len(self)))

    def __repr__(self) -> str:
        """Say where each head is and what it scores: all the arrays would fill a screen."""
        told = [
            f"({x:.2f}, {y:.2f}, {z:.2f}) m scores {s:.1f}"
            for (x, y, z), s in zip(self.centres, self.scores, strict=True)
        ]
        return f"Heads({len(self)}: {'; '.join(told)})" if told else "Heads(0)"


def _other_shape(name: str, shape: tuple[int, ...], got: object) -> HeadvoxError:
    told = getattr(got, "shape", type(got).__name__)
    what = f"Heads: {name}: expected an array of shape {shape}, a row for each of the scores, got {told}."
    return HeadvoxError(what, "Give a row for each head, or leave out what is not known.")


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """Where heads are expected in the next frame, as a tracker predicts them: structure of arrays.

    ``centres``     (M, 3) float64, metres, world frame
    ``quaternions`` (M, 4) float64, x y z w, world from head; a row of NaN where the orientation is not known
    ``reaches_m``   (M,)   float64, metres: how far from ``centres`` the head may be
    """

    centres: F64
    quaternions: F64
    reaches_m: F64

    def __len__(self) -> int:
        return len(self.centres)


@dataclass(frozen=True, slots=True, eq=False)
class Head:
    """One row of :class:`Heads`: ``centre`` (3,) and ``radius`` in metres, ``quaternion`` (4,) x y z w."""

    centre: F64
    quaternion: F64
    radius: float
    score: float


class State(IntEnum):
    """How sure a track is of its head."""

    TENTATIVE = 0
    """Seen in this frame, but not often enough to be given an id."""
    CONFIRMED = 1
    """Seen in this frame."""
    COASTING = 2
    """Confirmed, not seen in this frame: where it should be by now."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """The heads that are followed, at one moment: structure of arrays, those with an id first, in its order.

    ``stamp_ns``    the moment
    ``ids``         (N,) int64, from 1; 0 while tentative
    ``states``      (N,) int64, a :class:`State` each
    ``centres``     (N, 3) float64, metres, world frame
    ``velocities``  (N, 3) float64, m/s, world frame
    ``quaternions`` (N, 4) float64, x y z w, world from head; a row of NaN where the orientation is not known
    ``rates``       (N, 3) float64, rad/s, turn rate in head axes; a row of NaN where the orientation is not known
    ``radii``       (N,) float64, metres, of the last detection
    ``scores``      (N,) float64, of the last detection
    ``covariances`` (N, 6, 6) float64, of centre and velocity (m, m/s), world axes
    ``rotation_covariances`` (N, 3, 3) float64, rad², as those of :class:`Heads`
    ``ages_s``      (N,) float64, seconds since the head was first seen
    ``unseen_s``    (N,) float64, seconds since it was last seen; 0 if in this frame
    """

    stamp_ns: int
    ids: I64
    states: I64
    centres: F64
    velocities: F64
    quaternions: F64
    rates: F64
    radii: F64
    scores: F64
    covariances: F64
    rotation_covariances: F64
    ages_s: F64
    unseen_s: F64

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, n: int) -> Track:
        state = State(self.states[n])
        return Track(
            int(self.ids[n]),
            state,
            self.centres[n],
            self.velocities[n] if state != State.TENTATIVE else (math.nan,) * 3,
            self.quaternions[n],
            float(self.radii[n]),
            float(self.scores[n]),
            sigmas(self.covariances[n, :3, :3]),
            sigmas(self.rotation_covariances[n]),
        )

    def __iter__(self) -> Iterator[Track]:
        return (self[n] for n in range(len(self)))


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A head as it is written: a row of :class:`Tracks`, or a bare head, without id (0), state and velocity (NaN).

    ``centre_sigma`` (3,) are the standard deviations of the centre, metres, world axes; ``rotation_sigma`` (3,) those
    of the turns about the head's axes (roll, pitch, yaw), radians. NaN where not known.
    """

    id: int
    state: State | None
    centre: F64
    velocity: Sequence[float] | F64
    quaternion: F64
    radius: float
    score: float
    centre_sigma: F64
    rotation_sigma: F64


def sigmas(covariance: F64) -> F64:
    """Return the standard deviations (N,) of a covariance (N, N)."""
    deviations: F64 = np.sqrt(np.diagonal(covariance))
    return deviations
