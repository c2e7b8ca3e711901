"""Files of npm packages for pages: fetched once at a fixed version, checked by sha512, kept in the cache.

Nothing of them is committed, and npm itself is not needed: an archive comes from its public registry by address.
"""

import tarfile
import tomllib
from pathlib import Path

import pooch

_PINNED = tomllib.loads(Path(__file__).with_name("npm_packages.toml").read_text(encoding="utf-8"))


def package_file(package: str, path: str) -> bytes:
    """Return a file of a pinned package.

    Args:
      package: a name of `npm_packages.toml`.
      path: inside the package, such as "build/three.module.js".

    Raises:
      ValueError: if it is not in the cache and cannot be fetched, or is not what was pinned.
    """
    pinned = _PINNED[package]
    name = f"{package}-{pinned['version']}.tgz"
    url, folder = f"https://registry.npmjs.org/{package}/-/{name}", Path(pooch.os_cache("f3amd"))
    pooch.get_logger().setLevel("WARNING")
    try:
        archive = pooch.retrieve(url, f"sha512:{pinned['sha512']}", fname=name, path=folder)
    except (OSError, ValueError) as error:
        raise ValueError(f"{url}: not fetched ({error}); put that file at {folder / name} yourself") from None
    with tarfile.open(archive) as files:
        return files.extractfile(f"package/{path}").read()


def package_credit(package: str) -> str:
    """Return name, version, holder and licence of a pinned package, for the page that carries it."""
    pinned = _PINNED[package]
    return f"{package} {pinned['version']}: {pinned['about']}, {pinned['licence']} licence"
