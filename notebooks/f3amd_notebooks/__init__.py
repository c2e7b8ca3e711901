"""What the theory notebooks need beside the library: toys, closed forms, checks of exercises.

A cell that begins with the line `# needs jax` is skipped, and says so, where JAX is missing: in a browser tab.
"""

import sys
from importlib.util import find_spec


def _skip_what_needs_jax(lines: list[str]) -> list[str]:
    if not "".join(lines).startswith("# needs jax"):
        return lines
    return ['print("Skipped: this cell trains or runs a network, and JAX is not here.")\n']


_shell = "IPython" in sys.modules and sys.modules["IPython"].get_ipython()
if _shell and not find_spec("jax"):
    _shell.input_transformers_cleanup.append(_skip_what_needs_jax)
