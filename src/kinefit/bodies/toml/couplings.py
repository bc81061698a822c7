"""Read the posture prior of a body file: its mean, and the couplings of deviations from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import msgspec
import numpy as np

from kinefit.bodies.toml.records import CouplingRecord
from kinefit.bodies.tree import KinematicTree
from kinefit.errors import BodyError, check_choice, choices, located


def with_coupling_images(records: Sequence[CouplingRecord], left: Callable[[str], str]) -> list[CouplingRecord]:
    """Couplings, and the mirror images of those whose names end in `_r`."""
    images = [
        msgspec.structs.replace(r, name=left(r.name), of={left(c): weight for c, weight in r.of.items()})
        for r in records if left(r.name) not in {other.name for other in records}
    ]  # fmt: skip
    return [*records, *images]


def coupled(tree: KinematicTree, couplings: Sequence[CouplingRecord], source: str) -> KinematicTree:
    """Add the couplings of a file to a tree; weights have no unit, spreads are in degrees.

    Raises
    ------
    BodyError
        A coordinate that is unknown, slides or cannot be coupled (see `KinematicTree`), weights that are all zero or
        not finite, a spread that is not positive.
    """
    lines = np.zeros((len(couplings), len(tree.coordinates)))
    for line, c in zip(lines, couplings):
        place = f"coupling {c.name}"
        for name, weight in c.of.items():
            check_choice(
                "coordinate", name, tree.coordinates, BodyError, file=source, place=place, remedy="Use one of these."
            )
            line[tree.coordinate(name)] = weight
        if not (np.isfinite(line).all() and line.any() and 0.0 < c.spread < np.inf):
            problem = f"spread {c.spread}, weights {list(c.of.values())}"
            raise BodyError(problem, file=source, place=place, remedy="Give a positive spread, weights other than 0.")
        if tree.prismatic[line != 0.0].any():
            raise BodyError("it couples a coordinate that slides", file=source, place=place, remedy="Couple angles.")
        line /= np.radians(c.spread)
    with located(source, "coupling"):
        return replace(tree, couplings=lines)


def with_posture(tree: KinematicTree, usual: Mapping[str, float], source: str) -> KinematicTree:
    """Change the mean posture of a tree: values [deg] or [m] of some coordinates.

    Raises
    ------
    BodyError
        An unknown coordinate, or a value out of its range.
    """
    out = np.array(tree.usual)
    for name, value in usual.items():
        place = f"usual {name}"
        if name not in tree.coordinates:
            problem = choices("coordinate", name, tree.coordinates)
            raise BodyError(problem, file=source, place=place, remedy="Use one of these.")
        d = tree.coordinate(name)
        unit = 1.0 if tree.prismatic[d] else np.pi / 180.0
        if not (np.isfinite(value) and tree.lower[d] <= value * unit <= tree.upper[d]):
            ends = f"{tree.lower[d] / unit:g} to {tree.upper[d] / unit:g}"
            raise BodyError(f"{value:g} is out of its range", file=source, place=place, remedy=f"Give {ends}.")
        out[d] = value * unit
    return replace(tree, usual=out)
