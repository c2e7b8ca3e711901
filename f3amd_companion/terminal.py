"""The command line before and around JAX: cheap checks, plain progress, Ctrl-C."""

import functools
import logging
import os
import signal
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

from f3amd_lib.ground import log
from f3amd_lib.ground.profiles import PRETRAINED_DIR, load_profile, runs_dir


def set_environment() -> None:
    """Set defaults of matplotlib and JAX before they are loaded, unless the user has set them."""
    os.environ.setdefault("MPLBACKEND", "Agg")
    # By default JAX multiplies in tf32 on a GPU, with 10 bits of mantissa.
    os.environ.setdefault("JAX_DEFAULT_MATMUL_PRECISION", "float32")
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(cache, "f3amd/jax").expanduser()))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
    # A program that the cache cannot give or take is compiled, as on the first day.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache entry")


def check_there(*files: Path | str | None) -> None:
    """Raise ValueError if one of the given files does not exist."""
    for file in files:
        if file is not None and not Path(file).exists():
            raise ValueError(f"{file}: no such file or folder")


def check_writable(*targets: Path) -> None:
    """Raise ValueError if one of the files or folders cannot be created."""
    for target in targets:
        inside = target if target.is_file() else target / "a file"
        folder = next(folder for folder in inside.absolute().parents if folder.exists())
        try:
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError as error:
            raise ValueError(f"{folder}: cannot be written to ({error.strerror}); pass another --out") from None


def check_free(targets: Sequence[Path], overwrite: bool) -> None:
    """Raise ValueError if one of the files cannot be created, or exists and may not be replaced."""
    taken = [str(target) for target in targets if target.exists()]
    if taken and not overwrite:
        raise ValueError(f"{', '.join(taken)}: exists already; pass --overwrite or another --out")
    check_writable(*targets)


def show_plainly(quiet: bool) -> None:
    """Show progress as plain lines, one every ten seconds, where there is no terminal; none if quiet."""
    log.setLevel(logging.WARNING if quiet else logging.INFO)
    if quiet or sys.stderr is None or not sys.stderr.isatty():
        from tqdm import tqdm

        tqdm.__init__ = functools.partialmethod(getattr(tqdm.__init__, "func", tqdm.__init__), file=Lines(quiet))


def raise_again(handler: logging.Handler, record: logging.LogRecord) -> None:
    """Raise what went wrong in writing a line, such as a full disk, instead of printing a traceback."""
    raise


class Lines:
    """A stream for tqdm that prints the state of a bar every ten seconds, and the last one."""

    def __init__(self, quiet: bool):
        self.quiet, self.line, self.shown, self.due = quiet, "", "", 0.0

    def write(self, text: str) -> None:
        self.line = text.strip() or self.line
        if (text == "\n" or time.monotonic() >= self.due) and self.line != self.shown and not self.quiet:
            print(self.line, file=sys.stderr, flush=True)
            self.shown, self.due = self.line, time.monotonic() + 10.0

    def flush(self) -> None:
        pass

    def isatty(self) -> bool:
        return False


def leave(says: str) -> None:
    """Exit with status 130 at once: a normal exit can crash JAX's threads."""
    print(f"\n{says}", file=sys.stderr, flush=True)
    os._exit(130)


def leave_at_once(says: str) -> None:
    """End on Ctrl-C without a KeyboardInterrupt, which can be a crash while libraries are loaded."""
    signal.signal(signal.SIGINT, lambda *_: leave(says))


def leave_on_ctrl_c(says: str, at_once: bool) -> None:
    """Exit within a second of Ctrl-C, also while compiled code runs and Python sees no signal.

    At once where nothing needs cleaning up: a KeyboardInterrupt while libraries are loaded can crash.
    """
    leave_at_once(says) if at_once else signal.signal(signal.SIGINT, signal.default_int_handler)
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    signal.set_wakeup_fd(writing)

    def watch() -> None:
        while os.read(reading, 1)[0] != signal.SIGINT:
            pass
        time.sleep(0.6)  # time for Python's own cleaning up
        leave(says)

    threading.Thread(target=watch, daemon=True).start()


def find_model(dataset: str) -> Path:
    """Return the weights to use for a data set: the user's own gpu or laptop run, else shipped.

    Of several presets the profile's own comes first, then the newest.

    Raises:
      ValueError: if there are none, saying how to train them.
    """
    for profile, folder in (
        ("gpu", runs_dir(dataset, "gpu") / "models"),
        ("laptop", runs_dir(dataset, "laptop") / "models"),
        ("laptop", PRETRAINED_DIR / dataset),
    ):
        first = folder / f"{load_profile(profile, dataset).preset}.safetensors"
        models = [path for path in folder.glob("*.safetensors") if "." not in path.stem]  # no state, nothing set aside
        if models:
            return first if first in models else max(models, key=lambda path: path.stat().st_mtime)
    raise ValueError(
        f"no trained model for data set {dataset!r}: run `f3amd train --data "
        f"{dataset}` (or `make figures DATA={dataset}`) first, or pass --weights"
    )
