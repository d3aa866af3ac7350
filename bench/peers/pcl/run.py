"""PCL's people detector on a depth recording with one camera, as JSON lines that `headvox eval --heads` scores.

    apt-get install libpcl-dev cmake g++
    python bench/peers/pcl/run.py recording > pcl.jsonl
    headvox eval recording --heads pcl.jsonl --name PCL

The driver is built on the first run, in a minute or two, in --build.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from headvox import DepthImage, Frame, open_source

HERE = Path(__file__).resolve().parent


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("--build", type=Path, default=Path(tempfile.gettempdir()) / "headvox-pcl-people")
    args = parser.parse_args()
    driver = subprocess.Popen([build(args.build)], stdin=subprocess.PIPE)
    assert driver.stdin is not None
    for frame in open_source(args.recording):
        if isinstance(frame, Frame):
            if len(frame.depths) != 1:
                raise SystemExit(f"Expected frames of one depth camera, got {len(frame.depths)}.")
            driver.stdin.write(as_bytes(frame.stamp_ns, frame.depths[0]))
    driver.stdin.close()
    return driver.wait()


def build(folder: Path) -> Path:
    """Return the driver, made anew where the source changed."""
    for command in (["cmake", "-S", HERE, "-B", folder], ["cmake", "--build", folder]):
        done = subprocess.run(command, stdout=sys.stderr, check=False)
        if done.returncode:
            raise SystemExit("The driver could not be built; it needs libpcl-dev, cmake and g++.")
    return folder / "pcl_people"


def as_bytes(stamp_ns: int, image: DepthImage) -> bytes:
    """Return a frame as the driver reads it."""
    lens = image.intrinsics
    numbers = [stamp_ns, lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy, lens.depth_scale]
    numbers += image.T_world_camera.ravel().tolist()
    return (" ".join(map(repr, numbers)) + "\n").encode() + image.depth.tobytes()


if __name__ == "__main__":
    sys.exit(main())
