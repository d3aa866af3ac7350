"""Write a scene as a depth recording with its true heads beside it.

Everything is made in ``NAME.partial`` and renamed at the end, so that a folder NAME is always complete; a
recording that was broken off goes on where it stopped.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from PIL import Image

from headvox.data import U16
from headvox.errors import HeadvoxError
from headvox.synth.actors import People
from headvox.synth.camera import d435i
from headvox.synth.presets import two_cameras
from headvox.synth.scene import Scene, TrueHead

SAMPLE_FRAMES = 24
SAMPLE_RATE_HZ = 10.0


def stamps(count: int, rate_hz: float = 10.0) -> list[int]:
    """Stamps [ns] of ``count`` frames from 0 on."""
    return [round(k * 1e9 / rate_hz) for k in range(count)]


def write_recording(folder: str | Path, scene: Scene, stamps_ns: Sequence[int], workers: int = 1) -> Path:
    """Write the frames of a scene at ``stamps_ns`` and ``heads.jsonl``; return the folder.

    The bytes are the same for any number of ``workers`` (threads).

    Raises:
        HeadvoxError: the folder exists, no camera, a LiDAR in the scene, stamps that do not rise, or another
            recording was begun under this name.
    """
    folder = Path(folder)
    _check(folder, scene, stamps_ns, workers)
    description = json.dumps(_description(scene, stamps_ns), indent=1) + "\n"
    partial = folder.with_name(folder.name + ".partial")
    _begin(partial, {"seed": scene.seed, "recording": description})
    truth = partial / "truth"
    for place in (truth, *(partial / camera.name for camera in scene.cameras)):
        place.mkdir(exist_ok=True)
    with ThreadPoolExecutor(workers, "headvox-record") as pool:
        jobs = [pool.submit(_write_frame, partial, scene, k, stamp) for k, stamp in enumerate(stamps_ns)]
        try:
            for job in jobs:
                job.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    lines = [truth / f"{k:06d}.json" for k in range(len(stamps_ns))]
    _write_text(partial / "heads.jsonl", "".join(line.read_text(encoding="utf-8") for line in lines))
    _write_text(partial / "recording.json", description)
    for line in lines:
        line.unlink()
    truth.rmdir()
    (partial / "making.json").unlink()
    partial.rename(folder)
    return folder


def _check(folder: Path, scene: Scene, stamps_ns: Sequence[int], workers: int) -> None:
    if folder.exists():
        raise HeadvoxError(f"{folder} exists already.", "Give another name, or remove it first.")
    if not scene.cameras or scene.lidars:
        got = f"{len(scene.cameras)} cameras and {len(scene.lidars)} LiDARs"
        raise HeadvoxError(
            f"A depth recording holds depth cameras only, got {got}.", "Change the scene's sensors."
        )
    if not stamps_ns or any(b <= a for a, b in pairwise(stamps_ns)):
        raise HeadvoxError("Expected at least one stamp, each later than the one before.", "Sort the stamps.")
    if workers < 1:
        raise HeadvoxError(f"Expected at least 1 worker, got {workers}.", "Give a whole number from 1 on.")


def _begin(partial: Path, making: dict[str, Any]) -> None:
    """Make the folder, or go on with it when the same recording was begun there."""
    note = partial / "making.json"
    partial.mkdir(parents=True, exist_ok=True)
    if not note.exists():
        _write_text(note, json.dumps(making))
    elif json.loads(note.read_text(encoding="utf-8")) != making:
        raise HeadvoxError(
            f"{partial} holds the beginning of another recording.", "Remove it, or give another name."
        )


def _write_frame(partial: Path, scene: Scene, number: int, stamp_ns: int) -> None:
    line = partial / "truth" / f"{number:06d}.json"
    if line.exists():  # written last: its images are there too
        return
    frame, heads = scene.frame(stamp_ns)
    for depth in frame.depths:
        _write_png(partial / depth.name / f"{number:06d}.png", depth.depth)
    _write_text(
        line, json.dumps({"stamp_ns": stamp_ns, "heads": [_row(h) for h in heads], "exhaustive": True}) + "\n"
    )


def _row(head: TrueHead) -> dict[str, Any]:
    return {
        "id": head.id,
        "centre": [round(float(n), 5) for n in head.centre],
        "quaternion": [round(float(n), 6) for n in head.quaternion],
        "ignore": head.ignore,
        "truncated": head.truncated,
        "visible": head.visible,
        "posture": head.posture,
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


def _write_text(path: Path, text: str) -> None:
    unfinished = path.with_name(path.name + ".part")
    unfinished.write_text(text, encoding="utf-8")
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


def make_sample(out: str | Path, people: People | None = None) -> Path:
    """Write the small two-camera recording that comes with the package: 24 frames, under 3.5 MB."""
    return write_recording(out, sample_scene_of_three(people=people), stamps(SAMPLE_FRAMES, SAMPLE_RATE_HZ))
