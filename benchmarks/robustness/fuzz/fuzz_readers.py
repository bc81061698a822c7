"""Every reader of files that a stranger may hand over."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from benchmarks.robustness.fuzz.fuzz_seeds import FIRST, Seed
from benchmarks.robustness.fuzz.fuzz_seeds_folders import FOLDERS
from benchmarks.robustness.fuzz.fuzz_seeds_takes import LATER

READERS: dict[str, Callable[[Path], Seed]] = FIRST | LATER | FOLDERS
"""{reader: maker of its seed}."""


def seed_of(name: str, folder: Path) -> Seed:
    """The seed of a reader of `READERS`, its files made below a folder."""
    return READERS[name](folder)
