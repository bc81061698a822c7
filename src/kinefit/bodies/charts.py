"""The two charts of a ball joint: every turn has two triples of angles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.tree import KinematicTree

SIGNS = np.array([1.0, -1.0, 1.0])  # how the twin's angles change when the angles do


def twin(angles: NDArray) -> NDArray:
    """The other triple (..., 3) [rad] of the same turn: (a + π, π − b, c + π), each between −π and π."""
    return np.angle(np.exp(1j * (np.pi + SIGNS * np.asarray(angles, float))))


def off_the_limits(tree: KinematicTree, angles: NDArray) -> tuple[NDArray, NDArray] | None:
    """Angles (D,) with the twin for every ball joint that a limit stops though its twin is free; and signs (D,).

    A limit bounds a chart, not a turn: an arm that swings overhead comes to the end of one chart well inside the other.
    None where there is nothing to change.
    """
    out, signs = np.array(angles), np.ones(len(angles))
    for d in tree.ball_joints:
        low, high = tree.lower[d], tree.upper[d]
        stopped = (angles[d] <= low) | (angles[d] >= high)
        if not stopped.any():
            continue
        other = twin(angles[d])
        other += 2.0 * np.pi * ((other < low).astype(float) - (other > high))
        if np.all((other > low) & (other < high)):
            out[d], signs[d] = other, SIGNS
    return None if np.array_equal(signs, np.ones(len(signs))) else (out, signs)
