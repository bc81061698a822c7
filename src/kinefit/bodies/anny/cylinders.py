"""Cylinders of an Anny body, as wide as its skin: what depth sensors see of its shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.surfaces import SkinnedMesh, TaperedCylinder

_FEWEST = 6  # nodes about an end, with fewer of which its width is the whole cylinder's


def widths(cylinders: Sequence[TaperedCylinder], skin: SkinnedMesh, rest: NDArray) -> NDArray:
    """(C, 2, 2) [m] how far the skin's nodes lie about each cylinder: at both ends, along both half axes (RMS).

    Parameters
    ----------
    skin : of the body, at rest
    rest : (S, 3) [m] joint centres at rest
    """
    out = np.ones((len(cylinders), 2, 2))
    for c, cylinder in enumerate(cylinders):
        x = skin.vertices[skin.segment == cylinder.segment] - rest[cylinder.segment]
        start, way = np.array(cylinder.start), np.subtract(cylinder.end, cylinder.start)
        t = (x - start) @ way / (way @ way)
        x, t = x[(t > 0.0) & (t < 1.0)], t[(t > 0.0) & (t < 1.0)]
        for end, near in enumerate((t < 0.5, t >= 0.5)):
            own = x[near] if near.sum() >= _FEWEST else x
            if len(own) >= _FEWEST:
                out[c, end] = (own @ np.array(cylinder.axes[:2]).T).std(axis=0)
    return out


def as_wide(
    cylinders: Sequence[TaperedCylinder], skin: SkinnedMesh, rest: NDArray, usual: NDArray, radii: NDArray
) -> tuple[TaperedCylinder, ...]:
    """The cylinders with radii (C, 2, 2) [m] times how much wider (C, 2, 2) the skin is than a usual one."""
    wide = (radii * widths(cylinders, skin, rest) / usual).reshape(-1, 4).tolist()
    return tuple(replace(c, radii=((a0, b0), (a1, b1))) for c, (a0, b0, a1, b1) in zip(cylinders, wide))
