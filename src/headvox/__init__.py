"""headvox finds human heads in 3-D point clouds and depth images: deterministic, real time, no neural network."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

__version__ = "0.1.0"

if TYPE_CHECKING:
    from headvox.config import DetectorConfig as DetectorConfig
    from headvox.config import TrackerConfig as TrackerConfig
    from headvox.data import BadFrame as BadFrame
    from headvox.data import Cloud as Cloud
    from headvox.data import DepthImage as DepthImage
    from headvox.data import Expected as Expected
    from headvox.data import Frame as Frame
    from headvox.data import Heads as Heads
    from headvox.data import Intrinsics as Intrinsics
    from headvox.errors import HeadvoxError as HeadvoxError
    from headvox.pipeline import Detector as Detector
    from headvox.run import follow as follow
    from headvox.sample import sample_folder as sample_folder
    from headvox.sources import open_source as open_source
    from headvox.tracking.tracker import Tracker as Tracker

# Names are imported when they are first used: `import headvox` must not wait for Numba.
_HOME = {
    "BadFrame": "headvox.data",
    "Cloud": "headvox.data",
    "DepthImage": "headvox.data",
    "Detector": "headvox.pipeline",
    "DetectorConfig": "headvox.config",
    "Expected": "headvox.data",
    "Frame": "headvox.data",
    "Heads": "headvox.data",
    "HeadvoxError": "headvox.errors",
    "Intrinsics": "headvox.data",
    "Tracker": "headvox.tracking.tracker",
    "TrackerConfig": "headvox.config",
    "follow": "headvox.run",
    "open_source": "headvox.sources",
    "sample_folder": "headvox.sample",
}

__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'headvox' has no attribute '{name}'")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
