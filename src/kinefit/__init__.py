"""kinefit fits one articulated body to whatever the sensors saw.

The public names stand in `__init__.pyi`. Each is loaded when it is first used, so that `import kinefit` and the command
line start at once.
"""

import os
import sys

_ROOT = os.path.dirname(os.path.dirname(__file__))
if sys.argv[:1] == ["-m"] and "kinefit" in sys.orig_argv and sys.path[0] == os.getcwd() != _ROOT:
    del sys.path[0]  # `python -m kinefit` imports nothing from the current folder, which may hold files of strangers

import ast  # noqa: E402
from functools import cache  # noqa: E402
from importlib import import_module  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

from kinefit._moved import MOVED, MovedFinder  # noqa: E402

sys.meta_path.insert(0, MovedFinder())

__version__ = "0.2.0"


@cache
def _homes() -> dict[str, tuple[str, str]]:
    """{public name: (module, name in it)}, as the stub imports them."""
    stub = ast.parse(Path(__file__).with_suffix(".pyi").read_text("utf-8"))
    lines = [line for line in stub.body if isinstance(line, ast.ImportFrom)]
    return {name.asname or name.name: (line.module or "", name.name) for line in lines for name in line.names}


def __getattr__(name: str) -> Any:
    if name == "__all__":
        return [*_homes(), "__version__"]
    module, attribute = _homes().get(name, ("", ""))
    if module == __name__:
        return import_module(f"{module}.{attribute}")
    if module:
        return getattr(import_module(module), attribute)
    if name in MOVED:
        return import_module(f"kinefit.{name}")
    raise AttributeError(f"module 'kinefit' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*_homes(), "__version__"])
