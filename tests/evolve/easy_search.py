"""A search that takes a moment: in its views, heads are spheres on necks and the rest is boxes."""

from __future__ import annotations

import numpy as np

from headvox.data import Cloud, DepthImage, Frame, Intrinsics
from headvox.evolve import boost, samples, views
from headvox.frames import inverse, transform

SMALL_SEARCH = (
    boost.Plan("glimpse", "single", 3, 4, 0.5, 0.01),
    boost.Plan("shape", "occupied", 3, 6, 0.3, 0.01),
)
SMALL_JUDGE = (
    boost.Plan("closer", "single", 3, 4, 0.5, 0.01),
    boost.Plan("detail", "occupied", 4, 8, 0.3, 0.01, costly=False),
    boost.Plan("sight", "seen", 2, 3, 0.3, 0.0, costly=False),
)


def easy_view(folder, seed: int, number: int) -> views.View:
    """A sphere on a cylinder, now and then two, and a box or three."""
    rng = np.random.default_rng([seed, number])
    parts, centres = [], []
    for k in range(int(rng.integers(0, 3))):
        centre = np.array([1.2 * k - 0.6, 0.0, 1.5]) + rng.uniform(-0.3, 0.3, 3)
        ball = rng.normal(size=(1500, 3))
        parts.append(centre + 0.1 * ball / np.linalg.norm(ball, axis=1, keepdims=True))
        angle, height = rng.uniform(0, 6.28, 2000), rng.uniform(-0.9, -0.18, 2000)
        parts.append(centre + np.column_stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), height]))
        centres.append(centre)
    for _ in range(3):
        box = rng.uniform(-0.5, 0.5, (1500, 3))
        box[np.arange(1500), rng.integers(0, 3, 1500)] = rng.choice([-0.5, 0.5], 1500)
        parts.append(rng.uniform([-2, -2, 0], [2, 2, 1.5]) + box * rng.uniform(0.1, 1.0, 3))
    points = np.concatenate(parts).astype(np.float32)
    count = len(centres)
    heads = views.Heads(
        np.array(centres).reshape(-1, 3), np.ones(count), np.ones(count, bool), np.zeros(count, np.int64)
    )
    frame = Frame(0, depths=(seen(points),)) if number % 2 else Frame(0, clouds=(Cloud("made", points),))
    return views.View(number, frame, heads)


def seen(points: np.ndarray) -> DepthImage:
    """Points as a camera 2 m away sees them, the nearest in each pixel."""
    lens = Intrinsics(160, 120, 80.0, 80.0, 79.5, 59.5)
    T = np.array([[0.0, 0, 1, -2.0], [-1, 0, 0, 0], [0, -1, 0, 1.2], [0, 0, 0, 1]])
    x, y, z = transform(inverse(T), points.astype(np.float64)).T
    ahead = z > 0.2
    x, y, z = x[ahead], y[ahead], z[ahead]
    u = np.clip(np.round(lens.fx * x / z + lens.cx), 0, 159).astype(int)
    v = np.clip(np.round(lens.fy * y / z + lens.cy), 0, 119).astype(int)
    depth = np.full((120, 160), 65535, np.uint16)
    np.minimum.at(depth, (v, u), np.round(1000.0 * z).astype(np.uint16))
    return DepthImage("camera", np.where(depth == 65535, 0, depth).astype(np.uint16), lens, T)


def samples_of(score, label, bag) -> tuple[samples.Samples, np.ndarray]:
    count = len(score)
    empty = np.zeros((count, 0), np.int16)
    made = samples.Samples(
        empty, empty, np.array(label, np.int8), np.array(bag), np.zeros(count, np.int64), np.ones(count, bool)
    )
    return made, np.array(score, float)
