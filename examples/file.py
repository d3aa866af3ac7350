"""Print the heads in a file or a folder: a depth recording, a bag, a point cloud, or a folder of clouds.

python examples/file.py [SOURCE]      (without SOURCE: the sample that ships with headvox)
"""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path

import headvox


def tell(reason: str) -> None:
    """Say why a frame is skipped."""
    print(f"skipped: {reason}", file=sys.stderr)


def main(place: str | Path) -> None:
    """Print a line for each head that is followed, frame by frame."""
    detector, tracker = headvox.Detector(), headvox.Tracker()
    with closing(headvox.open_source(place)) as source, closing(detector):
        for frame, tracks in headvox.follow(source, detector, tracker, on_bad=tell):
            for track in tracks:
                if track.id:  # 0 until it was seen often enough to be believed
                    x, y, z = track.centre
                    print(f"{frame.stamp_ns / 1e9:.3f} s  head {track.id}  {x:+.3f} {y:+.3f} {z:+.3f} m")


if __name__ == "__main__":
    try:
        main(sys.argv[1] if len(sys.argv) > 1 else headvox.sample_folder())
    except headvox.HeadvoxError as error:
        sys.exit(str(error))
