"""Transfer the surfaces of one body to another body with the same segments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.body import Body
from kinefit.bodies.surfaces import Surface, TaperedCylinder


def with_flesh(body: Body, other: Body, usual: Body) -> Body:
    """Transfer the skin of another body with the same segments, and scale the radii of cylinders accordingly.

    The skin of a segment is stretched with the segment, then moved with its joint. Bones and points do not change.

    Parameters
    ----------
    body, other : of the same segments and surfaces
    usual : body of the shape that `body` has now. The radii of `body` grow by the ratio of `other`'s to its radii.
    """
    fitted, before = (_scaled_to(b, body) for b in (other, usual))
    skin = fitted.skin
    if skin is not None:
        skin = replace(skin, nodes=skin.nodes + (body.tree.rest - fitted.tree.rest)[skin.owners])
    return replace(
        body,
        skin=skin,
        surfaces=tuple(_wider(*three) for three in zip(body.surfaces, fitted.surfaces, before.surfaces, strict=True)),
        family=other.family,
    )


def _scaled_to(source: Body, body: Body) -> Body:
    target_sizes, sizes = _sizes(body), _sizes(source)
    return source.scaled(np.where(sizes > 0.0, target_sizes / np.maximum(sizes, 1e-12), 1.0))


def _wider(surface: Surface, made: Surface, usual: Surface) -> Surface:
    if not all(isinstance(s, TaperedCylinder) for s in (surface, made, usual)):
        return surface
    radii = np.array(surface.radii) * made.radii / np.array(usual.radii)  # type: ignore[union-attr]
    (a0, b0), (a1, b1) = radii.tolist()
    return replace(surface, radii=((a0, b0), (a1, b1)))  # type: ignore[call-arg, arg-type]


def _sizes(body: Body) -> NDArray:
    """Size (G,) [m] of each scale group: the sum of its landmarks' distances from their joints."""
    points, group = body.landmarks, body.segment_scale[body.landmarks.segments]
    return np.bincount(group, np.linalg.norm(points.points, axis=1), len(body.scale_groups))
