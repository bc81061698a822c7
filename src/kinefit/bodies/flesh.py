"""One body's surfaces on another's bones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.body import Body
from kinefit.bodies.surfaces import Surface, TaperedCylinder


def with_flesh(body: Body, other: Body, usual: Body) -> Body:
    """A body with the skin of another of the same segments, brought to its own bones, and cylinders as much wider.

    What lies on a segment is stretched as the segment is, then moved with its joint; bones and points stay.

    Parameters
    ----------
    body, other : of the same segments and surfaces
    usual : whose shape the body has: by as much as `other`'s cylinders are wider than its, the body's become wider.
    """
    fitted, before = (_on_bones(one, body) for one in (other, usual))
    skin = fitted.skin
    if skin is not None:
        skin = replace(skin, nodes=skin.nodes + (body.tree.rest - fitted.tree.rest)[skin.owners])
    return replace(
        body,
        skin=skin,
        surfaces=tuple(_wider(*three) for three in zip(body.surfaces, fitted.surfaces, before.surfaces, strict=True)),
        family=other.family,
    )


def _on_bones(one: Body, body: Body) -> Body:
    own, its = _sizes(body), _sizes(one)
    return one.scaled(np.where(its > 0.0, own / np.maximum(its, 1e-12), 1.0))


def _wider(surface: Surface, made: Surface, usual: Surface) -> Surface:
    if not all(isinstance(s, TaperedCylinder) for s in (surface, made, usual)):
        return surface
    radii = np.array(surface.radii) * made.radii / np.array(usual.radii)  # type: ignore[union-attr]
    (a0, b0), (a1, b1) = radii.tolist()
    return replace(surface, radii=((a0, b0), (a1, b1)))  # type: ignore[call-arg, arg-type]


def _sizes(body: Body) -> NDArray:
    """(G,) [m] how far a group's landmarks lie from their joints, in all."""
    points, group = body.landmarks, body.segment_scale[body.landmarks.segments]
    return np.bincount(group, np.linalg.norm(points.points, axis=1), len(body.scale_groups))
