"""Limbs that lean towards the camera or away from it by the same angle look nearly the same: both are looked at.

A segment's end mirrored in depth about its joint has nearly the same contour; only its size in the image, some percent,
and what it hides tell one from the other (Sminchisescu and Triggs, Kinematic jump processes, CVPR 2003). A limb that
passes through the image's plane may come out of it on either side, and be followed on the wrong one from then on.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.correspondences import point_rows
from kinefit.correspondences.parameters import prediction_rows
from kinefit.geometry.camera import Camera
from kinefit.solvers.least_squares import levenberg_marquardt

_LEAST = 0.06  # [m] by which a mirrored end is elsewhere: with less both are the same to the fit
_REACHED = 0.03  # [m] from where it should be to where the joints' limits let an end come
_SIGMA = 0.005  # [m] of the places of ends, while a limb is turned
_FREE, _HELD = 3.0, 1e-3  # [rad] or [m] standard deviations of a limb's coordinates while it is turned, and of others
_LIKELY = 30.0  # squared distance from the prediction, in its variances, beyond which a flip is not looked at
_ALONG, _TWISTED = 0.9, 0.4  # cosine of an axis with a segment's length; [rad] of a twist that is worth a look
_STEPS = 10  # of the fit that turns a limb


class Flips:
    """Limbs of one body that may be mirrored: all its segments but the root.

    Parameters
    ----------
    body : Body
    middle : (S, 3) [m] of each segment's surface, in its own frame: where its end is if nothing hangs on it
    """

    def __init__(self, body: Body, middle: NDArray) -> None:
        tree, ends = body.tree, np.array(middle)
        self.body, self._limbs = body, [np.flatnonzero(tree.parents == s) for s in range(len(tree.segments))]
        for s, children in enumerate(self._limbs):
            if len(children):
                ends[s] = np.mean(tree.rest[children] - tree.rest[s], axis=0)
        count = np.arange(len(tree.segments))
        self._ends = PointSet(tuple(tree.segments), count, ends)
        self._joints = PointSet(tuple(tree.segments), count, np.zeros_like(ends))

    def near(self, predicted: BodyState, information: NDArray, state: BodyState, camera: Camera) -> list[BodyState]:
        """States that look like a state and that its prediction, of information (n, n), allows; the likeliest first."""
        out = []
        for other in self.of(state, camera):
            off = predicted.difference(other)
            square = float(off @ information @ off)
            if square < _LIKELY:
                out.append((square, other))
        return [other for _, other in sorted(out, key=lambda pair: pair[0])]

    def untwisted(self, state: BodyState, limb: NDArray) -> list[BodyState]:
        """The state with the last segment of a limb (segments) turned back about its own length, if that is far.

        A limb that is round about its length hardly shows its twist, and may turn to its joint's end unnoticed.
        """
        tree, out = self.body.tree, []
        for s in limb:
            if len(self._limbs[s]):
                continue
            along = self._ends.points[s] / max(float(np.linalg.norm(self._ends.points[s])), 1e-9)
            for d in range(tree.dof_start[s], tree.dof_start[s + 1]):
                if abs(tree.axes[d] @ along) > _ALONG and abs(state.angles[d] - tree.usual[d]) > _TWISTED:
                    angles = np.array(state.angles)
                    angles[d] = tree.usual[d]
                    out.append(BodyState(state.T_world_root, angles))
        return out

    def of(self, state: BodyState, camera: Camera) -> Iterator[BodyState]:
        """States in which one segment is mirrored in depth, with all that hangs on it shifted, or mirrored as well."""
        joints, ends = self.body.positions(state, self._joints), self.body.positions(state, self._ends)
        ray = joints - camera.centre_world
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        shift = -2.0 * np.sum((ends - joints) * ray, axis=1)[:, None] * ray
        leans = np.linalg.norm(shift, axis=1) > _LEAST
        for s in np.flatnonzero(leans & (self.body.tree.parents >= 0)):
            below = self._below(int(s))
            targets = np.array(ends)
            targets[[int(s), *below]] += shift[s]
            yield from self._turned(state, int(s), below, targets)
            if len(below) and leans[below].any():
                targets = targets.copy()
                for t in below:
                    targets[[t, *self._below(t)]] += shift[t]
                yield from self._turned(state, int(s), below, targets)

    def _below(self, s: int) -> list[int]:
        return [t for child in self._limbs[s] for t in (int(child), *self._below(int(child)))]

    def _turned(self, state: BodyState, s: int, below: list[int], ends: NDArray) -> Iterator[BodyState]:
        """The state with a limb's ends (S, 3) [m] elsewhere, where its joints let it come there."""
        tree, limb, above = self.body.tree, [s, *below], tree_path(self.body, s)
        free = np.concatenate([np.zeros(6, bool), np.isin(tree.owners, [*limb, *above])])
        sigma = np.where(free, _FREE, _HELD)
        targets = np.full_like(ends, np.nan)
        targets[[*limb, *above]] = ends[[*limb, *above]]
        found = levenberg_marquardt(
            self.body, state,
            lambda at: [point_rows(self.body, at, self._ends, targets, sigma=_SIGMA),
                        prediction_rows(self.body, at, state, sigma=sigma)],
            max_iterations=_STEPS, tolerance=1e-2,
        ).state  # fmt: skip
        away = np.linalg.norm(self.body.positions(found, self._ends) - ends, axis=1)
        if away[[*limb, *above]].max() < _REACHED:
            yield found


def tree_path(body: Body, s: int) -> list[int]:
    """Segments between one and the root, both left out."""
    out, p = [], int(body.tree.parents[s])
    while p >= 0 and body.tree.parents[p] >= 0:
        out.append(p)
        p = int(body.tree.parents[p])
    return out
