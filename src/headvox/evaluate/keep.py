"""Write the frames of a scenario as a depth recording with its true heads, for other programs to run on."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from headvox.data import F64, BadFrame
from headvox.errors import HeadvoxError
from headvox.evaluate.scenarios import Scenario, recording
from headvox.evaluate.truth import FILE as HEADS_FILE
from headvox.evaluate.truth import NO_ID, TrueHeads
from headvox.sources.recording import FILE, FORMAT, VERSION


def keep(scenario: Scenario, folder: Path, on_frame: Callable[[int], None] = lambda number: None) -> Scenario:
    """Write all frames into a new ``folder``; return the scenario as it is read from there.

    Raises:
        HeadvoxError: the folder holds something, or the frames are no depth images.
    """
    if folder.exists() and any(folder.iterdir()):
        raise HeadvoxError(f"{folder} holds something already.", "Give another name, or remove it first.")
    cameras: dict[str, Any] = {}
    frames, lines = [], []
    for number, (frame, true) in enumerate(scenario.frames()):
        if isinstance(frame, BadFrame) or frame.clouds:
            raise HeadvoxError(f"{scenario.name}: these frames are no depth images.", "Keep others.")
        entry: dict[str, Any] = {"stamp_ns": frame.stamp_ns, "depth": {}, "T_world_camera": {}}
        for image in frame.depths:
            cameras.setdefault(image.name, asdict(image.intrinsics))
            file = f"{image.name}/{number:06d}.png"
            (folder / image.name).mkdir(parents=True, exist_ok=True)
            Image.fromarray(image.depth).save(folder / file, format="PNG")
            entry["depth"][image.name] = file
            entry["T_world_camera"][image.name] = image.T_world_camera.tolist()
        frames.append(entry)
        lines += [] if true is None else [json.dumps(_line(true)) + "\n"]
        on_frame(number + 1)
    description = {"format": FORMAT, "version": VERSION, "cameras": cameras, "frames": frames}
    (folder / HEADS_FILE).write_text("".join(lines), encoding="utf-8")
    (folder / FILE).write_text(
        json.dumps(description, indent=1) + "\n", encoding="utf-8"
    )  # last: all is there
    return replace(scenario, frames=recording(folder).frames)


def _line(true: TrueHeads) -> dict[str, Any]:
    heads = [
        {
            "id": None if true.ids[k] == NO_ID else int(true.ids[k]),
            "centre": true.centres[k].tolist(),
            "quaternion": _known(true.quaternions[k]),
            "ignore": bool(true.ignored[k]),
            "truncated": bool(true.truncated[k]),
            "visible": true.shares[k],
            **{label: words[k] for label, words in true.labels.items() if words[k]},
        }
        for k in range(len(true))
    ]
    return {"stamp_ns": true.stamp_ns, "heads": heads, "exhaustive": True}


def _known(values: F64) -> list[float] | None:
    return values.tolist() if np.isfinite(values).all() else None
