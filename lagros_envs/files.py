"""Files are written whole or not at all, and nothing but a regular file is ever replaced."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
import secrets
import stat
import sys
import time
from dataclasses import dataclass
from pathlib import Path

if sys.platform != "win32":
    import fcntl

# A folder, or a file that something is mounted on, that takes no new name.
_REFUSED = {errno.EACCES, errno.EPERM, errno.EROFS, errno.EBUSY, errno.EXDEV}
# Of a temporary file: the name that it will get, the process that writes it, and our mark.
_TEMPORARY = re.compile(r"\.(?P<name>.+)\.(?P<pid>\d{1,10})(?P<mark>\.[0-9a-f]{8}\.lagros)?\.tmp")
# Longer names are shortened, so that there is room for the rest [bytes].
_LONGEST_NAME = 120
# How long a pipe may wait for somebody who reads it [s].
_PATIENCE = 10.0
_DESCRIPTORS = re.compile(r"/dev/fd|/proc/(self|\d+)(/task/\d+)?/fd")


def write_atomic(path: str | Path, data: str | bytes) -> Path:
    """Write a file under a temporary name beside it, then rename.

    A reader, or a run that is killed, sees the old file or the new one and never half of one. A
    link stays, and what it points to is written; an existing file keeps its mode, and its owner
    where the system allows it. What is not a regular file is written into and stays what it is: a
    pipe, a character device, /dev/stdout. Only where a file may be written but its folder takes no
    new one is it overwritten in its place. What killed processes left behind is removed.

    Args:
        path: The file; its folder is made if need be.
        data: Text (written as UTF-8, with what UTF-8 lacks escaped as in JSON) or bytes.

    Raises:
        OSError: It cannot be written, or is a folder, a socket or a block device.
    """
    given = Path(path)
    content = data.encode(errors="backslashreplace") if isinstance(data, str) else data
    try:
        _write(given, content)
    except OSError as error:
        if error.errno is None or error.filename is not None:
            raise
        # What fails on an open file does not say on which.
        raise OSError(error.errno, error.strerror, str(given)) from error
    return given


@dataclass(frozen=True)
class Writable:
    """A path that can be written.

    Attributes:
        place: Equal for two paths of one file; None for what takes more than one output, a pipe
            for instance.
        made: Folders that were made for it, outermost first.
    """

    place: tuple[object, ...] | None
    made: tuple[Path, ...] = ()


def check_writable(path: str | Path) -> Writable:
    """Check by trying that `write_atomic` will be able to write a file, and make its folder.

    Raises:
        OSError: It cannot, or is a folder, a socket or a block device.
    """
    given = Path(path)
    status = _status(given)
    descriptor = _own_descriptor(given, status)
    if descriptor is not None:
        _check_descriptor(descriptor, given)
        return Writable(None)
    if status is not None and not stat.S_ISREG(status.st_mode):
        _special(given, status)
        _check_access(given)
        return Writable(None)
    target = Path(os.path.realpath(given))
    if status is not None:
        _check_access(target)
    made = _make_folder(target.parent)
    try:
        temporary, one = _open_temporary(target)
    except OSError as error:
        if status is not None and error.errno in _REFUSED:
            return Writable((status.st_dev, status.st_ino))
        remove_folders(made)
        raise
    os.close(one)
    ignores_case = temporary.with_name(temporary.name.upper()).exists()
    temporary.unlink()
    if status is not None:
        return Writable((status.st_dev, status.st_ino), made)
    folder = target.parent.stat()
    name = target.name.casefold() if ignores_case else target.name
    return Writable((folder.st_dev, folder.st_ino, name), made)


def remove_folders(folders: tuple[Path, ...]) -> None:
    """Remove folders that were made for nothing, unless something is in them by now."""
    for folder in reversed(folders):
        with contextlib.suppress(OSError):
            folder.rmdir()


def _write(given: Path, content: bytes) -> None:
    status = _status(given)
    descriptor = _own_descriptor(given, status)
    if descriptor is not None:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
        _write_all(descriptor, content)
    elif status is None or stat.S_ISREG(status.st_mode):
        _replace(Path(os.path.realpath(given)), content, status)
    else:
        _write_into(given, content, _special(given, status))


def _status(path: Path) -> os.stat_result | None:
    try:
        return path.stat()
    except FileNotFoundError:
        return None
    except NotADirectoryError as error:
        raise _no_folder(path) from error
    except ValueError as error:  # a null byte
        raise OSError(errno.EINVAL, str(error), str(path)) from error


def _no_folder(path: Path) -> NotADirectoryError:
    return NotADirectoryError(errno.ENOTDIR, "its folder is a file", str(path))


def _own_descriptor(path: Path, status: os.stat_result | None) -> int | None:
    """Return the open file of this process that the path stands for, /dev/stdout for instance.

    That it is a regular file, because the shell redirects it, does not make it one to be replaced.
    """
    if status is not None and stat.S_ISREG(status.st_mode):
        for descriptor in (1, 2):
            with contextlib.suppress(OSError):
                if os.path.samestat(status, os.fstat(descriptor)):
                    return descriptor
    for _ in range(40):  # as many links as the system follows
        folder = os.path.realpath(path.parent)
        if path.name.isdecimal() and _DESCRIPTORS.fullmatch(folder):
            own = folder.startswith(("/dev", f"/proc/{os.getpid()}/", "/proc/self/"))
            return int(path.name) if own else None
        if not path.is_symlink():
            return None
        path = Path(folder) / path.readlink()
    return None


def _check_descriptor(descriptor: int, path: Path) -> None:
    os.fstat(descriptor)
    if sys.platform != "win32":
        mode = fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE
        if mode == os.O_RDONLY:
            raise OSError(errno.EBADF, "it is open for reading only", str(path))


def _special(path: Path, status: os.stat_result) -> bool:
    """Return whether what is no regular file is a pipe; refuse what takes no text."""
    mode = status.st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "it is a folder", str(path))
    if stat.S_ISFIFO(mode) or stat.S_ISCHR(mode):
        return stat.S_ISFIFO(mode)
    kind = "block device" if stat.S_ISBLK(mode) else "socket"
    raise OSError(errno.EINVAL, f"it is a {kind}", str(path))


def _check_access(path: Path) -> None:
    if not os.access(path, os.W_OK):
        # Why it is not, the system says only to who opens it.
        os.close(os.open(path, os.O_WRONLY | os.O_NONBLOCK))


def _make_folder(folder: Path) -> tuple[Path, ...]:
    """Make a folder with those above it, and return what was made."""
    missing = []
    for one in (folder, *folder.parents):
        if one.exists():
            break
        missing.append(one)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise _no_folder(folder) from error
    return tuple(reversed(missing))


def _replace(target: Path, content: bytes, status: os.stat_result | None) -> None:
    if status is not None:
        _check_access(target)
    _make_folder(target.parent)
    _remove_stale(target)
    temporary: Path | None = None
    try:
        temporary, descriptor = _open_temporary(target, 0o666 if status is None else 0o600)
        try:
            _write_all(descriptor, content)
            os.fsync(descriptor)
            if status is not None:
                _keep_rights(temporary, status)
            os.replace(temporary, target)
        finally:
            os.close(descriptor)
    except OSError as error:
        if status is None or error.errno not in _REFUSED:
            raise
        _overwrite(target, content)
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def _open_temporary(target: Path, mode: int = 0o600) -> tuple[Path, int]:
    """Open a new file beside the target, locked while it is open."""
    name = target.name
    if len(os.fsencode(name)) > _LONGEST_NAME:
        name = hashlib.sha256(os.fsencode(name)).hexdigest()[:16]
    path = target.with_name(f".{name}.{os.getpid()}.{secrets.token_hex(4)}.lagros.tmp")
    # Not tempfile, whose files nobody else may read.
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    _lock(descriptor)
    return path, descriptor


def _lock(descriptor: int) -> bool:
    """Lock an open file, unless somebody has; a lock ends with its process, even a killed one."""
    if sys.platform == "win32":
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _remove_stale(target: Path) -> None:
    """Remove temporary files of processes that are no more; those of others may be at work."""
    with contextlib.suppress(OSError), os.scandir(target.parent) as entries:
        for entry in entries:
            found = _TEMPORARY.fullmatch(entry.name)
            if found is None or not entry.is_file(follow_symlinks=False):
                continue
            ours = found["mark"] is not None or found["name"] == target.name
            if ours and not is_alive(int(found["pid"])) and _is_free(entry.path):
                with contextlib.suppress(OSError):
                    os.unlink(entry.path)


def is_alive(pid: int) -> bool:
    """Return whether a process of this machine is at work."""
    if sys.platform == "win32":
        return True
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        pass
    return True


def _is_free(path: str) -> bool:
    """Return whether no process has a file locked, not on another machine either."""
    try:
        descriptor = os.open(path, os.O_RDWR)
    except OSError:
        return False
    try:
        return _lock(descriptor)
    finally:
        os.close(descriptor)


def _keep_rights(path: Path, status: os.stat_result) -> None:
    """Give a file the owner and the mode of the one that it replaces."""
    with contextlib.suppress(OSError, AttributeError):
        os.chown(path, status.st_uid, status.st_gid)
    path.chmod(stat.S_IMODE(status.st_mode))


def _overwrite(target: Path, content: bytes) -> None:
    descriptor = os.open(target, os.O_WRONLY)
    try:
        _write_all(descriptor, content)
        os.ftruncate(descriptor, len(content))
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _write_into(path: Path, content: bytes, is_pipe: bool) -> None:
    descriptor = _open_pipe(path) if is_pipe else os.open(path, os.O_WRONLY | os.O_NOCTTY)
    try:
        _write_all(descriptor, content)
    finally:
        os.close(descriptor)


def _open_pipe(path: Path) -> int:
    """Open a pipe as soon as somebody reads it: opened plainly it would wait for ever."""
    begun = time.monotonic()
    while True:
        try:
            descriptor = os.open(path, os.O_WRONLY | os.O_NONBLOCK)
        except OSError as error:
            if error.errno != errno.ENXIO:
                raise
            if time.monotonic() - begun > _PATIENCE:
                raise OSError(errno.ENXIO, "nobody reads this pipe", str(path)) from error
            time.sleep(0.02)
        else:
            os.set_blocking(descriptor, True)
            return descriptor


def _write_all(descriptor: int, content: bytes) -> None:
    view = memoryview(content)
    while view:
        view = view[os.write(descriptor, view) :]
