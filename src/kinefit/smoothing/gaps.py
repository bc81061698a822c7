"""Fill lost frames with a first estimate: extrapolate the motion before and after the gap."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.findings import runs_of

_VELOCITY_FRAMES = 5  # over which the velocity at the ends of a gap is measured


def bridged(roots: NDArray, angles: NDArray, lost: NDArray, memory: float) -> tuple[NDArray, NDArray]:
    """Poses with lost frames filled: a blend of both extrapolations, from before and from after the gap.

    So a person who turns round in a gap turns on in the same direction, not back.

    Parameters
    ----------
    roots, angles : (F, 4, 4) [m], (F, D) [rad] without jumps
    lost : (F,) bool
    memory : float [frames], time constant with which an extrapolated velocity decays
    """
    roots, angles = np.array(roots), np.array(angles)
    for start, stop in runs_of(lost):
        before = _edge_of_gap(roots, angles, lost, start - 1, -1)
        after = _edge_of_gap(roots, angles, lost, stop, 1)
        for f in range(start, stop):
            share = (f - start + 1) / (stop - start + 1)
            state = None
            if before:
                state = before[0].retract(_decayed_frames(f - start + 1, memory) * before[1])
            if after:
                backward = after[0].retract(_decayed_frames(stop - f, memory) * after[1])
                weight = share * share * (3.0 - 2.0 * share)
                state = state.retract(weight * state.difference(backward)) if state else backward
            if state:
                roots[f], angles[f] = state.T_world_root, state.angles
    return roots, angles


def _decayed_frames(frames: float, memory: float) -> float:
    """Integral of a decaying velocity over some frames, in frames of its start."""
    return memory * float(-np.expm1(-frames / memory))


def _edge_of_gap(
    roots: NDArray, angles: NDArray, lost: NDArray, f: int, towards: int
) -> tuple[BodyState, NDArray] | None:
    """State of frame `f` at the edge of a gap, and its step (n,) per frame into the gap; None outside the take."""
    if not 0 <= f < len(roots):
        return None
    state, steps = BodyState(roots[f], angles[f]), 0
    while steps < _VELOCITY_FRAMES and 0 <= (k := f + towards * (steps + 1)) < len(roots) and not lost[k]:
        steps += 1
    if steps == 0:
        return state, np.zeros(6 + angles.shape[1])
    inside = f + towards * steps
    return state, BodyState(roots[inside], angles[inside]).difference(state) / steps
