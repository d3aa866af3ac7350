"""Follow heads before a RealSense camera, until Ctrl-C.

python examples/live_camera.py [SERIAL]      (needs: pip install 'headvox[realsense]')

The camera is taken to stand 1.65 m above the floor and to look 10 degrees down: say below where yours is.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from contextlib import closing, suppress

import headvox
from headvox.sources.options import SourceOptions, mount

WHERE = SourceOptions(T_world_mount=mount(x=0.0, y=0.0, z=1.65, roll_deg=0.0, pitch_deg=10.0, yaw_deg=0.0))


def tell(reason: str) -> None:
    """Say why a frame is skipped: a hand before the lens, say."""
    print(f"skipped: {reason}", file=sys.stderr)


def main(frames: Iterable[headvox.Frame | headvox.BadFrame]) -> None:
    """Print how many people are there, how far the nearest head is, and what the frame took."""
    with closing(headvox.Detector()) as detector:
        for frame, tracks in headvox.follow(frames, detector, headvox.Tracker(), on_bad=tell):
            camera = frame.depths[0].T_world_camera[:3, 3]
            away = [float(((track.centre - camera) ** 2).sum() ** 0.5) for track in tracks if track.id]
            nearest = f"nearest {min(away):.2f} m" if away else "nobody"
            print(f"{len(away)} heads, {nearest}, {sum(detector.stage_ms.values()):.1f} ms")


if __name__ == "__main__":
    serial = sys.argv[1] if len(sys.argv) > 1 else ""
    try:
        with (
            closing(headvox.open_source(f"realsense:{serial}", WHERE)) as camera,
            suppress(KeyboardInterrupt),
        ):
            main(camera)
    except headvox.HeadvoxError as error:
        sys.exit(str(error))
