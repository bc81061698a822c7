"""Transfer a motion from one body to another by common landmarks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.errors import BodyError
from kinefit.geometry import se3
from kinefit.motion import Motion
from kinefit.simulation.retarget import fit_to_points, known_motion

_LANDMARK_STD = 0.01  # [m]; small relative to a limb, so that priors determine only what landmarks do not
_CHANGE_STD = 0.2  # [rad] of an angle from frame to frame
_MIN_LANDMARKS = 6  # in common: fewer do not determine all limbs


def on_body(motion: Motion, body: Body) -> Motion:
    """Fit another body to the landmarks of a motion that both bodies have by name.

    If the statures differ, places are scaled about the world's origin by their ratio, so the floor stays at height
    zero.

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
    if len(names) < _MIN_LANDMARKS:
        raise BodyError(
            f"the bodies '{motion.body.name}' and '{body.name}' have only {len(names)} landmarks in common",
            remedy=f"Use a body with {_MIN_LANDMARKS} or more of: {', '.join(motion.body.landmarks.names)}.",
        )
    points, scale = body.landmarks.select(names), 1.0
    if body.stature > 0 and motion.body.stature > 0:
        scale = body.stature / motion.body.stature
    targets = scale * motion.positions(motion.body.landmarks.select(names))
    state, roots, angles = body.usual_state(), [], []
    for frame, target in enumerate(targets):
        start = BodyState(_aligned(body, state, points, target), state.angles)
        change = _CHANGE_STD if frame else np.inf
        state = fit_to_points(body, start, points, target, sigma=_LANDMARK_STD, change=change).state
        roots.append(state.T_world_root)
        angles.append(state.angles)
    return known_motion(body, motion.rate, np.array(roots), np.array(angles), up=motion.up, name=motion.name)


def _aligned(body: Body, state: BodyState, points: PointSet, target: NDArray) -> NDArray:
    """T_world_root (4, 4) that aligns the points of a state with their targets (Kabsch)."""
    return se3.aligned(body.positions(state, points), target) @ state.T_world_root
