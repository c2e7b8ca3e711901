"""Trees of arrays as files, whatever they hold: safetensors with a JSON description, never a pickle.

Writing goes to a temporary file that then takes the name, so that a crash leaves the old file whole.
Reading checks names, shapes, types and a checksum.
"""

import ast
import contextlib
import hashlib
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.flax import save_file

from f3amd_lib.ground.files import whole_file

FORMAT = "f3amd-1"


def _named_leaves(tree) -> dict:
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}


def save_tree(path: Path, tree: Any, metadata: dict) -> None:
    """Write a tree of arrays with a JSON description, atomically.

    Args:
      path: file to write; replaced as a whole if it exists.
      tree: any JAX tree of arrays.
      metadata: JSON-ready values.

    Raises:
      OSError: naming the file, if it cannot be written.
    """
    arrays = {name: jnp.asarray(leaf) for name, leaf in _named_leaves(tree).items()}
    description = json.dumps(metadata)
    checksum = _checksum(arrays, description)
    header = {"format": FORMAT, "description": description, "sha256": checksum}
    with whole_file(path, overwrite=True) as temporary:
        try:
            save_file(arrays, temporary, header)
        except SafetensorError as error:
            raise OSError(f"{path}: cannot be written ({error}); make room on the disk, then try again") from None


def _checksum(arrays: dict, description: str) -> str:
    """Return the sha256 of a description and of all arrays in the order of their names."""
    digest = hashlib.sha256(description.encode())
    for name in sorted(arrays):
        digest.update(name.encode())
        digest.update(np.asarray(arrays[name]).tobytes())
    return digest.hexdigest()


def _read(path: Path) -> tuple[dict, dict]:
    """Return (arrays, description) of a file; ValueError names a broken one."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such weights file")
    try:
        # In NumPy, here and below: JAX compiles a program for every shape that it is to convert.
        with safe_open(path, framework="numpy") as file:
            header = file.metadata() or {}
            # Others' files may hold types that NumPy does not know, and need not be read at all.
            names = file.keys() if header.get("format") == FORMAT else ()
            arrays = {name: file.get_tensor(name) for name in names}
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError, MemoryError) as error:
        raise ValueError(
            f"{path}: not a whole safetensors file ({error}); it was cut short or damaged, delete it or restore a copy"
        ) from None
    if header.get("format") != FORMAT:
        raise ValueError(f"{path}: not written by this project (format {repr(header.get('format'))[:60]})")
    if header.get("sha256") != _checksum(arrays, header.get("description", "")):
        raise ValueError(f"{path}: content does not match its checksum; restore a whole copy")
    with errors_name(path):
        description = json.loads(header["description"])
        if not isinstance(description, dict):
            raise ValueError("its description is not a JSON object; restore a whole copy")
    return arrays, description


def describe(path: Path) -> dict:
    """Return the description of a file written by this project; ValueError names a broken one."""
    return _read(path)[1]


def load_tree(path: Path, template: Any, *, rest: bool = False) -> tuple[Any, dict]:
    """Read a tree written by `save_tree`; the file is read and its checksum taken once.

    Args:
      path: the file.
      template: tree of arrays or shapes that says what must be there, or a function that makes one
        from the file's description, which it may refuse with a ValueError.
      rest: the tree is a dict, and the template has some of its parts; the others come as the file has them, as dicts
        of arrays in dicts.

    Returns:
      (tree, metadata).

    Raises:
      ValueError: naming the file and what is missing, misshapen or too much.
    """
    arrays, metadata = _read(path)
    if callable(template):
        with errors_name(path):
            template = template(metadata)
    if rest:
        template = _with_rest(template, arrays)
    wanted = _named_leaves(template)
    if wanted.keys() != arrays.keys():
        odd = sorted(wanted.keys() ^ arrays.keys())
        raise ValueError(f"{path}: does not hold the expected arrays; first difference {odd[0]}")
    for name, leaf in wanted.items():
        if arrays[name].shape != leaf.shape:
            raise ValueError(f"{path}: {name} has shape {arrays[name].shape}, expected {leaf.shape}")
    leaves = [jax.device_put(arrays[name].astype(leaf.dtype)) for name, leaf in wanted.items()]
    return jax.tree.unflatten(jax.tree.structure(template), leaves), metadata


def _with_rest(template: dict, arrays: dict) -> dict:
    """Return a template with the parts that it lacks, as dicts in dicts, of names such as "['axes']['mean']"."""
    tree, known = dict(template), tuple(f"[{part!r}]" for part in template)
    for name, array in arrays.items():
        if not name.startswith(known):
            *inner, last = (ast.literal_eval(key) for key in name[1:-1].split("]["))
            place = tree
            for key in inner:
                place = place.setdefault(key, {})
            place[last] = array
    return tree


def weights_digest(params: Any) -> str:
    """Return 12 hex digits that tell one set of weights from another."""
    return _checksum(_named_leaves(params), "")[:12]


@contextlib.contextmanager
def errors_name(path: Path):
    """Let whatever goes wrong inside, reading a file's description, be an error that names it."""
    try:
        yield
    except (LookupError, TypeError, AttributeError, RecursionError, ArithmeticError, MemoryError) as error:
        raise ValueError(f"{path}: description lacks or garbles {error}; restore a whole copy") from None
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(str(path)) else f"{path}: {text}") from None


def check_kind(metadata: dict, kind: str) -> None:
    """Raise a ValueError where a file's description is of another kind."""
    if metadata.get("kind") != kind:
        raise ValueError(f"holds a {metadata.get('kind')}, not a {kind}")
