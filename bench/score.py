"""How many of the true heads were found, and how well?

    headvox run recording --json > found.jsonl
    python bench/score.py found.jsonl recording/heads.jsonl [--within 0.15]

Prints one line of JSON. A head is found when a detection lies within the distance (m) of its centre; pairs are made
nearest first, each detection and each head once. A detection that is left over is false, unless it is that near to a
head marked "ignore". Frames with a line in heads.jsonl that is exhaustive count, whether or not anything was found.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("found", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--within", type=float, default=0.15, metavar="M")
    args = parser.parse_args()
    print(json.dumps(score(lines(args.found), lines(args.truth), args.within)))


def lines(path: Path) -> dict[int, list[dict[str, object]]]:
    """Return the heads of each frame by its stamp; without those frames whose heads are not all known."""
    parsed = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    return {frame["stamp_ns"]: frame["heads"] for frame in parsed if frame.get("exhaustive", True)}


def score(found: dict[int, list[dict]], truth: dict[int, list[dict]], within_m: float) -> dict[str, object]:
    heads, errors, false = 0, [], 0
    for stamp, true_heads in truth.items():
        real = [head["centre"] for head in true_heads if not head.get("ignore")]
        ignored = [head["centre"] for head in true_heads if head.get("ignore")]
        seen = [head["centre"] for head in found.get(stamp, [])]
        heads += len(real)
        free, open_heads = set(range(len(seen))), set(range(len(real)))
        far = distances(seen, real)
        for flat in np.argsort(far, axis=None, kind="stable"):
            i, j = divmod(int(flat), max(len(real), 1))
            if far[i, j] > within_m:
                break
            if i in free and j in open_heads:
                free.remove(i)
                open_heads.remove(j)
                errors.append(far[i, j])
        near_ignored = distances(seen, ignored).min(axis=1, initial=np.inf)
        false += sum(near_ignored[i] > within_m for i in free)
    return {
        "frames": len(truth),
        "heads": heads,
        "found": len(errors),
        "recall": round(len(errors) / heads, 4) if heads else None,
        "false": int(false),
        "false_a_frame": round(false / len(truth), 4) if truth else None,
        "mean_error_m": round(float(np.mean(errors)), 4) if errors else None,
        "median_error_m": round(float(np.median(errors)), 4) if errors else None,
    }


def distances(a: list, b: list) -> np.ndarray:
    """Return the distance of each of ``a`` to each of ``b``."""
    return np.linalg.norm(np.reshape(a, (-1, 1, 3)) - np.reshape(b, (1, -1, 3)), axis=2)


if __name__ == "__main__":
    main()
