"""What keeps a file from being written is told before, and nothing changes by asking."""

import os
from pathlib import Path

import pytest

from headvox.errors import HeadvoxError
from headvox.writable import check_file, make_folder


def test_asking_leaves_everything_as_it_is(tmp_path):
    (tmp_path / "there.csv").write_text("old")
    (tmp_path / "link.csv").symlink_to(tmp_path / "nothing.csv")
    before = sorted(tmp_path.iterdir())
    for name in ("there.csv", "link.csv", "new.csv"):
        check_file(tmp_path / name)
    assert sorted(tmp_path.iterdir()) == before
    assert (tmp_path / "there.csv").read_text() == "old"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_pipe_is_left_to_who_writes_into_it(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    check_file(tmp_path / "pipe.csv")


@pytest.mark.parametrize("name", ["none/a.csv", "file/a.csv", "folder", "a" * 300])
def test_what_cannot_be_written_is_named_as_it_was_given(tmp_path, name):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    with pytest.raises(HeadvoxError, match=f"^Output {tmp_path / name}: [^/]*$"):
        check_file(tmp_path / name)


def test_a_folder_is_made_with_those_that_it_lies_in_and_nothing_in_it(tmp_path):
    for _ in range(2):
        make_folder(tmp_path / "a" / "b")
    assert list(tmp_path.rglob("*")) == [tmp_path / "a", tmp_path / "a" / "b"]


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="/proc exists on Linux only")
@pytest.mark.parametrize("folder", ["/proc", "/proc/new"])
def test_a_folder_that_takes_no_files_is_named_as_it_was_given(folder):
    with pytest.raises(HeadvoxError, match=r"^Output mine: [^/]*$"):
        make_folder(Path(folder), Path("mine"))
