"""A file is the old one or the new one, whatever happens in between."""

import os
import stat

import pytest

from lagros_envs.files import write_atomic


def test_text_and_bytes_are_written_into_a_new_folder(tmp_path):
    path = tmp_path / "a" / "b.txt"
    assert write_atomic(path, "θ\n") == path
    assert path.read_bytes() == "θ\n".encode()
    assert write_atomic(str(path), b"\x00\xff") == path
    assert path.read_bytes() == b"\x00\xff"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_failure_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, call):
    path = write_atomic(tmp_path / "file", "old")

    def fail(*arguments):
        # Until the very end the old file is whole.
        assert path.read_text() == "old"
        raise OSError("disk full")

    monkeypatch.setattr(os, call, fail)
    with pytest.raises(OSError, match="disk full"):
        write_atomic(path, "new and longer")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_file_may_be_read_as_any_other(tmp_path):
    plain = tmp_path / "plain"
    plain.write_text("x")
    path = write_atomic(tmp_path / "file", "x")
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)
