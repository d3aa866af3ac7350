"""Two states of the repository side by side: is a change faster?

    python bench/compare.py OLD [NEW] [--turns 6] [--frames 60] [--cascade NAME|FILE] [--refine pose]

OLD and NEW are commits (anything that git knows: HEAD~3, a branch, a tag); NEW is the working tree by default, and
"." names the working tree too. Each commit's files are laid out in a temporary folder by `git archive`, so neither
the repository nor the working tree is touched. Then fresh processes take turns, OLD NEW OLD NEW ..., each of which
measures the same frames (those of `headvox bench`) through the public calls; the first turn of each compiles and
does not count. Printed are the medians over all turns, and the ratio new / old: its median over the turns, and the
least and greatest ratio. A difference smaller than that spread is none.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tarfile
import tempfile
import time
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("old")
    parser.add_argument("new", nargs="?", default=".")
    parser.add_argument("--turns", type=int, default=6)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--cascade", default="default")
    parser.add_argument("--refine", default="pose", help="pose, sphere or none")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="headvox-compare-") as name:
        folder = Path(name)
        sources = [lay_out(args.old, folder / "old"), lay_out(args.new, folder / "new")]
        frames = folder / "frames.npz"
        save_frames(frames)
        for source in sources:
            measure(source, frames, args, 2)
        turns = [[measure(s, frames, args, args.frames) for s in sources] for _ in range(max(args.turns, 1))]
    print(f"{'ms':24s} {'old':>9s} {'new':>9s}   new / old")
    for case in turns[0][0]:
        old, new = np.array([[turn[0][case], turn[1][case]] for turn in turns]).T
        ratio = new / old
        spread = f"{np.median(ratio):.3f} ({ratio.min():.3f} to {ratio.max():.3f})"
        print(f"{case:24s} {np.median(old):9.3f} {np.median(new):9.3f}   {spread}")
    return 0


def lay_out(commit: str, folder: Path) -> Path:
    """Return the folder with the package of ``commit``."""
    if commit == ".":
        return ROOT / "src"
    done = subprocess.run(["git", "archive", commit, "src"], cwd=ROOT, capture_output=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr.decode(errors="replace").strip())
    folder.mkdir()
    with tarfile.open(fileobj=BytesIO(done.stdout)) as archive:
        archive.extractall(folder)  # our own repository's files
    return folder / "src"


def save_frames(file: Path) -> None:
    """Make the frames once, with the working tree's own generator: both measure the same bytes."""
    sys.path.insert(0, str(ROOT / "src"))
    from headvox.bench.input import make_input

    data = make_input()
    arrays = {"cloud": data.cloud, "shell": data.shell}
    for k, image in enumerate(data.images):
        lens = image.intrinsics
        arrays[f"depth{k}"], arrays[f"T{k}"] = image.depth, image.T_world_camera
        arrays[f"lens{k}"] = np.array([lens.fx, lens.fy, lens.cx, lens.cy, lens.depth_scale])
    np.savez(file, **arrays)


def measure(source: Path, frames: Path, args: argparse.Namespace, count: int) -> dict[str, float]:
    """Return the medians [ms] of a fresh process that imports headvox from ``source``."""
    settings = [str(frames), args.cascade, args.refine, str(count)]
    command = [sys.executable, str(Path(__file__).resolve()), "--child", *settings]
    environment = {**os.environ, "PYTHONPATH": str(source)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        raise SystemExit(f"headvox of {source} failed:\n{done.stderr}")
    medians: dict[str, float] = json.loads(done.stdout)
    return medians


def child(file: str, cascade: str, refine: str, count: int) -> None:
    """Measure, and print the medians."""
    from headvox import DepthImage, Detector, Intrinsics
    from headvox.config import DetectorConfig

    data = np.load(file)
    images = []
    for k in range(2):
        depth, lens = data[f"depth{k}"], data[f"lens{k}"].tolist()
        camera = Intrinsics(depth.shape[1], depth.shape[0], *lens)
        images.append(DepthImage(f"camera {k}", depth, camera, data[f"T{k}"]))
    cloud, shell = data["cloud"], data["shell"]
    alone = DetectorConfig(cascade=cascade, refine=refine, max_range_m=3.5)
    base = replace(alone, centre=(0.0, 0.0, 1.65))
    one, two, both, three = (Detector(config) for config in (base, base, replace(base, threads=2), alone))
    cases = {
        "detect, cloud": lambda: one.detect(cloud),
        "detect_depth": lambda: two.detect_depth(images),
        "detect_depth, 2 threads": lambda: both.detect_depth(images),
        "detect, shell": lambda: three.detect(shell),
    }
    ms: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(count + 3):
        for name, call in cases.items():
            begun = time.perf_counter()
            call()
            ms[name].append(1e3 * (time.perf_counter() - begun))
    print(json.dumps({name: float(np.median(values[3:])) for name, values in ms.items()}))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(sys.argv[2], sys.argv[3], sys.argv[4], int(sys.argv[5]))
    else:
        sys.exit(main())
