"""Public names of packages, and the loading of those that a stub lists when they are first used."""

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
def names_of(package: str) -> dict[str, str]:
    """{public name: module that has it}, as the stub of a package, or else its `__all__`, says; imports nothing."""
    folder = Path(__file__).parent.joinpath(*package.split(".")[1:])
    path = next(filter(Path.exists, (folder / "__init__.pyi", folder / "__init__.py")))
    lines = ast.parse(path.read_text("utf-8")).body
    if path.suffix == ".pyi":
        return {one.name: line.module or "" for line in lines if isinstance(line, ast.ImportFrom) for one in line.names}
    lists = [line for line in lines if isinstance(line, ast.Assign) and "__all__" in ast.unparse(line)]
    return {name: package for line in lists for name in ast.literal_eval(line.value)}


def door_of(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package with a stub."""

    def get(name: str) -> Any:
        if name == "__all__":
            return [*names_of(package)]
        if name not in names_of(package):
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return getattr(import_module(names_of(package)[name]), name)

    return get, lambda: sorted(names_of(package))


@cache
def public_names() -> dict[str, str]:
    """{public name: package that has it}: the door's own, then those of rooms, from below."""
    rooms = [f"kinefit.{room}" for room in reversed(ROOMS)]
    return {name: package for package in [*rooms, "kinefit"] for name in names_of(package)}
