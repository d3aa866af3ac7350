"""The recording that ships with headvox."""

from __future__ import annotations

from pathlib import Path

from headvox.errors import HeadvoxError


def sample_folder() -> Path:
    """Return the folder of a depth recording: two simulated cameras, three people, 24 frames, and their true heads.

    Raises:
        HeadvoxError: this installation comes without it.
    """
    sample = Path(__file__).parent / "assets" / "sample"
    if not sample.is_dir():
        raise HeadvoxError("This headvox has no sample recording in it.", "Give a SOURCE: headvox run PATH.")
    return sample
