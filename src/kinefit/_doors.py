"""Public names of a package: listed by the stub beside its `__init__.py`, loaded when they are first used."""

from __future__ import annotations

import ast
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

ROOMS = (
    "geometry", "bodies", "observations", "solving", "images", "readers", "sensors", "markers", "fitting", "rigs",
    "exporters", "takes", "papers", "simulation", "studio", "cli",
)  # fmt: skip
"""The packages of kinefit, from below: each imports only those before it."""


@cache
def names_of(package: str) -> dict[str, tuple[str, str]]:
    """{public name: (module, name in it)}, as the stub of a package imports them; empty without a stub."""
    stub = Path(__file__).parent.joinpath(*package.split(".")[1:], "__init__.pyi")
    lines = ast.parse(stub.read_text("utf-8")).body if stub.exists() else []
    found = [line for line in lines if isinstance(line, ast.ImportFrom)]
    return {name.asname or name.name: (line.module or "", name.name) for line in found for name in line.names}


def door_of(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package with a stub."""

    def get(name: str) -> Any:
        if name == "__all__":
            return [*names_of(package)]
        if name not in names_of(package):
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        module, attribute = names_of(package)[name]
        return getattr(import_module(module), attribute)

    return get, lambda: sorted(names_of(package))


@cache
def public_names() -> dict[str, str]:
    """{public name: package that has it}: the door's own, then those of rooms, from below."""
    found = dict.fromkeys(names_of("kinefit"), "kinefit")
    for room in ROOMS:
        package = import_module(f"kinefit.{room}")
        names = vars(package).get("__all__", names_of(package.__name__))
        found = dict.fromkeys(names, package.__name__) | found
    return found
