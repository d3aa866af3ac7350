"""A source of your own: anything that yields frames, such as a driver that headvox does not know.

python examples/own_source.py

This one makes its images: a ball of a head's size on shoulders, that moves to the left before a wall.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import numpy as np

import headvox
from headvox.run import run

CAMERA = headvox.Intrinsics(320, 240, fx=280.0, fy=280.0, cx=159.5, cy=119.5, depth_scale=0.001)
T_WORLD_CAMERA = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]], dtype=np.float64)


class Drawn:
    """Ten images of a simple figure, 1.5 m from the camera; see headvox.sources.Source for the contract."""

    name = "drawn"
    length: int | None = 10

    def __iter__(self) -> Iterator[headvox.Frame | headvox.BadFrame]:
        """Yield the frames in time order."""
        v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
        rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
        for k in range(10):
            depth = np.full(u.shape, 3.0)
            for y, size in (
                (0.0, (0.08, 0.11, 0.10)),
                (0.42, (0.22, 0.26, 0.12)),
                (0.12, (0.055, 0.12, 0.055)),
            ):
                a, b = rays / size, np.array([0.2 - 0.03 * k, y, 1.5]) / size  # where rays meet an ellipsoid
                aa, ab = (a * a).sum(-1), (a * b).sum(-1)
                root = ab * ab - aa * ((b * b).sum() - 1.0)
                depth = np.where(root > 0, np.minimum(depth, (ab - np.sqrt(np.maximum(root, 0))) / aa), depth)
            image = (depth / CAMERA.depth_scale).round().astype(np.uint16)
            yield headvox.Frame(
                100_000_000 * k, depths=(headvox.DepthImage("one", image, CAMERA, T_WORLD_CAMERA),)
            )

    def close(self) -> None:
        """Release nothing."""


if __name__ == "__main__":
    with closing(headvox.Detector()) as detector:
        report = run(Drawn(), detector, tracker=headvox.Tracker())
    print(f"{report.heads} heads in {report.frames} frames, {report.ids} with an id")
