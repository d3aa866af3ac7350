"""Real frames as other rigs would have taken them: how wrong may extrinsics be, how bad the images?

    python bench/spoilt.py RECORDING...

Every frame with labels is searched as it is and spoilt in many ways, the same in every run. Printed for each way: heads
found of those that are whole, false heads a frame, the mean error of those found, the lowest score of a head.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation

from headvox.config import DetectorConfig
from headvox.data import F32, F64, DepthImage, Frame
from headvox.errors import HeadvoxError
from headvox.evaluate.match import Rules, match
from headvox.evaluate.truth import FILE, TrueHeads, read_truth
from headvox.frames import inverse, transform
from headvox.pipeline import Detector
from headvox.sources import open_source

Rng = np.random.Generator
Way = Callable[[DepthImage, TrueHeads, Rng], tuple[DepthImage, TrueHeads]]

LEAST = -10.0  # a score that nearly every head has, found or not
BEHIND_M = 0.15
PERSON_M, FLOOR_M = 0.5, 0.1


def as_it_is(image: DepthImage, heads: TrueHeads, rng: Rng) -> tuple[DepthImage, TrueHeads]:
    """Change nothing."""
    return image, heads


def turned(axis: str, degrees: float) -> Way:
    """State a pose that is wrong by an angle about an axis of the world through the camera."""

    def way(image: DepthImage, heads: TrueHeads, rng: Rng) -> tuple[DepthImage, TrueHeads]:
        T, camera = np.eye(4), image.T_world_camera[:3, 3]
        T[:3, :3] = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
        T[:3, 3] = camera - T[:3, :3] @ camera
        return _placed(image, heads, T)

    return way


def raised(metres: float) -> Way:
    """State a height that is wrong."""

    def way(image: DepthImage, heads: TrueHeads, rng: Rng) -> tuple[DepthImage, TrueHeads]:
        T = np.eye(4)
        T[2, 3] = metres
        return _placed(image, heads, T)

    return way


def mirrored(image: DepthImage, heads: TrueHeads, rng: Rng) -> tuple[DepthImage, TrueHeads]:
    """Take the left for the right."""
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    camera = image.intrinsics
    image = replace(
        image,
        depth=np.ascontiguousarray(image.depth[:, ::-1]),
        intrinsics=replace(camera, cx=camera.width - 1 - camera.cx),
        T_world_camera=flip @ image.T_world_camera @ flip,
    )
    return image, replace(heads, centres=transform(flip, heads.centres))


def coarser(image: DepthImage, heads: TrueHeads, rng: Rng) -> tuple[DepthImage, TrueHeads]:
    """Leave every other column and row out."""
    camera, depth = image.intrinsics, np.ascontiguousarray(image.depth[::2, ::2])
    half = replace(
        camera, width=depth.shape[1], height=depth.shape[0],
        fx=camera.fx / 2, fy=camera.fy / 2, cx=camera.cx / 2, cy=camera.cy / 2,
    )  # fmt: skip
    return replace(image, depth=depth, intrinsics=half), heads


def alone(image: DepthImage, heads: TrueHeads, rng: Rng) -> tuple[DepthImage, TrueHeads]:
    """Take away all that is not within 50 cm of the axis of a person, and the floor."""
    camera, far = image.intrinsics, _metres(image)
    v, u = np.indices(far.shape)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(far.shape)], axis=-1)
    points = transform(image.T_world_camera, (rays * far[..., None]).reshape(-1, 3))
    away = np.linalg.norm(points[:, None, :2] - heads.centres[None, :, :2], axis=2)
    kept = (away.min(axis=1, initial=np.inf) < PERSON_M) & (points[:, 2] > FLOOR_M)
    return replace(image, depth=np.where(kept.reshape(far.shape), image.depth, 0).astype(np.uint16)), heads


def bald_spots(image: DepthImage, heads: TrueHeads, rng: Rng) -> tuple[DepthImage, TrueHeads]:
    """Lose 85 % of the readings of the upper half of every head, as dark hair does."""
    camera, depth = image.intrinsics, image.depth.copy()
    v, u = np.indices(depth.shape)
    for x, y, z in transform(inverse(image.T_world_camera), heads.centres):
        column, row, radius = (
            x / z * camera.fx + camera.cx,
            y / z * camera.fy + camera.cy,
            0.12 * camera.fx / z,
        )
        upper = ((u - column) ** 2 + (v - row) ** 2 < radius**2) & (v < row)
        depth[upper & (rng.random(depth.shape) < 0.85)] = 0
    return replace(image, depth=depth), heads


def read_as(change: Callable[[F32, Rng], F32]) -> Way:
    """Change the readings, in metres."""

    def way(image: DepthImage, heads: TrueHeads, rng: Rng) -> tuple[DepthImage, TrueHeads]:
        far = _metres(image)
        steps = np.rint(np.where(far > 0, change(far, rng), 0.0) / image.intrinsics.depth_scale)
        return replace(image, depth=np.clip(steps, 0, 65535).astype(np.uint16)), heads

    return way


def noisier(share: float) -> Way:
    """Add white noise that grows with the square of the distance: ``share`` metres at 1 m."""
    return read_as(lambda far, rng: far + share * far**2 * rng.normal(size=far.shape).astype(np.float32))


def with_holes(share: float) -> Way:
    """Lose single readings."""
    return read_as(lambda far, rng: np.where(rng.random(far.shape) < share, 0.0, far).astype(np.float32))


def shadowed(pixels: int) -> Way:
    """Lose what is to the right of something nearer, as where a projector does not reach."""

    def change(far: F32, rng: Rng) -> F32:
        solid = np.where(far > 0, far, np.inf)
        nearest = np.min([np.roll(solid, k, axis=1) for k in range(1, pixels + 1)], axis=0)
        return np.where(nearest < far - BEHIND_M, 0.0, far).astype(np.float32)

    return read_as(change)


def fattened(pixels: int) -> Way:
    """Let what is near grow over what is behind it."""
    return read_as(lambda far, rng: minimum_filter(np.where(far > 0, far, np.inf), 2 * pixels + 1))


def smeared(pixels: int) -> Way:
    """Let readings at edges fly between what is near and what is behind, as those of time-of-flight cameras do."""

    def change(far: F32, rng: Rng) -> F32:
        near = minimum_filter(np.where(far > 0, far, np.inf), 2 * pixels + 1)
        behind = maximum_filter(far, 2 * pixels + 1)
        between = np.minimum(near, behind)
        between += (behind - between) * rng.random(far.shape).astype(np.float32)
        return np.where(near < behind - BEHIND_M, between, far).astype(np.float32)

    return read_as(change)


WAYS: dict[str, Way] = {
    "as they are": as_it_is,
    "mirrored": mirrored,
    **{f"stated pose turned by {d:+d}° about x": turned("x", d) for d in (-10, -5, 5, 10)},
    **{f"by {d:+d}° about y": turned("y", d) for d in (-10, -5, 5, 10)},
    **{f"raised by {m:+.1f} m": raised(m) for m in (-0.3, 0.3)},
    "every other column and row": coarser,
    "white noise, 2 mm at 1 m, 18 mm at 3 m": noisier(0.002),
    "white noise, 5 mm at 1 m, 45 mm at 3 m": noisier(0.005),
    "10 % of the readings lost": with_holes(0.1),
    "40 % of the readings lost": with_holes(0.4),
    "85 % lost on the upper half of heads": bald_spots,
    "shadows of 6 pixels beside edges": shadowed(6),
    "edges fattened by 1 pixel": fattened(1),
    "edges fattened by 2 pixels": fattened(2),
    "edges that fly, 1 pixel to either side": smeared(1),
    "edges that fly, 2 pixels to either side": smeared(2),
    "nothing beyond 4.5 m": read_as(lambda far, rng: np.where(far > 4.5, 0.0, far).astype(np.float32)),
    "background and floor removed": alone,
}


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one frame gave: errors (K,) of the heads found, metres; the lowest score of a head."""

    heads: int
    errors: F64
    false: int
    lowest: float


def outcome_of(frame: Frame, heads: TrueHeads, usual: Detector, thorough: Detector) -> Outcome:
    """Search a frame as always, and once more for the scores of heads that are not found so."""
    counted = ~(heads.ignored | heads.truncated)
    try:
        found, every = usual.detect_frame(frame), thorough.detect_frame(frame)
    except HeadvoxError:  # nothing is left in range
        return Outcome(int(counted.sum()), np.empty(0), 0, -np.inf if counted.any() else np.inf)
    told = match(found.centres, heads.centres, counted, Rules())
    pairs = match(every.centres, heads.centres, counted, Rules()).pairs
    scores = every.scores[pairs[:, 0]]
    lowest = scores.min(initial=np.inf) if len(pairs) == counted.sum() else -np.inf
    return Outcome(int(counted.sum()), told.distances, len(told.false), lowest)


def labelled(folders: list[Path]) -> Iterator[tuple[Frame, TrueHeads]]:
    """Yield every frame of one camera whose heads are known."""
    for folder in folders:
        truth = read_truth(folder / FILE)
        for frame in open_source(str(folder)):
            if isinstance(frame, Frame) and frame.stamp_ns in truth and len(frame.depths) == 1:
                yield frame, truth[frame.stamp_ns]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", type=Path, nargs="+")
    frames = list(labelled(parser.parse_args().recordings))
    if not frames:
        sys.exit("No frame of one depth camera with labels in there.")
    print("| frames | found | false a frame | mean error | lowest score |\n| --- | --- | --- | --- | --- |")
    settings = DetectorConfig(refine="sphere")
    with (
        closing(Detector(settings)) as usual,
        closing(Detector(replace(settings, min_score=LEAST))) as thorough,
    ):
        for name, way in WAYS.items():
            rng, outcomes = np.random.default_rng(0), []
            for frame, heads in frames:
                image, moved = way(frame.depths[0], heads, rng)
                outcomes.append(outcome_of(replace(frame, depths=(image,)), moved, usual, thorough))
            errors = np.concatenate([one.errors for one in outcomes])
            print(
                f"| {name} | {len(errors)} of {sum(one.heads for one in outcomes)} "
                f"| {sum(one.false for one in outcomes) / len(frames):.2f} | {100 * errors.mean():.1f} cm "
                f"| {min(one.lowest for one in outcomes):.1f} |",
                flush=True,
            )


def _metres(image: DepthImage) -> F32:
    return image.depth.astype(np.float32) * np.float32(image.intrinsics.depth_scale)


def _placed(image: DepthImage, heads: TrueHeads, T: F64) -> tuple[DepthImage, TrueHeads]:
    moved = replace(heads, centres=transform(T, heads.centres))
    return replace(image, T_world_camera=T @ image.T_world_camera), moved


if __name__ == "__main__":
    main()
