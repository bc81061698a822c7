"""The two charts of a ball joint: every rotation has two triples of angles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.tree import KinematicTree

SIGNS = np.array([1.0, -1.0, 1.0])  # derivative of the twin's angles by the angles


def twin(angles: NDArray) -> NDArray:
    """The other angles (N, 3) [rad] of the same rotation: (a + π, π − b, c + π), each in −π..π. Any leading axes."""
    return np.angle(np.exp(1j * (np.pi + SIGNS * np.asarray(angles, float))))


def off_the_limits(tree: KinematicTree, angles: NDArray) -> tuple[NDArray, NDArray] | None:
    """Switch the chart of every ball joint that is at a limit if its twin is not: angles (D,) [rad] and signs (D,).

    A limit bounds a chart, not a rotation: an arm that swings overhead reaches the end of one chart well inside the
    other. None if no joint changes.
    """
    out, signs = np.array(angles), np.ones(len(angles))
    for d in tree.ball_joints:
        low, high = tree.lower[d], tree.upper[d]
        at_limit = (angles[d] <= low) | (angles[d] >= high)
        if not at_limit.any():
            continue
        other = twin(angles[d])
        other += 2.0 * np.pi * ((other < low).astype(float) - (other > high))
        if np.all((other > low) & (other < high)):
            out[d], signs[d] = other, SIGNS
    return None if np.array_equal(signs, np.ones(len(signs))) else (out, signs)
