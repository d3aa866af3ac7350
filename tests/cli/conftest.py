from pathlib import Path

import pytest
from inputs import CASCADE, write_recording

from headvox.config import DetectorConfig
from headvox.warmup import warm_up


@pytest.fixture(scope="session", autouse=True)
def compiled_loops() -> None:
    """No run is the first: that one has more to say."""
    warm_up(DetectorConfig())


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("cli") / "three", 3)


@pytest.fixture(scope="session")
def anything(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cascade") / "anything.toml"
    path.write_text(CASCADE)
    return path
