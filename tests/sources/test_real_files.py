"""Real files, where a checkout has them beside it."""

from pathlib import Path

import numpy as np
import pytest

from headvox.data import Frame
from headvox.sources import open_source
from headvox.sources.cloudfile import read_cloud_file
from headvox.sources.describe import describe

DATA = Path(__file__).parents[2].parent / "shared" / "data"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="no shared/data beside the checkout")

BODIES = {  # vertices, faces, extra properties
    "001_male.ply": (66246, 44131, 6),
    "001_male_expert.ply": (50644, 30085, 6),
    "001_male_hard.ply": (66246, 44131, 6),
    "male.ply": (9306, 7973, 33),
}


@pytest.mark.parametrize("file", BODIES)
def test_the_bodies_of_the_paper(file):
    cloud = read_cloud_file(DATA / "paper_clouds" / file)
    assert (cloud.vertices, cloud.faces, len(cloud.extra)) == BODIES[file]
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    assert 1.3 < high[2] - low[2] < 1.9  # a person
    assert abs(low[2]) < 0.01
    assert len(cloud.points) > cloud.vertices
    assert cloud.points.tobytes() == read_cloud_file(DATA / "paper_clouds" / file).points.tobytes()


@pytest.mark.parametrize(("name", "frames"), [("filinha", 108), ("chocapics", 22), ("five_people", 1)])
def test_the_recordings(name, frames):
    source = open_source(DATA / "recordings" / name)
    assert source.length == frames
    stamps = []
    for frame in source:
        assert isinstance(frame, Frame)
        (image,) = frame.depths
        assert image.depth.shape == (480, 640)
        assert np.count_nonzero(image.depth) > 100_000
        assert 400 < np.median(image.depth[image.depth > 0]) < 8000  # millimetres: bytes in the right order
        stamps.append(frame.stamp_ns)
    assert len(stamps) == frames
    assert stamps == sorted(set(stamps))


def test_the_description_of_a_recording():
    rows = dict(describe(DATA / "recordings" / "filinha"))
    assert rows["frames"] == "108"
    assert rows["duration"] == "53.50 s"
    assert rows["camera cam"] == (
        "640x480, 108 images, 2.0 fps, 2.35 m above the floor at x 0.00 y 0.00 m, tilted 27.0° down"
    )
