"""What is lost is sought, and taken where more speaks for it: a limb in a view, a whole body in all that was seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.limbs import limbs
from kinefit.fitting.frame.fit import Fitted
from kinefit.fitting.frame.prediction import marginal_information
from kinefit.fitting.frame.results import ROOT_PRIOR_STD, FrameResult, evidence_of, sum_evidence
from kinefit.fitting.frame.routing import Sensors
from kinefit.fitting.initialization import candidates
from kinefit.fitting.initialization.depth_search import PostureSearch
from kinefit.geometry.camera import Rig
from kinefit.sensors.base import Measurement
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.solving.equations import inverse

_SPEED = 3.0  # [m/s] of a hand in a brisk wave; a limb found farther away than that must be the more certain
_ANEW = 0.3  # [s] between frames in which a pose becomes any other: what limbs are not found is sought with the whole
_TURN = 1.0  # [s] for which a person still faces about where it faced
_STRIDE = 0.5  # [m] by which a root is found elsewhere without a step
_GAIN = 0.1  # of the support, by which a start must be better than what was tracked


def is_rare(rate: float) -> bool:
    """Whether images are so far apart (rate [Hz]) that a pose becomes any other from one to the next."""
    return rate < 1.0 / _ANEW


class Searching(Protocol):
    """What searches need of a tracker; see `Tracker`."""

    sensors: Sensors
    others: tuple[Scene, ...]

    @property
    def velocity(self) -> NDArray:
        """(n,) [m, rad] a frame, of the last one."""
        ...

    def scene_of(self, state: BodyState, time: float = 0.0) -> Scene:
        """The body in a state."""
        ...

    def fitted(self, time: float, frames: Sequence[Any], state: BodyState, held: Any = None) -> Fitted:
        """What comes of a fit that begins at a state."""
        ...

    def restart(self, result: FrameResult, velocity: NDArray | None = None) -> None:
        """Go on from a result, with a velocity (n,) [m, rad] a frame or an unknown one."""
        ...


class Recovery:
    """Searches of one tracker: time of the last search, and since when a segment is lost.

    Parameters
    ----------
    body, rig, up, settings, rate : as of the `Tracker`
    """

    state_attributes = ("_good", "_root", "_sought", "_lost_since")  # see `save_state`

    def __init__(self, body: Body, rig: Rig, up: NDArray, settings: TrackSettings, rate: float) -> None:
        self.body, self.rig, self.up, self.settings, self.rate = body, rig, up, settings, rate
        self._good = np.full(len(body.tree.segments), -np.inf)  # [s] when each segment was last where it was thought
        self._root: NDArray | None = None  # (4, 4) where the root was then
        self._of_limbs = np.isin(np.arange(len(self._good)), [s for b in limbs(body) if len(b) > 1 for s in b])
        self.forget()

    def forget(self) -> None:
        """Of the time before a pause."""
        self._sought = self._lost_since = -np.inf

    def started(self, state: BodyState) -> None:
        """A state that is known for the time of the next search."""
        self._root, self._good[0] = state.T_world_root, np.nan

    def clocks(self) -> tuple[float, float]:
        """When the last search was, and since when something is lost [s]."""
        return self._sought, self._lost_since

    def set_clocks(self, clocks: tuple[float, float]) -> None:
        """As `clocks` gave them."""
        self._sought, self._lost_since = clocks

    def run(
        self, tracker: Searching, time: float, frames: Sequence[Any], measurements: Sequence[Measurement],
        result: FrameResult | None, guess: BodyState | None = None,
    ) -> FrameResult | None:  # fmt: skip
        """The result of one time, or a better one that was found; `guess`: where the body may be, by an earlier fit.

        Where images are rare, limbs that could be what nothing explains are said to be unplaced, and so are segments of
        limbs of which the one before is not seen: no earlier image holds them.
        """
        result = self._best(tracker, time, frames, measurements, result, guess)
        if result is None or not self.settings.search or not is_rare(self.rate):
            return result
        search = self._search(tracker, time, measurements, result)
        doubtful = np.zeros(len(result.lost), bool)
        if search is not None and search.score.missing(result.state) > candidates.LEAP:
            x = np.concatenate(search.score.unexplained(result.state))
            near = [s for limb in search.limbs for s in limb if search.within_reach(result.state, limb, x).mean() > 0.5]
            doubtful[near] = True
        for m in result.measurements:
            m.doubt(doubtful)
        scene = tracker.scene_of(result.state, time)
        evidence = sum_evidence(scene, evidence_of(scene, result.matched))
        return replace(result, segment_quality=evidence.segment_quality(self.body.tree))

    def _best(
        self, tracker: Searching, time: float, frames: Sequence[Any], measurements: Sequence[Measurement],
        result: FrameResult | None, guess: BodyState | None,
    ) -> FrameResult | None:  # fmt: skip
        s, search = self.settings, None
        rare = s.search and is_rare(self.rate)
        if guess is not None:
            found = tracker.fitted(time, frames, guess).result
            if not _astray(found, s.poor) and (result is None or _better(found, result)):
                result = found
                tracker.restart(found)
        if np.isnan(self._good[0]):
            self._good[0] = time
        if result is None or result.support < s.support:
            result = self._from_points(tracker, time, frames, measurements, result)
        if result is not None:
            lost = result.lost | (~result.hidden & (result.segment_quality < s.doubtful))
            seek = lost
            if rare:
                search = self._search(tracker, time, measurements, result)
            if search is not None and search.score.missing(result.state) > candidates.LEAP:  # a limb may lie on another
                seek = lost | self._of_limbs
            self._good[~seek] = time
            if not seek[0]:
                self._root = result.state.T_world_root
            if not seek.any():
                self._lost_since = time
                return result
        waited = result is None or abs(time - self._lost_since) >= s.search_after  # a track may run backwards
        if not s.search or not waited or abs(time - self._sought) < s.search_every - 0.25 / self.rate:
            return result
        self._sought = time
        if result is None or _astray(result, s.poor):
            return self._from_views(tracker, time, frames, result)
        search = search or self._search(tracker, time, measurements, result)
        if search is not None:
            result = self._limbs(tracker, time, frames, search, result, seek, lost)
        if rare:
            search = self._search(tracker, time, measurements, result)
            missing = search is not None and search.score.missing(result.state) > candidates.LEAP
            if result.lost.any() or missing:
                return self._from_views(tracker, time, frames, result, search if missing else None)
        return result

    def _from_points(
        self, tracker: Searching, time: float, frames: Sequence[Any], measurements: Sequence[Measurement],
        result: FrameResult | None,
    ) -> FrameResult | None:  # fmt: skip
        """A start from points that are known in space, which costs little; from rays as often as a search runs."""
        scene = tracker.scene_of(self.body.default_state(np.eye(4)), time)
        known = measurements or tracker.sensors.measurements(frames, scene, points=True)
        rays = result is None or abs(time - self._sought) >= self.settings.search_every - 0.25 / self.rate
        for state in candidates.starts_from_points(self.body, known, scene, self.up, rays=rays):
            found = tracker.fitted(time, frames, state).result
            if result is None or found.support > result.support + _GAIN:
                result, self._lost_since = found, time
                tracker.restart(found)
        return result

    def _from_views(
        self, tracker: Searching, time: float, frames: Sequence[Any], result: FrameResult | None,
        search: PostureSearch | None = None,
    ) -> FrameResult | None:  # fmt: skip
        """A start from what shows a whole person; `search`, where much about the result is left out by it."""
        state, own = self.body.default_state(np.eye(4)), tracker.sensors
        scene = tracker.scene_of(state, time).at(state, others=tracker.others)
        elapsed = abs(time - self._good[0])
        known = self._root if elapsed <= _TURN + 1e-6 else None
        here = None if result is None or _astray(result, self.settings.poor) else result.state.T_world_root
        began = result
        for states in candidates.starts_from_views(
            scene, frames, self.up, own.measurements(frames, scene, points=True),
            backgrounds=own.stated, forward=None if known is None else known[:3, 0],
        ):  # fmt: skip
            near = [s for s in states if known is None or _gone(s.T_world_root, known) <= _STRIDE + _SPEED * elapsed]
            if here is not None:  # but for a limb or two, the body is where it is thought to be
                near = [s for s in near if _gone(s.T_world_root, here) <= _STRIDE]
            if not near:
                break  # somebody else
            for state in near:
                found = tracker.fitted(time, frames, state).result
                poor = _astray(found, self.settings.poor)
                allowed = not poor if result is None else not poor or _astray(result, self.settings.poor)
                if allowed and self._preferred(tracker, found, result, began, search):
                    result, self._lost_since = found, time
                    tracker.restart(found)
            if result is not None and not _astray(result, self.settings.poor):
                if search is None or search.score.missing(result.state) <= candidates.LEAP:
                    break  # another attempt costs as much
        return result

    def _preferred(
        self, tracker: Searching, new: FrameResult, old: FrameResult | None, began: FrameResult | None,
        search: PostureSearch | None,
    ) -> bool:  # fmt: skip
        """Whether a start is taken in place of what was tracked, or of another start: of these the view decides.

        A body that faces away from the sensor shows as many segments as one that faces it.
        """
        if old is None or old is began:
            return old is None or _better(new, old) or _explains(search, new, old)
        view = self._search(tracker, old.time, old.measurements, old)
        if view is None or _gone(new.state.T_world_root, old.state.T_world_root) > _STRIDE:
            return _better(new, old)
        values = [view.value(r.state) - candidates.LEAP * _against(tracker, r) for r in (new, old)]
        return values[0] > values[1]

    def _limbs(
        self, tracker: Searching, time: float, frames: Sequence[Any], search: PostureSearch, result: FrameResult,
        seek: NDArray, lost: NDArray,
    ) -> FrameResult:  # fmt: skip
        free = candidates.dofs_of_limbs(self.body, seek)
        std = np.minimum(result.dof_std, np.where(np.arange(len(free)) < 6, ROOT_PRIOR_STD, np.pi))
        held = result.state, marginal_information(inverse(np.diag(std**2)), free)
        now = best = search.score.of(result.state) - candidates.LEAP * _against(tracker, result)
        for state, least in candidates.find_limbs(search, result.state, seek, lost):
            found = tracker.fitted(time, frames, state, held).result
            value = search.score.of(found.state) - candidates.LEAP * _against(tracker, found)
            if not self._shown(tracker, found, lost):
                continue
            if value > max(best, now + least * self._leap(time, result, found, seek)):
                best, result, self._lost_since = value, found, time
                tracker.restart(found, np.where(free, 0.0, tracker.velocity))
        return result

    def _search(
        self, tracker: Searching, time: float, measurements: Sequence[Measurement], result: FrameResult
    ) -> PostureSearch | None:
        """In the first view that there is of what was measured."""
        scene = tracker.scene_of(result.state, time)
        surfaces = [m for m in measurements if not m.settled]  # points by name show no limb that could be sought
        view = next((v for m in surfaces if (v := m.hints(scene).view) is not None), None)
        return None if view is None else PostureSearch(self.body, view, self.up, np.random.default_rng(0))

    def _shown(self, tracker: Searching, found: FrameResult, seek: NDArray) -> bool:
        """Whether the surfaces show something of each limb that was found: else it would hide."""
        scene = tracker.scene_of(found.state, found.time)
        views = [m for m in found.matched if m.shows_surface]
        hidden = np.ones(len(seek), bool)
        for m in views:
            hidden &= m.evidence(scene).hidden
        parts = limbs(self.body)
        sought = [list(limb) for limb in parts if seek[list(limb)].any()]
        trunk = np.isin(np.arange(len(seek)), [s for limb in parts for s in limb], invert=True)
        return not (hidden & seek & trunk).any() and not any(hidden[limb].all() for limb in sought)

    def _leap(self, time: float, old: FrameResult, new: FrameResult, seek: NDArray) -> float:
        """Speed of a limb's jump from its last observed place, over that of a brisk wave; at least 1."""
        elapsed = max(float(np.abs(time - self._good[seek]).max()), 1.0 / self.rate)
        points = self.body.landmarks
        gone = self.body.positions(new.state, points) - self.body.positions(old.state, points)
        return max(float(np.linalg.norm(gone, axis=1).max(initial=0.0)) / (_SPEED * elapsed), 1.0)


def _against(tracker: Searching, result: FrameResult) -> float:
    """How many points a result does not agree with; half for one that is ten deviations off."""
    scene = tracker.scene_of(result.state, result.time)
    square = np.concatenate([np.zeros(0), *(m.squares(scene) for m in result.matched if m.of_points)])
    return float(np.sum(1.0 - 100.0 / (square + 100.0)))


def _gone(new: NDArray, old: NDArray) -> float:
    """[m] between two roots (4, 4)."""
    return float(np.linalg.norm(new[:3, 3] - old[:3, 3]))


def _astray(result: FrameResult, poor: float) -> bool:
    """Whether the whole body is lost: its root is, or too little of what is seen of it agrees."""
    seen = result.segment_quality[~result.hidden]
    return bool(result.lost[0]) or float(seen.mean() if len(seen) else 0.0) < poor


def _explains(search: PostureSearch | None, new: FrameResult, old: FrameResult) -> bool:
    """Less of the person is missing, by a limb at least, and nothing that was explained before is in its place."""
    if search is None or search.score.of(new.state) <= search.score.of(old.state):
        return False
    return search.score.missing(new.state) < search.score.missing(old.state) - candidates.LEAP


def _better(new: FrameResult, old: FrameResult) -> bool:
    """More segments are seen where they are thought to be, less those that are lost; or as many, and more agrees."""
    found = [int((~r.hidden & ~r.lost).sum()) - int(r.lost.sum()) for r in (new, old)]
    return found[0] > found[1] or (found[0] == found[1] and new.quality > old.quality + 0.05)
