"""Two heads on shoulders as detectors of small regions see them, and the bytes of what these find."""

from dataclasses import replace

import numpy as np
import scenes

from headvox import Cloud, Frame, Heads

SMALL = {
    "max_range_m": 0.7,
    "min_height_m": -0.5,
    "max_height_m": 0.5,
    "centre": (0.0, 0.0, 0.0),
    "refine": "sphere",
}
NARROW = {"max_range_m": 0.45, "min_height_m": -0.25, "max_height_m": 0.35}


def everything(heads: Heads) -> tuple[bytes, ...]:
    return tuple(a.tobytes() for a in (heads.centres, heads.quaternions, heads.radii, heads.scores))


def two_busts(seed=0):
    rng = np.random.default_rng(seed)
    return np.concatenate(
        [scenes.bust(rng, (-0.25, -0.2, 0.1), 400), scenes.bust(rng, (0.25, 0.25, 0.15), 400)]
    )


def camera_and_cloud():
    """A camera without any return on its right, where a cloud has a bust; another bust is in both."""
    frame = camera_frame(1)
    image = frame.depths[0]
    depth = image.depth.copy()
    depth[:, depth.shape[1] // 2 :] = 0
    rng = np.random.default_rng(0)
    cloud = np.concatenate(
        [scenes.bust(rng, (-0.2, 0.25, 0.1), 100), scenes.bust(rng, (-0.2, -0.2, 0.1), 100)]
    )
    return Frame(0, clouds=(Cloud("c", cloud),), depths=(replace(image, depth=depth),))


def camera_frame(seed=0, count=1):
    rng = np.random.default_rng(seed)
    spheres = [(0.1, -0.15, 0.1, 0.1), (0.1, -0.15, -0.2, 0.17), (0.3, 0.25, 0.15, 0.1)]
    places = [scenes.looking_along_x(-0.9, 0.0, 0.1), scenes.looking_along_x(-0.8, 0.3, 0.2)]
    images = [
        scenes.image_of_spheres(rng, T, spheres, 1.7, name=f"c{k}") for k, T in enumerate(places[:count])
    ]
    return Frame(0, depths=tuple(images))
