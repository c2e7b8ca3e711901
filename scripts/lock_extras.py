"""Put the extras into requirements.lock, behind the plain install: an entry only where an extra adds a package.

    python scripts/lock_extras.py site=FILE sweep=FILE web=FILE     # files of hashed pins, as uv writes them

`scripts/lock.sh` calls this. An entry of an extra carries the marker `extra == 'NAME'`, which no plain install meets
and `scripts/extra.sh NAME` takes for met. Pins of `bench` and `onnx`, without hashes, are kept as they stand.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

LOCK = Path(__file__).resolve().parents[1] / "requirements.lock"
HEAD = """\
# Extras, for `scripts/extra.sh NAME` (`make bench-tools` and the like): what they add to the packages above.
# Those of bench and onnx have no hashes: on Linux PyTorch's builds for a processor alone (200 MB) lie at a place of
# PyTorch's own, which its installation page names. Where pip is told of it, it prefers them; otherwise it takes the
# usual ones, which bring gigabytes for GPUs. And jax2onnx asks for an older orbax-checkpoint than flax does.
"""


def entries(text: str) -> list[tuple[str, str, list[str]]]:
    """Return (pin, marker, hashes) of each entry of a lock; comments are left out."""
    found = []
    for line in text.splitlines():
        words = line.strip().removesuffix("\\").strip()
        if words.startswith("--hash="):
            found[-1][2].append(words)
        elif words and not words.startswith("#"):
            pin, _, marker = words.partition(" ; ")
            found.append((pin, marker, []))
    return found


def without_extras(lock: str) -> str:
    """Return the part of a lock that a plain install takes."""
    return re.split(r"^# Extras", lock, maxsplit=1, flags=re.M)[0]


def with_extras(lock: str, extras: dict[str, str]) -> str:
    """Return a lock with these extras, name -> text of their hashed pins; its unhashed ones stay."""
    plain = without_extras(lock)
    known = {pin.partition("==")[0] for pin, _, _ in entries(plain)}
    added: dict[str, tuple[list[str], list[str]]] = {}
    for name, text in extras.items():
        for pin, marker, hashes in entries(text):
            if pin.partition("==")[0] not in known:
                asked = f"({marker}) and extra == '{name}'" if marker else f"extra == '{name}'"
                added.setdefault(pin, ([], hashes))[0].append(asked)
    for pin, marker, hashes in entries(lock.removeprefix(plain)):
        if not hashes:
            added[pin] = ([marker], hashes)
    lines = [
        " \\\n    ".join([f"{pin} ; {' or '.join(markers)}", *hashes]) + "\n"
        for pin, (markers, hashes) in sorted(added.items())
    ]
    return plain + HEAD + "".join(lines)


if __name__ == "__main__":
    files = dict(word.split("=", 1) for word in sys.argv[1:])
    extras = {name: Path(path).read_text(encoding="utf-8") for name, path in files.items()}
    LOCK.write_text(with_extras(LOCK.read_text(encoding="utf-8"), extras), encoding="utf-8")
