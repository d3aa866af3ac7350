"""Where each camera stands, from a TOML or JSON file that a person writes or a calibration prints."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from headvox.data import F64
from headvox.errors import HeadvoxError
from headvox.frames import as_rigid
from headvox.sources.options import mount, mounted

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_MOST_BYTES = 1 << 20
_HELP = "docs/conventions.md describes the file."


def read_extrinsics(file: str) -> dict[str, F64]:
    """Return T_world_camera (4, 4) by the name of the camera, such as a serial number.

    The file has a table ``cameras`` with a table for each, which has ``T_world_camera`` (four rows of four numbers,
    optical axes) or ``mount`` (x, y, z in metres, roll, pitch, yaw in degrees, of its body: x forward, z up).

    Raises:
        HeadvoxError: the file is missing, is neither TOML nor JSON, or says anything that cannot be used.
    """
    path = Path(file)
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise HeadvoxError(f"{file}: expected at most {_MOST_BYTES} bytes.", _HELP)
        text = path.read_text(encoding="utf-8-sig")  # editors of Windows may begin it with a BOM
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise HeadvoxError(f"{file}: cannot be read: {reason}.", "Check the path.") from None
    try:
        content: Any = json.loads(text) if text.lstrip()[:1] == "{" else tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise HeadvoxError(f"{file}: neither TOML nor JSON: {str(error)[:120]}.", _HELP) from None
    cameras = content.get("cameras")
    if not isinstance(cameras, dict) or not cameras:
        raise HeadvoxError(f"{file}: expected a table 'cameras' with a camera in it.", _HELP)
    return {name: _place(entry, f"{file}: camera {name[:40]}") for name, entry in cameras.items()}


def _place(entry: Any, name: str) -> F64:
    keys = sorted(entry) if isinstance(entry, dict) else []
    if keys == ["T_world_camera"]:
        return as_rigid(entry["T_world_camera"], f"{name}: T_world_camera")
    if keys == ["mount"]:
        numbers = entry["mount"]
        if isinstance(numbers, list) and len(numbers) == 6 and all(type(v) in (int, float) for v in numbers):
            T = as_rigid(mount(*map(float, numbers)), f"{name}: mount")
            return mounted(T, is_optical=True)
        raise HeadvoxError(f"{name}: mount: expected six numbers: x, y, z, roll, pitch, yaw.", _HELP)
    raise HeadvoxError(
        f"{name}: expected T_world_camera or mount, got {', '.join(keys)[:60] or 'nothing'}.", _HELP
    )
