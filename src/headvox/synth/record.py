"""Write a scene as a depth recording with its true heads beside it.

Everything is made in ``NAME.partial`` and renamed at the end, so that a folder NAME is always complete; a
recording that was broken off goes on where it stopped.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from headvox import __version__
from headvox.atomic import write_text
from headvox.data import U16, Cloud, Frame
from headvox.errors import HeadvoxError
from headvox.parallel.workers import ALONE, Workers
from headvox.sources.folder import FRAME_NS
from headvox.synth.camera import d435i
from headvox.synth.makers import People
from headvox.synth.presets import two_cameras
from headvox.synth.scene import Scene, TrueHead
from headvox.writable import make_folder

SAMPLE_FRAMES = 24
SAMPLE_RATE_HZ = 10.0


def stamps(count: int, rate_hz: float = 10.0) -> list[int]:
    """Stamps [ns] of ``count`` frames from 0 on."""
    return [round(k * 1e9 / rate_hz) for k in range(count)]


def cloud_stamps(count: int) -> list[int]:
    """Stamps [ns] that a folder of clouds is read with: files have none."""
    return [k * FRAME_NS for k in range(count)]


def write_recording(
    folder: str | Path,
    scene: Scene,
    stamps_ns: Sequence[int],
    workers: Workers = ALONE,
    on_done: Callable[[int], None] | None = None,
) -> Path:
    """Write the frames of a scene at ``stamps_ns`` and ``heads.jsonl``; return the folder.

    The bytes are the same for any ``workers``. ``on_done`` is told how many frames
    there are so far.

    Raises:
        HeadvoxError: the folder holds something, no camera, a LiDAR in the scene, stamps that do not rise, or
            another recording was begun under this name.
    """
    if not scene.cameras or scene.lidars:
        got = f"{len(scene.cameras)} cameras and {len(scene.lidars)} LiDARs"
        raise HeadvoxError(
            f"A depth recording holds depth cameras only, got {got}.", "Change the scene's sensors."
        )
    description = json.dumps(_description(scene, stamps_ns), indent=1) + "\n"
    return _write(Path(folder), scene, stamps_ns, workers, on_done, _write_depths, description)


def write_clouds(
    folder: str | Path,
    scene: Scene,
    stamps_ns: Sequence[int],
    workers: Workers = ALONE,
    on_done: Callable[[int], None] | None = None,
) -> Path:
    """Write what the one LiDAR of a scene sees as PCD files, and ``heads.jsonl``; return the folder.

    The clouds are in the sensor's frame, and VIEWPOINT says where it is. Everything else is as in
    :func:`write_recording`; see :func:`cloud_stamps`.
    """
    if scene.cameras or len(scene.lidars) != 1:
        got = f"{len(scene.cameras)} cameras and {len(scene.lidars)} LiDARs"
        raise HeadvoxError(f"A folder of clouds holds one LiDAR's, got {got}.", "Change the scene's sensors.")
    return _write(Path(folder), scene, stamps_ns, workers, on_done, _write_cloud, None)


def _write(
    folder: Path,
    scene: Scene,
    stamps_ns: Sequence[int],
    workers: Workers,
    on_done: Callable[[int], None] | None,
    write_frame: Callable[[Path, Frame, int], None],
    description: str | None,
) -> Path:
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise HeadvoxError(f"{folder} exists already.", "Give another name, or remove it first.")
    if not stamps_ns or any(b <= a for a, b in pairwise(stamps_ns)):
        raise HeadvoxError("Expected at least one stamp, each later than the one before.", "Sort the stamps.")
    partial_folder = folder.with_name(folder.name + ".partial")
    make_folder(partial_folder, folder)
    _begin(partial_folder, _making(scene, stamps_ns))
    truth = partial_folder / "truth"
    for place in (truth, *(partial_folder / camera.name for camera in scene.cameras)):
        place.mkdir(exist_ok=True)
    job = partial(_make_frame, folder=partial_folder, scene=scene, write_frame=write_frame)
    lines = []
    for line in workers.map(job, list(enumerate(stamps_ns))):
        lines.append(line)
        if on_done is not None:
            on_done(len(lines))
    write_text(partial_folder / "heads.jsonl", "".join(line.read_text(encoding="utf-8") for line in lines))
    if description is not None:
        write_text(partial_folder / "recording.json", description)
    for line in lines:
        line.unlink()
    truth.rmdir()
    (partial_folder / "making.json").unlink()
    if folder.exists():
        folder.rmdir()  # it is empty
    partial_folder.rename(folder)
    return folder


def _making(scene: Scene, stamps_ns: Sequence[int]) -> dict[str, Any]:
    """What a recording that goes on must have in common with the one that was begun."""
    people = [
        (actor.id, actor.moments[0].pose.posture, actor.moments[0].xy, len(actor.moments))
        for actor in scene.actors
    ]
    sensors = [repr(camera) for camera in scene.cameras] + [repr(lidar) for lidar in scene.lidars]
    made = json.dumps([people, sensors, list(stamps_ns)])
    return {
        "version": __version__,
        "seed": scene.seed,
        "scene": hashlib.sha256(made.encode()).hexdigest(),
    }


def _begin(folder: Path, making: dict[str, Any]) -> None:
    """Claim the folder, or go on with it when the same recording was begun there."""
    note = folder / "making.json"
    if not note.exists() and not any(folder.iterdir()):
        write_text(note, json.dumps(making))
    elif not note.exists() or json.loads(note.read_text(encoding="utf-8")) != making:
        raise HeadvoxError(
            f"{folder} holds the beginning of another recording.", "Remove it, or give another name."
        )


def _make_frame(
    which: tuple[int, int], folder: Path, scene: Scene, write_frame: Callable[[Path, Frame, int], None]
) -> Path:
    number, stamp_ns = which
    line = folder / "truth" / f"{number:06d}.json"
    if line.exists():  # written last: its images are there too
        return line
    frame, heads = scene.frame(stamp_ns)
    write_frame(folder, frame, number)
    write_text(
        line, json.dumps({"stamp_ns": stamp_ns, "heads": [_row(h) for h in heads], "exhaustive": True}) + "\n"
    )
    return line


def _write_depths(folder: Path, frame: Frame, number: int) -> None:
    for depth in frame.depths:
        _write_png(folder / depth.name / f"{number:06d}.png", depth.depth)


def _write_cloud(folder: Path, frame: Frame, number: int) -> None:
    (cloud,) = frame.clouds
    path = folder / f"{number:06d}.pcd"
    unfinished = path.with_suffix(".part")
    unfinished.write_bytes(pcd_bytes(cloud))
    os.replace(unfinished, path)


def pcd_bytes(cloud: Cloud) -> bytes:
    """Return a binary PCD file; the sensor's place becomes its VIEWPOINT."""
    T_world_sensor = np.eye(4) if cloud.T_world_sensor is None else cloud.T_world_sensor
    x, y, z, w = Rotation.from_matrix(T_world_sensor[:3, :3]).as_quat()
    place = [f"{n:.9g}" for n in (*T_world_sensor[:3, 3], w, x, y, z)]
    count = len(cloud.points)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\n"
        f"COUNT 1 1 1\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT {' '.join(place)}\nPOINTS {count}\nDATA binary\n"
    )
    return header.encode("ascii") + cloud.points.astype("<f4").tobytes()


def _row(head: TrueHead) -> dict[str, Any]:
    return {
        "id": head.id,
        "centre": [round(float(n), 5) for n in head.centre],
        "quaternion": [round(float(n), 6) for n in head.quaternion],
        "ignore": head.ignore,
        "truncated": head.truncated,
        "visible": head.visible,
        "posture": head.posture,
        "hair": head.hair,
    }


def _description(scene: Scene, stamps_ns: Sequence[int]) -> dict[str, Any]:
    cameras = {
        camera.name: asdict(camera.intrinsics) | {"T_world_camera": camera.T_world_camera.tolist()}
        for camera in scene.cameras
    }
    frames = [
        {"stamp_ns": stamp, "depth": {name: f"{name}/{k:06d}.png" for name in cameras}}
        for k, stamp in enumerate(stamps_ns)
    ]
    return {"format": "headvox-recording", "version": 1, "cameras": cameras, "frames": frames}


def _write_png(path: Path, depth: U16) -> None:
    unfinished = path.with_suffix(".part")
    Image.fromarray(depth).save(unfinished, format="PNG", compress_level=6)
    os.replace(unfinished, path)


def sample_scene_of_three(seed: int = 0, people: People | None = None) -> Scene:
    """Two small D435i images of three people: one sits, one walks, one turns."""
    # Calm sensors: noise is what makes depth images large.
    sensor = replace(d435i(), noise_px=0.04, noise_size_px=3.0, salt=0.0003)
    return two_cameras(
        seed,
        people,
        duration_s=SAMPLE_FRAMES / SAMPLE_RATE_HZ,
        postures=("sitting", "walking", "standing"),
        acts=("stay", "walk", "turn"),
        mode="d435i-small",
        sensor=sensor,
    )


def make_sample(
    out: str | Path,
    people: People | None = None,
    workers: Workers = ALONE,
    on_done: Callable[[int], None] | None = None,
) -> Path:
    """Write the small two-camera recording that comes with the package: 24 frames, under 3.5 MB."""
    scene = sample_scene_of_three(people=people)
    return write_recording(out, scene, stamps(SAMPLE_FRAMES, SAMPLE_RATE_HZ), workers, on_done)
