"""Where else a body may be than where its contour was found: as a whole, a limb mirrored, a limb somewhere else.

Limbs that lean towards the camera or away from it by the same angle look nearly the same: both are looked at.

A segment's end mirrored in depth about its joint has nearly the same contour; only its size in the image, some percent,
and what it hides tell one from the other (Sminchisescu and Triggs, Kinematic jump processes, CVPR 2003). A limb that
passes through the image's plane may come out of it on either side, and be followed on the wrong one from then on.
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
    """What one sensor has of a body for its searches, and whose turn it is.

    Parameters
    ----------
    scene : Scene with the body
    label : (T,) part of the body that each face of its skin belongs to
    settings : TrackSettings
    searches : of limbs: number and time [s] of the last one, and the state of its random numbers; written in place
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
        self, scene: Scene, camera: Camera, seen: Coloured, information: NDArray | None, told: Evidence
    ) -> list[BodyState]:
        """Of the body as a whole; see `region_starts`."""
        return region_starts(
            scene, camera, self._seeker, seen, information, told, self._settings.regions.search,
            rigid=not self._jointed,
        )  # fmt: skip

    def limbs(
        self, scene: Scene, camera: Camera, seen: Coloured, information: NDArray, told: Evidence, found: BodyState,
        time: float,
    ) -> list[BodyState]:  # fmt: skip
        """Of limbs, at most every `TrackSettings.search_every`: some mirrored, and one sought, which is lost if any is.

        Parameters
        ----------
        found : the state that was found, of which `told` says how it agrees
        """
        limbs, flips, s, last = self._limbs, self._flips, self._settings, self._searches
        if not limbs.segments or abs(time - last.get("time", -np.inf)) < s.search_every - 1e-6:
            return []
        last["time"], last["number"] = time, last.get("number", 0) + 1
        poor = [k for k, limb in enumerate(limbs.segments) if (told.quality[limb] < BELIEVED).any()]
        turns = poor or range(len(limbs.segments))
        limb = turns[last["number"] % len(turns)]
        near = flips.near(scene.state, information, found, camera)[: s.regions.flips]
        sought = limbs.sought(limb, found, list(flips.of(found, camera)), seen, camera)
        last["random"] = limbs.random.bit_generator.state
        leapt = [sought] if np.abs(sought.angles - found.angles).max() > 0.0 else []
        return [*near, *leapt, *flips.untwisted(found, limbs.segments[limb])]


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
