"""Twists of equations between segments, as derivatives by the degrees of freedom."""

from __future__ import annotations

from kinefit._jit import jit


@jit
def twists(data, segments, screws, dof_parent, last_dof, J):
    """Add to J (m, n) how each equation changes with the degrees of freedom.

    data (2, m, 6) is what an equation takes of the twist (v, ω) of its segments about the root's origin; segments
    (2, m), -1 for the world; screws (D, 6).
    """
    for side in range(2):
        for i in range(segments.shape[1]):
            s = segments[side, i]
            if s < 0:
                continue
            a = data[side, i]
            for k in range(6):
                J[i, k] += a[k]
            d = last_dof[s]
            while d >= 6:
                total = 0.0
                for k in range(6):
                    total += a[k] * screws[d - 6, k]
                J[i, d] += total
                d = dof_parent[d]
