"""Cylinders of an Anny body, scaled to the width of its skin, for depth sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.surfaces import SkinnedMesh, TaperedCylinder

_MIN_NODES = 6  # near an end; with fewer, its width is that of the whole cylinder


def widths(cylinders: Sequence[TaperedCylinder], skin: SkinnedMesh, rest: NDArray) -> NDArray:
    """Widths (C, 2, 2) [m] of the skin about each cylinder: standard deviation at both ends, along both half axes.

    Parameters
    ----------
    cylinders : C of the body
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
            own = x[near] if near.sum() >= _MIN_NODES else x
            if len(own) >= _MIN_NODES:
                out[c, end] = (own @ np.array(cylinder.axes[:2]).T).std(axis=0)
    return out


def as_wide(
    cylinders: Sequence[TaperedCylinder], skin: SkinnedMesh, rest: NDArray, usual: NDArray, radii: NDArray
) -> tuple[TaperedCylinder, ...]:
    """Scale radii (C, 2, 2) [m] of cylinders by the skin's widths relative to those of the mean shape (C, 2, 2) [m]."""
    wide = (radii * widths(cylinders, skin, rest) / usual).reshape(-1, 4).tolist()
    return tuple(replace(c, radii=((a0, b0), (a1, b1))) for c, (a0, b0, a1, b1) in zip(cylinders, wide))
