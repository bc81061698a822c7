"""Alternative start states by colours: the whole body elsewhere, a limb mirrored in depth, a limb elsewhere.

A segment that is mirrored in depth about its joint has nearly the same contour. Only its size in the image, by some
percent, and its occlusions differ (Sminchisescu and Triggs, Kinematic jump processes, CVPR 2003). A limb that passes
through the image plane may come out on either side, and the tracker may stay on the wrong one.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.surfaces import segment_middles
from kinefit.correspondences import point_rows
from kinefit.correspondences.parameters import prediction_rows
from kinefit.geometry.camera import Camera
from kinefit.motion import BELIEVED
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.regions.region_image import Coloured
from kinefit.sensors.regions.region_limbs import Limbs
from kinefit.sensors.regions.region_search import Seeker, region_starts
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.solvers.least_squares import levenberg_marquardt


class Starts:
    """Searches of one sensor for a body and its limbs, which take turns.

    Parameters
    ----------
    scene : Scene with the body
    label : (T,) part of the body that each face of its skin belongs to
    settings : TrackSettings
    searches : number and time [s] of the latest search for a limb, and its random state; written in place
    """

    def __init__(self, scene: Scene, label: NDArray, settings: TrackSettings, searches: dict[str, Any]) -> None:
        self._body, self._mesh, self._label = scene.body, scene.surface.morphing.mesh, label
        self._jointed = len(scene.body.tree.segments) > 1
        self._settings, self._searches = settings, searches

    @cached_property
    def _seeker(self) -> Seeker:
        return Seeker(self._mesh.vertices, self._mesh.faces)

    @cached_property
    def _flips(self) -> Flips:
        tree, mesh = self._body.tree, self._mesh
        return Flips(self._body, segment_middles(mesh.vertices, mesh.segment, len(tree.segments)) - tree.rest)

    @cached_property
    def _limbs(self) -> Limbs:
        return Limbs(self._body, self._mesh, self._label, self._searches.get("random"))

    def whole(
        self, scene: Scene, camera: Camera, seen: Coloured, information: NDArray | None, evidence: Evidence
    ) -> list[BodyState]:
        """Start states of the whole body; information (n, n) of the prediction, see `region_starts`."""
        return region_starts(
            scene, camera, self._seeker, seen, information, evidence, self._settings.regions.search,
            rigid=not self._jointed,
        )  # fmt: skip

    def limbs(
        self, scene: Scene, camera: Camera, seen: Coloured, information: NDArray, evidence: Evidence, found: BodyState,
        time: float,
    ) -> list[BodyState]:  # fmt: skip
        """Start states of limbs, at most every `TrackSettings.search_every`: mirrored ones, and one by search.

        The searches take turns, among the lost limbs if there are any.

        Parameters
        ----------
        information : (n, n) of the prediction
        evidence : on the state `found` by the fit
        time : float [s]
        """
        limbs, flips, s, last = self._limbs, self._flips, self._settings, self._searches
        if not limbs.segments or abs(time - last.get("time", -np.inf)) < s.search_every - 1e-6:
            return []
        last["time"], last["number"] = time, last.get("number", 0) + 1
        poor = [k for k, limb in enumerate(limbs.segments) if (evidence.quality[limb] < BELIEVED).any()]
        turns = poor or range(len(limbs.segments))
        limb = turns[last["number"] % len(turns)]
        near = flips.near(scene.state, information, found, camera)[: s.regions.flips]
        sought = limbs.sought(limb, found, list(flips.of(found, camera)), seen, camera)
        last["random"] = limbs.random.bit_generator.state
        leapt = [sought] if np.abs(sought.angles - found.angles).max() > 0.0 else []
        return [*near, *leapt, *flips.untwisted(found, limbs.segments[limb])]


_MIN_FLIP_SHIFT = 0.06  # [m] of a mirrored end: with less both states converge to the same
_MAX_FLIP_MISS = 0.03  # [m] of an end from its mirrored position, which joint limits may exclude
_FLIP_END_SIGMA = 0.005  # [m] of the ends' positions in the fit that flips a limb
_FREE_SIGMA = 3.0  # [rad] or [m] of the flipped limb's coordinates
_FIXED_SIGMA = 1e-3  # [rad] or [m] of all other coordinates
_MAX_SQUARED_MAHALANOBIS = 30.0  # of a flip from the prediction
_MIN_TWIST_AXIS_COSINE = 0.9  # of a joint axis with the segment's own axis
_MIN_TWIST = 0.4  # [rad] from the default, that is worth a trial
_MAX_FLIP_ITERATIONS = 10  # of the fit that flips a limb


class Flips:
    """Mirrored states of one body's limbs: all segments but the root.

    Parameters
    ----------
    body : Body
    middle : (S, 3) [m] of each segment's surface, in its own frame: the end of a segment without children
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
        """Mirrored states that the prediction, of information (n, n), allows, in order of decreasing likelihood."""
        out = []
        for other in self.of(state, camera):
            off = predicted.difference(other)
            square = float(off @ information @ off)
            if square < _MAX_SQUARED_MAHALANOBIS:
                out.append((square, other))
        return [other for _, other in sorted(out, key=lambda pair: pair[0])]

    def untwisted(self, state: BodyState, limb: NDArray) -> list[BodyState]:
        """The state with the twist of a limb's last segment reset to the default, if it is large.

        The twist of a round limb is hardly observed, and may drift to its joint limit.

        Parameters
        ----------
        limb : (L,) int, segments
        """
        tree, out = self.body.tree, []
        for s in limb:
            if len(self._limbs[s]):
                continue
            along = self._ends.points[s] / max(float(np.linalg.norm(self._ends.points[s])), 1e-9)
            for d in range(tree.dof_start[s], tree.dof_start[s + 1]):
                twisted = abs(state.angles[d] - tree.usual[d]) > _MIN_TWIST
                if abs(tree.axes[d] @ along) > _MIN_TWIST_AXIS_COSINE and twisted:
                    angles = np.array(state.angles)
                    angles[d] = tree.usual[d]
                    out.append(BodyState(state.T_world_root, angles))
        return out

    def of(self, state: BodyState, camera: Camera) -> Iterator[BodyState]:
        """States with one segment mirrored in depth, its descendants shifted with it or mirrored as well."""
        joints, ends = self.body.positions(state, self._joints), self.body.positions(state, self._ends)
        ray = joints - camera.centre_world
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        shift = -2.0 * np.sum((ends - joints) * ray, axis=1)[:, None] * ray
        leans = np.linalg.norm(shift, axis=1) > _MIN_FLIP_SHIFT
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
        """The state fitted to moved ends (S, 3) [m] of a limb, if its joints can reach them."""
        tree, limb, above = self.body.tree, [s, *below], tree_path(self.body, s)
        free = np.concatenate([np.zeros(6, bool), np.isin(tree.owners, [*limb, *above])])
        sigma = np.where(free, _FREE_SIGMA, _FIXED_SIGMA)
        targets = np.full_like(ends, np.nan)
        targets[[*limb, *above]] = ends[[*limb, *above]]
        found = levenberg_marquardt(
            self.body, state,
            lambda at: [point_rows(self.body, at, self._ends, targets, sigma=_FLIP_END_SIGMA),
                        prediction_rows(self.body, at, state, sigma=sigma)],
            max_iterations=_MAX_FLIP_ITERATIONS, tolerance=1e-2,
        ).state  # fmt: skip
        away = np.linalg.norm(self.body.positions(found, self._ends) - ends, axis=1)
        if away[[*limb, *above]].max() < _MAX_FLIP_MISS:
            yield found


def tree_path(body: Body, s: int) -> list[int]:
    """Segments between one and the root, both excluded."""
    out, p = [], int(body.tree.parents[s])
    while p >= 0 and body.tree.parents[p] >= 0:
        out.append(p)
        p = int(body.tree.parents[p])
    return out
