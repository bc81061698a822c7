"""The skin of a person in figures, scaled to a body's own lengths and widths.

`benchmarks.person_skin` made the file: one seamless mesh about metaballs on the humanoid's limbs, with weights.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, TaperedCylinder, load_body
from kinefit.bodies.surfaces.skins.skinning import SkinnedMesh

FILE = Path(__file__).parents[1] / "data" / "person_skin.npz"
_MAX_RATIO = 3.0  # of a segment's length or width to the humanoid's: beyond, a body only has a person's names


class _Template(NamedTuple):
    """What the file holds (`benchmarks.person_skin.skin`), and the humanoid's rest and extents (S, 3) [m]."""

    names: list[str]
    vertices: NDArray
    faces: NDArray
    owners: NDArray
    weights: NDArray
    rest: NDArray
    extents: NDArray


def person_skin(body: Body) -> SkinnedMesh | None:
    """The skin of a body that has all segments of the humanoid, with cylinders; None for any other body.

    Every vertex is stretched in the frames of the segments that it follows, by what the body's cylinder there is longer
    and wider than the humanoid's.
    """
    of = _template()
    if not set(of.names) <= set(body.tree.segments):
        return None
    own = np.array([body.tree.segment(name) for name in of.names])
    ratios = _extents(body)[own] / of.extents
    if not np.all((ratios < _MAX_RATIO) & (ratios > 1.0 / _MAX_RATIO)):
        return None
    nodes = body.tree.rest[own][of.owners] + ratios[of.owners] * (of.vertices[:, None] - of.rest[of.owners])
    return SkinnedMesh(nodes, of.faces, own[of.owners], of.weights)


@lru_cache(maxsize=1)
def _template() -> _Template:
    body = load_body("humanoid")
    with np.load(FILE) as file:
        names = file["segments"].tolist()
        own = [body.tree.segment(name) for name in names]
        owners = file["owners"].astype(int)
        return _Template(
            names, file["vertices"].astype(float), file["faces"], owners, file["weights"].astype(float),
            body.tree.rest[own], _extents(body)[own],
        )  # fmt: skip


def _extents(body: Body) -> NDArray:
    """(S, 3) [m] along the axes of each segment's frame: of its longest cylinder; NaN where it has none."""
    out, longest = np.full((len(body.tree.segments), 3), np.nan), np.zeros(len(body.tree.segments))
    for c in body.surfaces:
        if isinstance(c, TaperedCylinder) and c.length > longest[c.segment]:
            longest[c.segment] = c.length
            out[c.segment] = np.array([*np.mean(c.radii, axis=0), c.length]) @ np.abs(c.axes)
    return out
