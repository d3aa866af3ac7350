"""Make the pictures of README and docs: what the detector says of the sample, and the cascades.

    python docs/make_pictures.py [--out docs/pictures]

``sample.gif`` is what ``headvox render`` makes of the sample, ``cascade-NAME.png`` the overview that
``headvox masks plot NAME`` draws. Needs the extra ``plot``.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from PIL import Image

from headvox.cli import main as headvox
from headvox.masks.plot import plot_cascade
from headvox.masks.read import load_cascade, shipped_cascades


def save_small(drawn: Path, path: Path, width: int = 1100) -> Path:
    """Write a picture again, ``width`` pixels wide and with few colours, and return where."""
    with Image.open(drawn) as image:
        small = image.convert("RGB").resize(
            (width, width * image.height // image.width), Image.Resampling.LANCZOS
        )
    small.quantize(64, dither=Image.Dither.NONE).save(path, optimize=True)
    return path


def main() -> None:
    """Make all pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "pictures")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="headvox-pictures-") as name:
        spare = Path(name)
        if headvox(["render", "--width", "960", "-o", str(args.out / "sample.gif")]) != 0:
            raise SystemExit(1)
        for cascade in shipped_cascades():
            drawn = list(plot_cascade(load_cascade(cascade), spare / cascade))
            overview = next(path for path in drawn if path.name == "overview.png")
            print(save_small(overview, args.out / f"cascade-{cascade}.png"))


if __name__ == "__main__":
    main()
