"""Files that are there whole or not at all."""

import pytest

from headvox.atomic import write_text


def test_what_stood_there_stays_until_all_is_written(tmp_path):
    path = tmp_path / "a.toml"
    write_text(path, "öld")
    assert path.read_bytes() == "öld".encode()
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "new \udc80")  # fails when a part may be on the disk
    assert path.read_text(encoding="utf-8") == "öld"
    write_text(path, "new")
    assert path.read_text(encoding="utf-8") == "new"
    assert [each.name for each in tmp_path.iterdir()] == ["a.toml"]


def test_a_folder_that_is_missing_is_an_error_of_the_system(tmp_path):
    with pytest.raises(FileNotFoundError):
        write_text(tmp_path / "none" / "a.toml", "text")
