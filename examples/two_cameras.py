"""Two cameras, one search: what each sees alone, and what both see together.

python examples/two_cameras.py [RECORDING]      (without one: the sample that ships with headvox)

The images of all cameras go into one Frame, each with its place in the world. A head that each camera sees the half of
is then one whole head, and not two to be merged afterwards.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from contextlib import closing
from pathlib import Path

import headvox


def main(place: str | Path) -> None:
    """Count the heads, and those whose orientation is known, by what was looked at."""
    counts: dict[str, list[int]] = defaultdict(lambda: [0, 0])
    with closing(headvox.open_source(place)) as source, closing(headvox.Detector()) as detector:
        for frame in source:
            if isinstance(frame, headvox.BadFrame):
                continue
            alone = {image.name: headvox.Frame(frame.stamp_ns, depths=(image,)) for image in frame.depths}
            for name, seen in {**alone, "together": frame}.items():
                try:
                    heads = detector.detect_frame(seen)
                except headvox.HeadvoxError as error:
                    print(f"skipped: {error}", file=sys.stderr)
                    continue
                counts[name][0] += len(heads)
                counts[name][1] += sum(head.quaternion[0] == head.quaternion[0] for head in heads)  # not NaN
    for name, (found, oriented) in counts.items():
        print(f"{name:10} {found:4} heads, {oriented:4} with orientation")


if __name__ == "__main__":
    try:
        main(sys.argv[1] if len(sys.argv) > 1 else headvox.sample_folder())
    except headvox.HeadvoxError as error:
        sys.exit(str(error))
