"""Take files as texts: what their sensors saw, and the motion that they give. Files in them have their whole path."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from numpy.typing import NDArray

from kinefit.bodies.motion import Motion
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import Observations, load_observations
from kinefit.takes.missing import prepared
from kinefit.takes.track import track_take


@contextmanager
def written(text: str) -> Iterator[Path]:
    """The file of a take in a folder of its own, as long as the block lasts."""
    with tempfile.TemporaryDirectory() as work:
        path = Path(work) / "take.toml"
        path.write_text(text, encoding="utf-8")
        yield path


def seen_of(text: str, *, detect: bool = False) -> Observations:
    """What the sensors of a take saw; videos are read when they are asked, or looked through by the detector first."""
    with written(text) as path:
        seen = load_observations(prepared(read_take(path), tell=print) if detect else read_take(path))
    assert seen.rig is not None
    return seen


def tracked(text: str, **options: object) -> tuple[Motion, Observations]:
    """The motion of a take, and what its sensors saw; options of `kinefit.track_take`."""
    with written(text) as path:
        return track_take(path, **options)  # type: ignore[arg-type]


def start_text(T: NDArray, degrees: Mapping[str, float] | None = None, more: str = "") -> str:
    """The table [start] of a pose (4, 4) [m] of the root, with angles of some coordinates [deg] and further lines."""
    text = f"[start]\nat = {T[:3, 3].tolist()}\nforward = {T[:3, 0].tolist()}\nupward = {T[:3, 1].tolist()}\n{more}"
    if degrees is not None:
        text += f"angles = {{ {', '.join(f'{name} = {value:.4f}' for name, value in degrees.items())} }}\n"
    return text
