import pytest
import scenes
from busts import SMALL

from headvox import Detector
from headvox.config import DetectorConfig


@pytest.fixture(scope="session")
def cascades(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cascades")
    (folder / "stages.toml").write_text(scenes.STAGES, encoding="utf-8")
    fourth = scenes.STAGES.replace("min_score =", 'candidates = "every fourth"\nmin_score =', 1)
    (folder / "fourth.toml").write_text(fourth, encoding="utf-8")
    (folder / "votes.toml").write_text(scenes.VOTES, encoding="utf-8")
    names = ("stages", "fourth", "votes")
    return {name: str(folder / f"{name}.toml") for name in names}


@pytest.fixture
def make(cascades):
    """Return a function that makes a detector, and end its threads afterwards."""
    made = []

    def make(cascade="stages", **settings):
        made.append(Detector(DetectorConfig(cascade=cascades.get(cascade, cascade), **{**SMALL, **settings})))
        return made[-1]

    yield make
    for detector in made:
        detector.close()
