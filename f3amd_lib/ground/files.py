"""Writing files so that each appears whole or not at all, and never over someone's work."""

import contextlib
import itertools
import os
import shutil
import time
import tomllib
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows: no locks of this kind
    fcntl = None

_LEFTOVER_S = 3600.0
"""Age from which an unfinished file belongs to a process that was killed."""


def read_toml(path) -> dict:
    """Return what a TOML file holds."""
    return tomllib.loads(Path(path).read_text(encoding="utf-8"))


@contextlib.contextmanager
def whole_file(path, *, overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside `path`; what is written there becomes `path` at the end.

    If the block fails, `path` stays as it was and the temporary file is removed. The file gets the
    permissions that the user's umask says, whoever wrote it.

    Args:
      path: the file wanted; missing folders are made.
      overwrite: an existing file is replaced only if this is true.

    Raises:
      ValueError: if the file exists and `overwrite` is false.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise ValueError(f"{path}: exists already; choose another name or pass overwrite=True")
    with _unfinished(path) as temporary:
        temporary.touch()
        permissions = temporary.stat().st_mode
        yield temporary
        temporary.chmod(permissions)  # safetensors makes a new file that the owner alone may read


def named_file(path, ending: str, what: str) -> Path:
    """Return a path; ValueError unless its name ends as files of a kind do: `what`, such as "figures"."""
    path = Path(path)
    if path.suffix != ending:
        raise ValueError(f"{path}: {what} are written as {ending}")
    return path


def write_whole(path, content: str | bytes, *, overwrite: bool = True) -> Path:
    """Write a file by `whole_file`, text as UTF-8 with the line ends that it has; return its path."""
    with whole_file(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))
    return Path(path)


@contextlib.contextmanager
def _unfinished(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; what is there at the end becomes `path`, or is removed on an error.

    Says which file could not be written, where the system's own error, such as that of a full disk, does not.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    for old in path.parent.glob(f".{path.name}.*.part"):
        with contextlib.suppress(OSError):  # another process may be faster
            if time.time() - old.stat().st_mtime > _LEFTOVER_S:
                _remove(old)
    # Unique among threads, and among machines that share the folder.
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename is None and str(path) not in str(error):
            raise OSError(f"{path}: cannot be written ({error})") from error
        raise
    finally:
        _remove(temporary)


def _remove(path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


@contextlib.contextmanager
def whole_folder(path) -> Iterator[Path]:
    """Yield a temporary folder beside `path`, which becomes `path` at the end; if the block fails, it is removed.

    Args:
      path: the folder wanted, which must be not there or empty but for hidden files, which are kept; missing
        folders above it are made.

    Raises:
      OSError: if something has appeared at `path` meanwhile.
    """
    with _unfinished(path := Path(path).resolve()) as temporary:
        temporary.mkdir()
        yield temporary
        for hidden in path.glob(".*"):  # such as .DS_Store in a folder that looks empty
            os.replace(hidden, temporary / hidden.name)


def check_own_folder(folder: Path, mark: str = "") -> None:
    """Raise ValueError if a folder holds something, hidden files apart, unless the file `mark` says that it is ours."""
    if not (mark and (folder / mark).is_file()) and (folder.is_file() or any(folder.glob("[!.]*"))):
        raise ValueError(f"{folder}: holds other files; choose an empty folder")


@contextlib.contextmanager
def locked(path, doing: str, *, wait: bool = False) -> Iterator[None]:
    """Hold a lock file while the block runs, so that no second process does the same work there.

    The operating system frees the lock of a process that was killed. Where a file system (or Windows)
    has no such locks, the block runs without one.

    Args:
      path: of the lock file; missing folders are made.
      doing: what the block does, for the message, such as "training F3AMD-FNO-96".
      wait: until whoever holds the lock has finished.

    Raises:
      ValueError: if another process holds the lock, unless it is waited for.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        file = path.open("a")
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            if path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat()):
                break
        except BlockingIOError:
            file.close()
            raise ValueError(f"{path.parent}: another process is {doing} there; wait until it has finished") from None
        except OSError:  # a file system without locks
            break
        file.close()  # whoever held the lock has removed its file: ours is another one
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        file.close()


def set_aside(paths: Iterable[Path], name: str) -> str | None:
    """Rename files that belong together to the first free number, so that none is overwritten.

    Args:
      paths: files whose names begin with `name`; those that do not exist are left out.
      name: what their names share.

    Returns:
      What the names begin with now, such as "quality.old1"; None if there was no file.
    """
    present = [path for path in paths if path.exists()]
    for number in itertools.count(1):
        aside = [path.with_name(f"{name}.old{number}{path.name.removeprefix(name)}") for path in present]
        if not any(path.exists() for path in aside):
            break
    for path, other in zip(present, aside, strict=True):
        path.rename(other)
    return f"{name}.old{number}" if present else None
