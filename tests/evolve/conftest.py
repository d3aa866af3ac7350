import pytest
from easy_search import SMALL_JUDGE, SMALL_SEARCH, easy_view

from headvox.evolve import boost, gates, samples, search, views


@pytest.fixture(scope="session")
def real_view() -> views.View:
    return views.make_view(3, 9)


@pytest.fixture(scope="session")
def evolved(tmp_path_factory):
    """A whole search on easy views."""
    folder = tmp_path_factory.mktemp("evolve")
    patch = pytest.MonkeyPatch()
    patch.setattr(search, "keep_view", easy_view)
    patch.setattr(gates, "GENERATIONS", 40)
    patch.setattr(boost, "SEARCH", SMALL_SEARCH)
    patch.setattr(boost, "JUDGE", SMALL_JUDGE)
    said: list[str] = []
    patch.setattr(samples, "RANGE_M", 2.8)
    try:
        found = search.evolve(search.Settings(folder, 200, "easy", rounds=2), said.append)
    finally:
        patch.undo()
    return folder, found, said
