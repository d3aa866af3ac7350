"""What the readers of point-cloud files return."""

from __future__ import annotations

from dataclasses import dataclass

from headvox.data import F32, F64


@dataclass(frozen=True, slots=True)
class CloudFile:
    """What a point-cloud file holds.

    ``format`` is for people, such as "ply, ascii"; ``points`` (N, 3) float32 in metres, C-contiguous, invalid
    points NaN; ``T_world_sensor`` as in :class:`~headvox.data.Cloud`; ``vertices`` the number of points that
    the file itself has and ``faces`` that of the polygons that were sampled; ``extra`` the fields beside x,
    y, z.
    """

    format: str
    points: F32
    T_world_sensor: F64 | None = None
    vertices: int = 0
    faces: int = 0
    extra: tuple[str, ...] = ()
