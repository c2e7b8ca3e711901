"""Writing files so that each appears whole or not at all, and never over someone's work."""

from __future__ import annotations

import contextlib
import os
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path


@contextlib.contextmanager
def whole_file(path, *, overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside `path`; what is written there becomes `path` at the end.

    If the block fails, `path` stays as it was and the temporary file is removed.

    Args:
      path: the file wanted; missing folders are made.
      overwrite: an existing file is replaced only if this is true.

    Yields:
      The path to write to.

    Raises:
      ValueError: if the file exists and `overwrite` is false.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise ValueError(f"{path}: exists already; choose another name or pass overwrite=True")
    path.parent.mkdir(parents=True, exist_ok=True)
    # Unique among threads, and among machines that share the folder.
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def set_aside(paths: Iterable[Path], name: str) -> str | None:
    """Rename files that belong together to the first free number, so that none is overwritten.

    Args:
      paths: files whose names begin with `name`; those that do not exist are left out.
      name: what their names share.

    Returns:
      What the names begin with now, such as "quality.old1"; None if there was no file.
    """
    present = [path for path in paths if path.exists()]
    if not present:
        return None

    def aside(path: Path, number: int) -> Path:
        return path.with_name(f"{name}.old{number}{path.name.removeprefix(name)}")

    number = 1
    while any(aside(path, number).exists() for path in present):
        number += 1
    for path in present:
        path.rename(aside(path, number))
    return f"{name}.old{number}"
