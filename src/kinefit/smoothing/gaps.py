"""A first guess of frames in which too little was seen: the motion before and after them, carried on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.findings import runs_of

_BACK = 5  # frames over which the motion at the ends of a gap is taken


def bridged(roots: NDArray, angles: NDArray, lost: NDArray, memory: float) -> tuple[NDArray, NDArray]:
    """Poses with lost frames filled by what goes on from before and what must have come before what follows.

    A person who turns round while hidden is thus turned the same way on, and not back.

    Parameters
    ----------
    roots, angles : (F, 4, 4) [m], (F, D) [rad] without jumps.
    lost : (F,) bool
    memory : float [frames] in which a velocity forgets itself by 1/e.
    """
    roots, angles = np.array(roots), np.array(angles)
    for start, stop in runs_of(lost):
        before = _leaving(roots, angles, lost, start - 1, -1)
        after = _leaving(roots, angles, lost, stop, 1)
        for f in range(start, stop):
            share = (f - start + 1) / (stop - start + 1)
            state = None
            if before:
                state = before[0].retract(_lasting(f - start + 1, memory) * before[1])
            if after:
                other = after[0].retract(_lasting(stop - f, memory) * after[1])
                weight = share * share * (3.0 - 2.0 * share)
                state = state.retract(weight * state.difference(other)) if state else other
            if state:
                roots[f], angles[f] = state.T_world_root, state.angles
    return roots, angles


def _lasting(frames: float, memory: float) -> float:
    """How many frames' worth of a velocity that forgets itself."""
    return memory * float(-np.expm1(-frames / memory))


def _leaving(roots: NDArray, angles: NDArray, lost: NDArray, f: int, towards: int) -> tuple[BodyState, NDArray] | None:
    """State of the frame beside a gap, and its step a frame away from where it came: None where there is no frame."""
    if not 0 <= f < len(roots):
        return None
    state, steps = BodyState(roots[f], angles[f]), 0
    while steps < _BACK and 0 <= f + towards * (steps + 1) < len(roots) and not lost[f + towards * (steps + 1)]:
        steps += 1
    if steps == 0:
        return state, np.zeros(6 + angles.shape[1])
    inside = f + towards * steps
    return state, BodyState(roots[inside], angles[inside]).difference(state) / steps
