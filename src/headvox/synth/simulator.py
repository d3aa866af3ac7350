"""A scene through MuJoCo's cameras: the same triangles as :mod:`headvox.synth.rays` casts, somebody else's renderer.

Needs ``pip install 'headvox[sim]'`` and OpenGL: on a machine without a screen, EGL (Debian: libegl1).
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Any

import numpy as np

from headvox.data import F64, DepthImage, Frame, Intrinsics
from headvox.errors import HeadvoxError, MissingExtra
from headvox.synth.scene import Scene

NEAR_M, FAR_M = 0.05, 30.0
EVERYWHERE_M = 100.0


class Simulator:
    """Renders what the cameras of a scene see at a time, without any noise.

    Raises:
        HeadvoxError: MuJoCo is not installed or cannot render here, or the cameras are not alike, or not centred.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        lens = _common_lens(scene)
        self._mujoco = mujoco = _mujoco()
        self._model = _model(mujoco, scene, lens)
        self._data = mujoco.MjData(self._model)
        try:
            self._renderer = mujoco.Renderer(self._model, lens.height, lens.width)
        except Exception as error:  # whatever the platform's OpenGL does not like
            raise HeadvoxError(
                f"MuJoCo cannot render here: {error}",
                "Install EGL (Debian: libegl1), or choose another with the variable MUJOCO_GL.",
            ) from None
        self._renderer.enable_depth_rendering()

    def frame(self, stamp_ns: int) -> Frame:
        """Return what all cameras see at a time, in whole steps of their depth scales; 0 where there is nothing."""
        depths = []
        for camera, distance_m in zip(self._scene.cameras, self.distances(stamp_ns), strict=True):
            steps = np.rint(distance_m / camera.intrinsics.depth_scale)
            steps[~np.isfinite(steps) | (steps > np.iinfo(np.uint16).max)] = 0
            image = steps.astype(np.uint16)
            depths.append(DepthImage(camera.name, image, camera.intrinsics, camera.T_world_camera))
        return Frame(stamp_ns, depths=tuple(depths))

    def distances(self, stamp_ns: int) -> list[F64]:
        """Return each camera's distances along its axis (height, width) in metres, infinite where there is nothing."""
        mujoco, model = self._mujoco, self._model
        for k, mesh in enumerate(self._scene.meshes(stamp_ns)):
            first, count = int(model.mesh_vertadr[k]), int(model.mesh_vertnum[k])
            model.mesh_vert[first : first + count] = mesh.vertices
            mujoco.mjr_uploadMesh(model, self._renderer._mjr_context, k)
        mujoco.mj_forward(model, self._data)
        seen = []
        for camera in self._scene.cameras:
            self._renderer.update_scene(self._data, camera=camera.name)
            self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = 0  # triangles have two sides
            distance_m = self._renderer.render().astype(np.float64)
            distance_m[distance_m > 0.99 * FAR_M] = np.inf
            seen.append(distance_m)
        return seen

    def close(self) -> None:
        """Let go of the renderer."""
        self._renderer.close()


def _mujoco() -> Any:
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "egl")  # needs no screen
    try:
        return import_module("mujoco")
    except Exception as error:  # it also loads OpenGL, which fails in many ways
        raise MissingExtra(f"MuJoCo cannot be used here: {error}", "sim") from None


def _common_lens(scene: Scene) -> Intrinsics:
    lenses = {camera.intrinsics for camera in scene.cameras}
    if len(lenses) != 1:
        raise HeadvoxError(f"Expected cameras that are alike, got {len(lenses)} sorts.", "Take one sort.")
    (lens,) = lenses
    middle = (0.5 * (lens.width - 1), 0.5 * (lens.height - 1))
    if lens.fx != lens.fy or (lens.cx, lens.cy) != middle:
        raise HeadvoxError("Expected square pixels and a centred lens.", "Take a d435i.")
    return lens


def _model(mujoco: Any, scene: Scene, lens: Intrinsics) -> Any:
    """Return a model of the scene's meshes, whose vertices are in the world frame, and of its cameras."""
    spec = mujoco.MjSpec()
    for k, mesh in enumerate(scene.meshes(0)):
        vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
        made = spec.add_mesh(name=str(k), uservert=vertices.ravel(), userface=faces.ravel())
        made.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # they need not be closed
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=str(k), contype=0, conaffinity=0)
    for camera in scene.cameras:
        T = camera.T_world_camera
        turn = np.empty(4)
        mujoco.mju_mat2Quat(
            turn, (T[:3, :3] @ np.diag([1.0, -1.0, -1.0])).ravel()
        )  # it looks along -z, y is up
        spec.worldbody.add_camera(
            name=camera.name,
            pos=T[:3, 3],
            quat=turn,
            fovy=np.degrees(2.0 * np.arctan(0.5 * lens.height / lens.fy)),
        )
    spec.visual.global_.offwidth, spec.visual.global_.offheight = lens.width, lens.height
    spec.stat.extent, spec.visual.map.znear, spec.visual.map.zfar = 1.0, NEAR_M, FAR_M
    model = spec.compile()
    model.geom_pos[:], model.geom_quat[:] = (
        0.0,
        (1.0, 0.0, 0.0, 0.0),
    )  # it had moved each to its centre of mass
    model.geom_rbound[:] = EVERYWHERE_M
    return model
