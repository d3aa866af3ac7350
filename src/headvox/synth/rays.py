"""First hits of camera and LiDAR rays on a triangle scene.

One loop over the triangles, each tested against the rays inside its bounds: the edge test of homogeneous
rasterisation (Olano and Greer 1997) gives what a ray caster gives, needs no clipping and no tree, leaves no
cracks between neighbours, and its answer is the same on every machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from headvox.data import F32, F64, I32, Intrinsics
from headvox.frames import inverse, transform
from headvox.machine.kernels import kernel

NEAR_M = 0.02
NOTHING = -1
ROOM_ID = 0  # walls and furniture; people have larger ids


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles in the world frame.

    ``vertices`` (V, 3) float64 metres; ``faces`` (F, 3) int32; ``albedo`` (F,) float32, the share of infrared
    light a face sends back, 0..1; ``ids`` (F,) int32, whose face it is; ``gloss`` (F,) float32, the share of what it
    sends back that it mirrors instead of scattering, 0..1, by default nothing.
    """

    vertices: F64
    faces: I32
    albedo: F32
    ids: I32
    gloss: F32 | None = None

    def glosses(self) -> F32:
        """Return the gloss of every face."""
        return np.zeros(len(self.faces), np.float32) if self.gloss is None else self.gloss


@dataclass(frozen=True, slots=True)
class View:
    """What the rays of one sensor hit first; all arrays (height, width).

    ``distance_m`` float32, along the optical axis for a camera and along the ray for a LiDAR, infinite where
    there is nothing; ``ids`` int32, ``NOTHING`` where there is nothing; ``albedo`` float32; ``cosine``
    float32, of the angle between the ray and the surface's normal; ``gloss`` float32.
    """

    distance_m: F32
    ids: I32
    albedo: F32
    cosine: F32
    gloss: F32


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Put meshes together, in order."""
    if not meshes:
        return Mesh(
            np.empty((0, 3)), np.empty((0, 3), np.int32), np.empty(0, np.float32), np.empty(0, np.int32)
        )
    first = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + np.int32(k) for mesh, k in zip(meshes, first, strict=True)]),
        np.concatenate([mesh.albedo for mesh in meshes]),
        np.concatenate([mesh.ids for mesh in meshes]),
        np.concatenate([mesh.glosses() for mesh in meshes]),
    )


def look(mesh: Mesh, intrinsics: Intrinsics, T_world_camera: F64) -> View:
    """Cast one ray through the middle of every pixel of a pinhole camera."""
    x: F64 = (np.arange(intrinsics.width, dtype=np.float64) - intrinsics.cx) / intrinsics.fx
    y: F64 = (np.arange(intrinsics.height, dtype=np.float64) - intrinsics.cy) / intrinsics.fy
    vertices = transform(inverse(T_world_camera), mesh.vertices)
    view = _blank(intrinsics.height, intrinsics.width)
    hit = np.full(view.ids.shape, NOTHING, np.int32)
    _cast_pinhole(vertices, mesh.faces, x, y, intrinsics.fx, intrinsics.fy, view.distance_m, hit)
    rays = np.empty((*hit.shape, 3))
    rays[..., 0], rays[..., 1], rays[..., 2] = x, y[:, None], 1.0
    _shade(vertices, mesh.faces, mesh.albedo, mesh.glosses(), mesh.ids, rays, hit, view)
    return view


def spin(mesh: Mesh, elevations_rad: F64, columns: int, T_world_sensor: F64) -> tuple[View, F64]:
    """Cast the rays of a spinning LiDAR (x forward, z up in its own frame).

    ``elevations_rad`` (rings,) ascending; azimuths are ``columns`` equal steps from -pi.
    Returns the view (rings, columns) and the unit rays (rings, columns, 3) in the sensor's frame.
    """
    azimuth = -np.pi + 2.0 * np.pi * np.arange(columns) / columns
    flat = np.cos(elevations_rad)[:, None]
    rays = np.stack(
        [
            flat * np.cos(azimuth),
            flat * np.sin(azimuth),
            np.repeat(np.sin(elevations_rad)[:, None], columns, 1),
        ],
        -1,
    )
    vertices = transform(inverse(T_world_sensor), mesh.vertices)
    view = _blank(len(elevations_rad), columns)
    hit = np.full(view.ids.shape, NOTHING, np.int32)
    _cast_spinning(vertices, mesh.faces, rays, elevations_rad, view.distance_m, hit)
    _shade(vertices, mesh.faces, mesh.albedo, mesh.glosses(), mesh.ids, rays, hit, view)
    return view, rays


def _blank(height: int, width: int) -> View:
    shape = (height, width)
    return View(
        np.full(shape, np.inf, np.float32),
        np.full(shape, NOTHING, np.int32),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
    )


@kernel
def _cast_pinhole(
    vertices: F64, faces: I32, x: F64, y: F64, fx: float, fy: float, distance: F32, hit: I32
) -> None:
    height, width = distance.shape
    left, right, top, bottom = x[0], x[-1], y[0], y[-1]
    for f in range(len(faces)):
        ax, ay, az = vertices[faces[f, 0]]
        bx, by, bz = vertices[faces[f, 1]]
        cx, cy, cz = vertices[faces[f, 2]]
        if az <= NEAR_M and bz <= NEAR_M and cz <= NEAR_M:
            continue
        # The four sides of the view pass through the camera, so this holds for vertices behind it too.
        if ax < left * az and bx < left * bz and cx < left * cz:
            continue
        if ax > right * az and bx > right * bz and cx > right * cz:
            continue
        if ay < top * az and by < top * bz and cy < top * cz:
            continue
        if ay > bottom * az and by > bottom * bz and cy > bottom * cz:
            continue
        u0, u1, v0, v1 = 0, width - 1, 0, height - 1
        if az > NEAR_M and bz > NEAR_M and cz > NEAR_M:
            au, bu, cu = ax / az, bx / bz, cx / cz
            av, bv, cv = ay / az, by / bz, cy / cz
            u0 = max(u0, int(np.floor((min(au, bu, cu) - left) * fx)))
            u1 = min(u1, int(np.ceil((max(au, bu, cu) - left) * fx)))
            v0 = max(v0, int(np.floor((min(av, bv, cv) - top) * fy)))
            v1 = min(v1, int(np.ceil((max(av, bv, cv) - top) * fy)))
        # Normals of the planes through the camera and each edge: shared edges get exactly opposite ones.
        n0x, n0y, n0z = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        n1x, n1y, n1z = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
        n2x, n2y, n2z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        volume = ax * n0x + ay * n0y + az * n0z
        for v in range(v0, v1 + 1):
            r0 = n0y * y[v] + n0z
            r1 = n1y * y[v] + n1z
            r2 = n2y * y[v] + n2z
            for u in range(u0, u1 + 1):
                e0 = n0x * x[u] + r0
                e1 = n1x * x[u] + r1
                e2 = n2x * x[u] + r2
                if (e0 >= 0.0 and e1 >= 0.0 and e2 >= 0.0) or (e0 <= 0.0 and e1 <= 0.0 and e2 <= 0.0):
                    total = e0 + e1 + e2
                    if total != 0.0:
                        z = volume / total
                        if NEAR_M < z < distance[v, u]:
                            distance[v, u] = z
                            hit[v, u] = f


@kernel
def _cast_spinning(vertices: F64, faces: I32, rays: F64, elevations: F64, distance: F32, hit: I32) -> None:
    rings, columns = distance.shape
    step = 2.0 * np.pi / columns
    for f in range(len(faces)):
        ax, ay, az = vertices[faces[f, 0]]
        bx, by, bz = vertices[faces[f, 1]]
        cx, cy, cz = vertices[faces[f, 2]]
        a_azimuth, b_azimuth, c_azimuth = np.arctan2(ay, ax), np.arctan2(by, bx), np.arctan2(cy, cx)
        a_lift = np.arctan2(az, np.hypot(ax, ay))
        b_lift = np.arctan2(bz, np.hypot(bx, by))
        c_lift = np.arctan2(cz, np.hypot(cx, cy))
        low, high = min(a_lift, b_lift, c_lift), max(a_lift, b_lift, c_lift)
        start, end = min(a_azimuth, b_azimuth, c_azimuth), max(a_azimuth, b_azimuth, c_azimuth)
        u0, u1, v0, v1 = 0, columns - 1, 0, rings - 1
        # Straight edges bend in azimuth and elevation: only small triangles keep inside their corners.
        if high - low < 0.1 and end - start < 0.1 and max(abs(low), abs(high)) < 1.0:
            u0 = max(u0, int((start + np.pi) / step) - 1)
            u1 = min(u1, int((end + np.pi) / step) + 2)
            v0 = int(np.searchsorted(elevations, low - 0.005))
            v1 = int(np.searchsorted(elevations, high + 0.005)) - 1
        n0x, n0y, n0z = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        n1x, n1y, n1z = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
        n2x, n2y, n2z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        volume = ax * n0x + ay * n0y + az * n0z
        for v in range(v0, v1 + 1):
            for u in range(u0, u1 + 1):
                dx, dy, dz = rays[v, u]
                e0 = n0x * dx + n0y * dy + n0z * dz
                e1 = n1x * dx + n1y * dy + n1z * dz
                e2 = n2x * dx + n2y * dy + n2z * dz
                if (e0 >= 0.0 and e1 >= 0.0 and e2 >= 0.0) or (e0 <= 0.0 and e1 <= 0.0 and e2 <= 0.0):
                    total = e0 + e1 + e2
                    if total != 0.0:
                        t = volume / total
                        if NEAR_M < t < distance[v, u]:
                            distance[v, u] = t
                            hit[v, u] = f


def _shade(
    vertices: F64, faces: I32, albedo: F32, gloss: F32, ids: I32, rays: F64, hit: I32, view: View
) -> None:
    """Write to ``view`` what the faces that were hit are like."""
    out = (view.ids, view.albedo, view.cosine, view.gloss)
    _shade_pixels(vertices, faces, albedo, gloss, ids, rays, hit, *out)


@kernel
def _shade_pixels(
    vertices: F64,
    faces: I32,
    face_albedo: F32,
    face_gloss: F32,
    face_ids: I32,
    rays: F64,
    hit: I32,
    ids: I32,
    albedo: F32,
    cosine: F32,
    gloss: F32,
) -> None:
    for v in range(hit.shape[0]):
        for u in range(hit.shape[1]):
            f = hit[v, u]
            if f < 0:
                continue
            a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
            px, py, pz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
            qx, qy, qz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
            nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
            d = rays[v, u]
            length = np.sqrt((nx * nx + ny * ny + nz * nz) * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]))
            ids[v, u] = face_ids[f]
            albedo[v, u] = face_albedo[f]
            gloss[v, u] = face_gloss[f]
            cosine[v, u] = abs(nx * d[0] + ny * d[1] + nz * d[2]) / length if length > 0.0 else 0.0
