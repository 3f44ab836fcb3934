"""A file is the old one or the new one, and what is no regular file is never replaced."""

import errno
import os
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import pytest

from lagros_envs import files
from lagros_envs.files import check_writable, remove_folders, write_atomic

ROOT = os.geteuid() == 0


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


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o666, 0o755])
def test_an_existing_file_keeps_its_mode(tmp_path, mode):
    path = tmp_path / "file"
    path.write_text("old")
    path.chmod(mode)
    write_atomic(path, "new")
    assert stat.S_IMODE(path.stat().st_mode) == mode
    assert path.read_text() == "new"


@pytest.mark.skipif(not ROOT, reason="only root may give files away")
def test_an_existing_file_keeps_its_owner(tmp_path):
    path = tmp_path / "file"
    path.write_text("old")
    os.chown(path, 1234, 2345)
    write_atomic(path, "new")
    assert (path.stat().st_uid, path.stat().st_gid) == (1234, 2345)


@pytest.mark.parametrize("hops", [1, 3])
def test_a_link_stays_and_its_target_is_written(tmp_path, hops):
    target = tmp_path / "elsewhere" / "target"
    target.parent.mkdir()
    target.write_text("old")
    link = target
    for hop in range(hops):
        path = tmp_path / f"link{hop}"
        path.symlink_to(os.path.relpath(link, tmp_path))
        link = path
    write_atomic(link, "new")
    assert link.is_symlink()
    assert target.read_text() == "new"
    assert os.listdir(target.parent) == ["target"]


def test_a_link_to_nothing_makes_what_it_names(tmp_path):
    link = tmp_path / "link"
    link.symlink_to("new/target")
    assert check_writable(link).made == (tmp_path / "new",)
    write_atomic(link, "x")
    assert link.is_symlink()
    assert (tmp_path / "new" / "target").read_text() == "x"
    (tmp_path / "ring").symlink_to("ring")
    for call in (check_writable, lambda path: write_atomic(path, "x")):
        with pytest.raises(OSError, match="symbolic links"):
            call(tmp_path / "ring")


def test_a_pipe_is_written_into_and_stays(tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    assert check_writable(path).place is None
    found = []
    reader = threading.Thread(target=lambda: found.append(path.read_bytes()))
    reader.start()
    write_atomic(path, "x" * 200_000)  # more than a pipe holds
    reader.join()
    assert found == [b"x" * 200_000]
    assert stat.S_ISFIFO(path.stat().st_mode)


def test_a_pipe_that_nobody_reads_is_given_up(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "_PATIENCE", 0.05)
    path = tmp_path / "pipe"
    os.mkfifo(path)
    with pytest.raises(OSError, match="nobody reads"):
        write_atomic(path, "x")


@pytest.mark.skipif(not ROOT, reason="only root may make devices")
def test_a_device_is_written_into_and_stays(tmp_path):
    # Nodes of our own, with the numbers of /dev/null and /dev/full.
    null, full = tmp_path / "null", tmp_path / "full"
    try:
        os.mknod(null, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
        os.mknod(full, 0o666 | stat.S_IFCHR, os.makedev(1, 7))
        write_atomic(null, "x")
    except PermissionError:
        pytest.skip("no devices can be made here")
    assert check_writable(null).place is None
    with pytest.raises(OSError, match="No space left"):
        write_atomic(full, "x")
    assert all(stat.S_ISCHR(path.stat().st_mode) for path in (null, full))
    link = tmp_path / "link"
    link.symlink_to("null")
    write_atomic(link, "x")
    assert link.is_symlink()
    assert sorted(os.listdir(tmp_path)) == ["full", "link", "null"]


def test_a_folder_and_a_socket_are_refused(tmp_path):
    bound = tmp_path / "socket"
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(bound))
        for path, message in ((tmp_path, "folder"), (bound, "socket")):
            for call in (check_writable, lambda path: write_atomic(path, "x")):
                with pytest.raises(OSError, match=message):
                    call(path)
    assert stat.S_ISSOCK(bound.stat().st_mode)


@pytest.mark.parametrize("how", ["/dev/stdout", "/dev/fd/1", "/proc/self/fd/1", "own", "pipe"])
def test_the_own_output_is_written_to_where_it_stands(tmp_path, how):
    out = tmp_path / "out.txt"
    name = {"own": str(out), "pipe": "/dev/stdout"}.get(how, how)
    code = (
        "from lagros_envs.files import check_writable, write_atomic\n"
        f"print('before'); check_writable({name!r}); write_atomic({name!r}, 'x\\n')\n"
        "print('after')\n"
    )
    if how == "pipe":
        text = subprocess.run(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=True
        ).stdout
    else:
        with out.open("w") as stream:
            subprocess.run([sys.executable, "-c", code], stdout=stream, check=True)
        text = out.read_text()
    assert text == "before\nx\nafter\n"


def as_another(call, *arguments):
    """Call a function of the module as a user who is not root; return the errno of its error."""
    # The imports come first: nobody else may be able to read where this lies.
    code = (
        "import os, sys\nfrom lagros_envs import files\n"
        "if os.geteuid() == 0:\n"
        "    os.setgroups([]); os.setgid(65534); os.setuid(65534)\n"
        "try:\n    getattr(files, sys.argv[1])(*sys.argv[2:])\n"
        "except OSError as error:\n    sys.exit(error.errno)\n"
    )
    command = [sys.executable, "-c", code, call, *map(str, arguments)]
    return subprocess.run(command, check=False).returncode


@pytest.fixture
def reachable(tmp_path):
    """A folder that another user may reach, with a file that he may write."""
    for folder in (tmp_path, *tmp_path.parents):
        if folder == Path(tempfile.gettempdir()):
            break
        folder.chmod(0o755)
    place = tmp_path / "folder"
    place.mkdir(mode=0o755)
    path = place / "file"
    path.write_text("old and longer than the new")
    path.chmod(0o666)
    place.chmod(0o555)
    yield place
    place.chmod(0o755)


def test_a_file_in_a_folder_that_takes_no_new_one_is_overwritten(reachable):
    path = reachable / "file"
    assert as_another("check_writable", path) == 0
    assert as_another("write_atomic", path, "new") == 0
    assert path.read_text() == "new"
    new = reachable / "another"
    assert as_another("check_writable", new) == errno.EACCES
    assert as_another("write_atomic", new, "new") == errno.EACCES
    assert [one.name for one in reachable.iterdir()] == ["file"]


def test_a_file_that_may_not_be_written_is_not_replaced(reachable):
    path = reachable / "file"
    reachable.chmod(0o777)
    path.chmod(0o444)
    assert as_another("check_writable", path) == errno.EACCES
    assert as_another("write_atomic", path, "new") == errno.EACCES
    assert path.read_text().startswith("old")


@pytest.mark.parametrize(
    "name",
    ["x" * 255, "θ" * 127, "a\nb", "🚀.json", os.fsdecode(b"\xff\xfe.json"), " ", "-", "a'b\"$c"],
)
def test_any_name_that_the_system_takes(tmp_path, name):
    path = tmp_path / name
    check_writable(path)
    write_atomic(path, "x")
    assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize("name", ["x" * 256, "a\0b"])
def test_a_name_that_the_system_does_not_take(tmp_path, name):
    for call in (check_writable, lambda path: write_atomic(path, "x")):
        with pytest.raises(OSError, match=r"too long|null"):
            call(tmp_path / name)


def test_text_that_is_no_unicode_is_escaped(tmp_path):
    path = write_atomic(tmp_path / "x", os.fsdecode(b"a\xff"))
    assert path.read_bytes() == b"a\\udcff"


def test_what_killed_writes_left_is_removed_and_nothing_else(tmp_path):
    code = (
        "import os, signal, sys\nfrom lagros_envs import files\n"
        "files.os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)\n"
        "files.write_atomic(sys.argv[1], 'half')\n"
    )
    path = tmp_path / "file"
    killed = subprocess.run([sys.executable, "-c", code, str(path)], check=False)
    assert killed.returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    dead = files._TEMPORARY.fullmatch(left.name)["pid"]
    stays = [f".{dead}.tmp", f".another.{dead}.tmp", f".file.{os.getpid()}.tmp", "file.tmp"]
    goes = [left.name, f".file.{dead}.tmp"]
    for name in (*stays, *goes):
        (tmp_path / name).touch()
    write_atomic(tmp_path / "file", "new")
    assert sorted(os.listdir(tmp_path)) == sorted(["file", *stays])


def test_a_temporary_file_that_somebody_has_locked_stays(tmp_path, monkeypatch):
    # As on a shared disk, where its process belongs to another machine.
    monkeypatch.setattr(files, "is_alive", lambda pid: False)
    temporary, descriptor = files._open_temporary(tmp_path / "file")
    write_atomic(tmp_path / "file", "x")
    assert temporary.exists()
    os.close(descriptor)
    write_atomic(tmp_path / "file", "x")
    assert os.listdir(tmp_path) == ["file"]


def test_many_writers_of_one_file_leave_one_whole(tmp_path):
    path = tmp_path / "file"
    texts = [str(number) * 10_000 for number in range(8)]
    threads = [threading.Thread(target=write_atomic, args=(path, text)) for text in texts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert path.read_text() in texts
    assert list(tmp_path.iterdir()) == [path]


def test_places_are_equal_where_files_are(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to("folder")
    (tmp_path / "here").write_text("x")
    (tmp_path / "hard").hardlink_to(tmp_path / "here")
    place = {
        name: check_writable(tmp_path / name).place
        for name in ("folder/a", "link/a", "folder/../folder/a", "folder/b", "here", "hard", "a")
    }
    assert place["folder/a"] == place["link/a"] == place["folder/../folder/a"]
    assert place["here"] == place["hard"]
    assert len(set(place.values())) == 4
    assert sorted(os.listdir(tmp_path / "folder")) == []


def test_folders_that_were_made_for_nothing_go_again(tmp_path):
    made = check_writable(tmp_path / "a" / "b" / "c").made
    assert made == (tmp_path / "a", tmp_path / "a" / "b")
    remove_folders(made)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("x")
    with pytest.raises(OSError, match="its folder is a file"):
        check_writable(tmp_path / "file" / "x")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert Path(tmp_path / "file").read_text() == "x"
