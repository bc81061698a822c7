"""A motion of one body, done by another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.errors import BodyError
from kinefit.geometry import se3
from kinefit.motion import Motion
from kinefit.simulation.retarget import fit_to_points, known_motion

_ACCURACY = 0.01  # [m] bodies differ by more than this; small beside a limb, so that the priors only fill in
_CHANGE = 0.2  # [rad] from frame to frame
_FEWEST = 6  # landmarks that both must have: fewer leave limbs open


def on_body(motion: Motion, body: Body) -> Motion:
    """The motion with another body put through the same landmarks, as the two have names in common.

    Where the statures differ, places are scaled with them about the world's origin, so the floor stays the floor.

    Parameters
    ----------
    motion : Motion
    body : Body

    Returns
    -------
    Motion
        Standard deviations zero, qualities one.

    Raises
    ------
    BodyError
        Fewer than six landmarks of the same names.
    """
    names = tuple(name for name in body.landmarks.names if name in motion.body.landmarks.names)
    if len(names) < _FEWEST:
        raise BodyError(
            f"the bodies '{motion.body.name}' and '{body.name}' have {len(names)} landmarks in common",
            remedy=f"Take a body with {_FEWEST} or more of: {', '.join(motion.body.landmarks.names)}.",
        )
    points, scale = body.landmarks.select(names), 1.0
    if body.stature > 0 and motion.body.stature > 0:
        scale = body.stature / motion.body.stature
    targets = scale * motion.positions(motion.body.landmarks.select(names))
    state, roots, angles = body.usual_state(), [], []
    for frame, target in enumerate(targets):
        start = BodyState(_aligned(body, state, points, target), state.angles)
        change = _CHANGE if frame else np.inf
        state = fit_to_points(body, start, points, target, sigma=_ACCURACY, change=change).state
        roots.append(state.T_world_root)
        angles.append(state.angles)
    return known_motion(body, motion.rate, np.array(roots), np.array(angles), up=motion.up, name=motion.name)


def _aligned(body: Body, state: BodyState, points: PointSet, target: NDArray) -> NDArray:
    """T_world_root (4, 4) that brings the points of a state nearest to their targets (Kabsch)."""
    return se3.aligned(body.positions(state, points), target) @ state.T_world_root
