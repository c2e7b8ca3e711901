"""Put the course into the site as JupyterLite: notebooks with a Python that runs in the reader's browser.

    python docs/lite.py docs/_build/html

The folder `lite/` then holds JupyterLite, the course with its outputs, and a wheel of what the course imports. That
Python is Pyodide, with NumPy, SciPy, pandas and Matplotlib; a reader's browser fetches it from its makers' server when
a kernel starts. It has no JAX, and cells that train or run a network say that they are skipped. `make site` runs this.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from f3amd_lib import __version__  # noqa: E402 (the line above finds it)

LEFT_OUT = {"pretrained", "__pycache__"}  # weights need JAX


def write_wheel(folder: Path) -> Path:
    """Write the library and the notebooks' helpers as a wheel that asks for what Pyodide has, and return its path."""
    path = folder / f"f3amd_lib-{__version__}-py3-none-any.whl"
    needs = "".join(f"Requires-Dist: {name}\n" for name in ("numpy", "scipy", "pandas", "matplotlib", "pillow"))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as wheel:
        for base, package in ((ROOT, "f3amd_lib"), (ROOT / "notebooks", "f3amd_notebooks")):
            for file in sorted(path for path in (base / package).rglob("*") if path.is_file()):
                if not LEFT_OUT & set(file.parts):
                    wheel.write(file, file.relative_to(base))
        about = f"f3amd_lib-{__version__}.dist-info"
        wheel.writestr(f"{about}/METADATA", f"Metadata-Version: 2.1\nName: f3amd_lib\nVersion: {__version__}\n{needs}")
        wheel.writestr(f"{about}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        wheel.writestr(f"{about}/RECORD", "")
    return path


def in_a_tab(notebook: dict) -> dict:
    """Return a notebook of the course whose first code cell fetches the wheel, and whose kernel is JupyterLite's."""
    notebook["metadata"]["kernelspec"] = {"name": "python", "display_name": "Python (Pyodide)"}
    for cell in notebook["cells"]:
        if "install" in cell["metadata"].get("tags", []):
            cell["source"] = "%pip install -q f3amd_lib"
    return notebook


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "course").mkdir()
        for path in (ROOT / "notebooks/course").glob("*.ipynb"):
            notebook = in_a_tab(json.loads(path.read_text(encoding="utf-8")))
            (folder / "course" / path.name).write_text(json.dumps(notebook), encoding="utf-8")
        options = ["--lite-dir", name, "--contents", name + "/course", "--piplite-wheels", str(write_wheel(folder)),
                   "--output-dir", str(Path(sys.argv[1], "lite").resolve()), "--apps", "lab", "--apps", "notebooks",
                   "--no-sourcemaps", "--no-unused-shared-packages"]  # fmt: skip
        command = [sys.executable, "-m", "jupyterlite_core", "build", *options]
        made = subprocess.run(command, cwd=name, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        if made.returncode:
            sys.exit(made.stdout)


if __name__ == "__main__":
    main()
