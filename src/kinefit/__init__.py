"""kinefit fits one articulated body to whatever the sensors saw.

The public names stand in `__init__.pyi`. Each is loaded when it is first used, so that `import kinefit` and the command
line start at once.
"""

import os
import sys

_ROOT = os.path.dirname(os.path.dirname(__file__))
if sys.argv[:1] == ["-m"] and "kinefit" in sys.orig_argv and sys.path[0] == os.getcwd() != _ROOT:
    del sys.path[0]  # `python -m kinefit` imports nothing from the current folder, which may hold files of strangers

import warnings  # noqa: E402
from importlib import import_module  # noqa: E402
from typing import Any  # noqa: E402

from kinefit._doors import ROOMS, door_of, names_of, public_names  # noqa: E402
from kinefit._moved import MovedFinder, moved  # noqa: E402

sys.meta_path.insert(0, MovedFinder())

__version__ = "0.2.0"


def __getattr__(name: str) -> Any:
    if name == "__all__":
        return __dir__()
    if name in ROOMS:
        return import_module(f"kinefit.{name}")
    if name in names_of(__name__):
        return door_of(__name__)[0](name)
    if new := moved(f"kinefit.{name}"):
        return import_module(new)
    if room := public_names().get(name):
        warnings.warn(f"kinefit.{name} is {room}.{name} now; the old name ends with 0.4", FutureWarning, stacklevel=2)
        return getattr(import_module(room), name)
    raise AttributeError(f"module 'kinefit' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*names_of(__name__), "__version__"])
