from pathlib import Path

import pytest
from inputs import CASCADE, write_recording


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("cli") / "three", 3)


@pytest.fixture(scope="session")
def anything(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cascade") / "anything.toml"
    path.write_text(CASCADE)
    return path
