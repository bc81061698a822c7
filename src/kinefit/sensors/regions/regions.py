"""Region-based contour tracking in colour images, without masks or a background plate (P3 2.4).

Each point of the rendered occluding contour searches along its normal for the change from the body's colours to the
background's. The likelihood of every position on a line gives one row: its mean is the residual, its variance the
row's variance. Lines on which no position is likely have no weight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.geometry.losses import Loss, geman_mcclure
from kinefit.images import _kernels_regions as kernels
from kinefit.images.regions import Ratios, RegionColours, colour_bins
from kinefit.observations import ColourFrame
from kinefit.sensors.base import Leftover, Matched, Measurement, Sensor, by_segments
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.regions.region_parts import OTHER, SEAM_SPACING_PX, Coloured, Drawn, Lines, Parts, Seams, kept
from kinefit.sensors.regions.region_search import Starts
from kinefit.sensors.regions.silhouette import contour_rows
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.solving.correspondences.contours.outlines import Rim
from kinefit.solving.rows import AnyRows, weighted


@dataclass(frozen=True, eq=False)
class RegionMatched(Matched):
    """A colour image with the positions of the contour along its normals.

    Parameters
    ----------
    measurement : RegionMeasurement
    rim : Rim, N points of the body's occluding contour, of edges of its mesh
    place : (4, N) u, v [px] of the contour in the image, and unit normals
    weight : (N,) [1/px²]
    loss : Loss
    seams : Seams, optional
    off, sure : (M,) [px], [1/px²] offset of each seam point from the image's seam, and its weight
    """

    measurement: RegionMeasurement
    rim: Rim
    place: NDArray
    weight: NDArray
    loss: Loss
    seams: Seams | None
    off: NDArray
    sure: NDArray
    of_points = False

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """One row a line: the body's point should project onto the image's contour; one row a seam point."""
        seams = [] if self.seams is None else [self.seams.rows(scene, self.off, self.sure, self.loss)]
        rows = contour_rows(scene, self.rim, scene.placed(self.measurement.of.camera), self.place, 1.0)
        return [replace(weighted(rows, rows.weight * self.weight[rows.group]), loss=self.loss), *seams]

    def evidence(self, scene: Scene) -> Evidence:
        """Share of each segment's contour at which the colours change as expected, and at which they do not."""
        return self.measurement.evidence(scene)

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """Distances [px], in the camera's own image, of the image's contour from the body's, by segments."""
        uv = scene.placed(self.measurement.of.camera).project(self.rim.on(scene.pose.vertices))
        away = np.sum(self.place[2:].T * (self.place[:2].T - uv), axis=1)
        seen = np.isfinite(away) & (self.weight > 0.0)
        return [by_segments(self.sensor, scene.body, away[seen], self.rim.segment[seen], "px")]


_MIN_LEARN_SUPPORT = 0.6  # agreeing share of the evidence on a body of parts, before its colours are learnt
_MIN_INFORMATIVE_SHARE = 0.5  # of its contour's lines, before its colours are learnt: in a new light there are none
# A body of parts learns from its first images, then at intervals; people, whose clothes fold, from every image.
_WARM_UP_IMAGES = 10
_LEARN_INTERVAL_S = 0.05
_MAX_REACH_PX = 1e4  # of lines while the error of the prediction is unknown
_VERTEX_STRIDE = 16  # of the vertices that measure a body's motion
_MIN_LIKELIHOOD_GAIN = 200.0  # log likelihood that another limb must gain: 5 % of fits from wrong ones gain 90
_MAX_RENDER_SHIFT_PX = 1.0  # of a body since it was rendered: the width of its rendered edge
_GUARD_BAND_PX = 4.0  # about the contour, in which lines always count: the error of a state against its rendering
# The loss takes this share of the lines' median offset for one sigma: the fit then needs 5 steps in place of 6, and
# ends with the same loss; 1.5 (the sigma that a median stands for) let outliers in.
_MEDIAN_SHARE = 0.5
_JUDGE_STEP_PX = 2  # of the lines that judge a state: they reach twice as far as the last ones of the fit
_AGREEMENT_PX = 1.5  # within which a line supports its segment, or
_CONTOUR_AGREEMENT_SIGMAS = 3.0
_MIN_JUDGE_REACH = 4.0  # of judging lines, in agreement distances: a random offset agrees in a quarter of cases
# In rendered sequences without resets, at most a third of these lines disagree for 97 % of right poses, more for 65 %
# of wrong ones: a wrong silhouette agrees along half of its contour by chance.
_CONTRADICTION_WEIGHT = 2.0  # agreeing lines that one contradicting line outweighs


class RegionSensor(Sensor):
    """The colours inside and outside of a body's contour in one camera.

    Parameters
    ----------
    camera : Camera, whose name frames bear; the sensor's own is "region CAMERA".
    sigma : float [px] standard deviation of the contour, shape of the body included, in the camera's image.
        None for `TrackSettings.region` of a body of meshes, and `shape` of one of simple shapes, at its first distance.
    settings : TrackSettings
    """

    state_attributes = ("sigma", "_stated", "colours", "ratios", "reach", "_known", "_learnt", "_searches")

    def __init__(self, camera: Camera, sigma: float | None, settings: TrackSettings) -> None:
        self.sigma, self._stated = settings.region if sigma is None else sigma, sigma is not None
        self.name, self.camera, self.settings = f"region {camera.name}", camera, settings
        self.bins, self.count = colour_bins(settings.regions.space, settings.regions.levels)
        self.regions, self.colours = settings.regions, RegionColours.none(self.count, settings.regions)
        self.ratios: Ratios | None = None
        self.reach, self._searches = _MAX_REACH_PX, dict[str, Any]()  # [px] error of the prediction; of `Starts`
        self._parts: Parts | None = None
        self._starts: Starts | None = None
        self._known, self._learnt = False, -np.inf  # colours of the body are known; [s] when last learnt

    def parts(self, scene: Scene) -> Parts:
        """Parts of the body with their own colours."""
        if self._parts is None:
            self._parts = Parts(scene.body, scene.surface.morphing.mesh, self.regions.anchors, self.regions.parts)
        return self._parts

    def starts(self, scene: Scene) -> Starts:
        """Searches for the body and its limbs."""
        if self._starts is None:
            self._starts = Starts(scene, self.parts(scene).label, self.settings, self._searches)
        return self._starts

    def prepare(self, frame: ColourFrame, scene: Scene) -> RegionMeasurement:
        """The measurement of one image with the learnt colours; at first with those at the scene's state.

        Raises
        ------
        ObservationError
            An image of another size than the camera's.
        BodyError
            A body without surfaces.
        """
        if frame.size != self.camera.size:
            problem = f"images of {frame.sensor} have {frame.size} px, its camera {self.camera.size}"
            raise ObservationError(problem, remedy="Give images of the calibrated size.")
        m = RegionMeasurement(self, frame, scene)
        if not self._stated:
            self._stated = True
            if self.parts(scene).simple:
                self.sigma = max(self.sigma, self.settings.shape * m.pixels_per_metre(scene))
        m.first = not self._known
        if not self.colours.images:
            self._know(m, scene)
        assert self.ratios is not None
        m.seen = Coloured(frame.image, self.bins, self.ratios)
        return m

    def learn(self, measurement: RegionMeasurement, scene: Scene, sure: bool) -> None:
        """Learn the colours of a step in which the body was observed, and the error of its prediction."""
        if measurement.waits(scene):
            self.colours, self._known = RegionColours.none(self.count, self.regions), sure
            self._know(measurement, scene)
            return
        self._known, evidence = True, measurement.evidence(scene)
        parts, wrong = self.parts(scene), evidence.lost | evidence.hidden
        if parts.count > 1:  # some limb is often lost: learn from the others
            share = float(evidence.agreeing.sum()) / max(float((evidence.agreeing + evidence.contrary).sum()), 1e-9)
            sure = share > _MIN_LEARN_SUPPORT and measurement.clear > _MIN_INFORMATIVE_SHARE
        if not sure or evidence.hidden.all():
            self.reach = _MAX_REACH_PX
            return
        off = 2.0 * measurement.off(scene)
        self.reach = off if self.reach >= _MAX_REACH_PX else max(off, 0.7 * self.reach)
        often = parts.count == 1 or parts.simple or self.colours.images < _WARM_UP_IMAGES
        if often or abs(measurement.time - self._learnt) > _LEARN_INTERVAL_S:
            self._know(measurement, scene, wrong)
            self._learnt = measurement.time

    def _know(self, measurement: RegionMeasurement, scene: Scene, wrong: NDArray | None = None) -> None:
        self.colours = measurement.counted(scene, self.colours, wrong)
        self.ratios = self.colours.ratios(self.regions, self.parts(scene).of)


class RegionMeasurement(Measurement):
    """A colour image of one time, with the colour statistics for its comparison.

    Parameters
    ----------
    of : RegionSensor
    frame : ColourFrame
    scene : Scene with the body at its prediction.

    Attributes
    ----------
    image : (H, W, 3) uint8 RGB; None once it is compact
    seen : Coloured, which lines sample
    first : whether its colours are those at the predicted state
    clear : share 0..1 of the contour's lines that are informative, at the state judged last
    """

    settled = False

    def __init__(self, of: RegionSensor, frame: ColourFrame, scene: Scene) -> None:
        self.sensor, self.time, self.of = of.name, frame.time, of
        self.image: NDArray | None = frame.image
        self.seen: Coloured | None = None
        self.reach, self._spacing = of.reach, 0.0
        camera = scene.placed(of.camera)
        self._expected, z = self._few(scene), scene.state.T_world_root[:3, 3] @ camera.T_camera_world[2, :3]
        self.within = of.reach * max(z + camera.T_camera_world[2, 3], 0.0) / camera.matrix[0, 0]
        self._last: tuple[NDArray, Camera, Rim] | None = None
        self._lines: Lines | None = None
        self._judgement: tuple[tuple[BodyState, Body, Camera], Evidence] | None = None
        self._judged: BodyState | None = None
        self.clear, self.first = 0.0, False

    def _few(self, scene: Scene) -> NDArray:
        return scene.placed(self.of.camera).project(scene.pose.vertices[::_VERTEX_STRIDE])

    def waits(self, scene: Scene) -> bool:
        """Whether it has no weight yet: colours are unknown, and a depth image constrains the body."""
        return self.first and any(m.depth_image() is not None for m in scene.measurements)

    def pixels_per_metre(self, scene: Scene) -> float:
        """[px/m] scale of the image at the body's distance."""
        camera = scene.placed(self.of.camera)
        z = float(np.median(scene.pose.vertices[::_VERTEX_STRIDE] @ camera.T_camera_world[2, :3]))
        return float(camera.matrix[0, 0]) / max(z + camera.T_camera_world[2, 3], 0.1)

    def off(self, scene: Scene) -> float:
        """[px] largest distance of the body from its prediction in the image."""
        return float(np.nanmax(np.abs(self._few(scene) - self._expected), initial=0.0))

    def rim(self, scene: Scene) -> Rim:
        """The occluding contour at a scene's state, also of parts before others; cached for the latest state."""
        vertices, camera = scene.pose.vertices, scene.placed(self.of.camera)
        if self._last is None or self._last[0] is not vertices or self._last[1] is not camera:
            finder, others = scene.surface.rims(camera), [s for s in scene.others if s.body.surfaces]
            rim = finder.find(
                vertices, camera, spacing=self._spacing or 1.0, inner=self.of.parts(scene).count > 1,
                stale=0.0 if others and self._last is None else _MAX_RENDER_SHIFT_PX, close=self.of.settings.outline,
                others=[(s.pose.vertices, s.surface.morphing.mesh.faces) for s in others],
            )  # fmt: skip
            if not self._spacing:  # the first contour gives its length
                self._spacing = max(len(rim) / self.of.regions.lines, 1.0)
                count = int(len(rim) / self._spacing)
                rim = rim.chosen((np.arange(count) * self._spacing).astype(np.int64))
            self._last = vertices, camera, rim
        return self._last[2]

    def _drawn(self, scene: Scene) -> Drawn:
        """The body as last rendered."""
        finder, parts = scene.surface.rims(scene.placed(self.of.camera)), self.of.parts(scene)
        w = finder.window
        return Drawn(finder.face, parts.label, w.left, w.top, w.scale, parts.joined)

    def counted(self, scene: Scene, before: RegionColours, wrong: NDArray | None = None) -> RegionColours:
        """Colour statistics updated with this image, with the body at a scene's state.

        Segments that are `wrong` (S,) bool are excluded.
        """
        of, s, rim, image = self.of, self.of.regions, self.rim(scene), self.image
        rim = rim.chosen(~rim.inner if wrong is None else ~(rim.inner | wrong[rim.segment]))
        if not len(rim) or image is None:
            return before
        parts = of.parts(scene)
        if not before.images:
            before = RegionColours.none(of.count, s, parts.count)
        low, high = rim.outline[:2].min(axis=1), rim.outline[:2].max(axis=1)
        margin = 0.25 * (high - low).sum() + 8.0  # about as wide as half the body
        box, drawn = np.concatenate([low - margin, high + margin]).astype(np.int64), self._drawn(scene)
        if wrong is not None and wrong.any():
            drawn = drawn._replace(label=np.where(wrong[scene.surface.morphing.mesh.face_segment], OTHER, drawn.label))
        inside, outside = np.zeros((parts.count, of.count)), np.zeros((2, of.count))
        kernels.count(image, of.bins, *drawn[:5], box, inside, *outside)

        def lines(weight: NDArray, into: NDArray) -> None:
            at = parts.lines(rim, drawn)
            kernels.count_lines(image, of.bins, at.outline, at.anchor, s.half, *drawn, at.own, weight, into)

        return before.blended(inside, outside, lines, s)

    def profiles(self, scene: Scene, rim: Rim, step: int) -> NDArray:
        """(N, 2 half) log ratios along the normals of a contour, sampled every `step` [px]."""
        assert self.seen is not None
        drawn = self._drawn(scene)
        self._lines = self.of.parts(scene).lines(rim, drawn)
        return self.seen.profiles(self._lines, drawn, self.of.regions.half, step, _GUARD_BAND_PX)

    def match(self, scene: Scene, reach: float) -> RegionMatched:
        """Locate the body's contour along its normals; `reach` is the correspondence distance [m]."""
        of, s, rim = self.of, self.of.regions, self.rim(scene)
        step = max(min(round(reach / of.settings.near), math.ceil(self.reach / s.half)), 1)
        lines, found = self.profiles(scene, rim, step), np.empty((3, len(rim)))  # offset, variance, information
        kernels.places(lines, float(step), s.heat, found)
        if s.rule == "shift":
            kernels.shifts(lines, float(step), found[:2])
        place = np.array(rim.outline)
        place[:2] += found[0] * place[2:]
        # Errors are alike along a piece of the contour, which several lines cross.
        share = min(self._spacing / self._drawn(scene).scale / s.alike, 1.0)
        weight = np.where(found[2] > s.tells, share / (found[1] + of.sigma**2), 0.0)
        if self.waits(scene):
            return RegionMatched(self, rim, place, 0.0 * weight, geman_mcclure(s.loss), None, found[0], found[1])
        # While the body is off, so are most lines: outliers are those with larger offsets than the others.
        off = np.sort((np.square(found[0]) * weight)[weight > 0.0])
        spread = max(_MEDIAN_SHARE * math.sqrt(off[len(off) // 2]), math.sqrt(share)) if len(off) else math.sqrt(share)
        loss = geman_mcclure(s.loss * spread)
        seams = self._seams(scene, step)
        return RegionMatched(self, rim, place, weight, loss, *seams)

    def _seams(self, scene: Scene, step: int) -> tuple[Seams | None, NDArray, NDArray]:
        """Seams between parts of the body, their offsets (M,) [px] in the image and their weights (M,) [1/px²]."""
        of, s, none = self.of, self.of.regions, np.zeros(0)
        parts, camera, seen = of.parts(scene), scene.placed(of.camera), self.seen
        known = parts.count > 1 and not parts.simple and scene.surface.morphing.is_rigid
        if not known or seen is None or self.image is None:
            return None, none, none
        drawn = self._drawn(scene)
        seams = Seams.found(scene, scene.surface.rims(camera), camera, drawn, parts.group)
        found = np.empty((3, len(seams)))
        kernels.places(seen.profiles(seams.lines, drawn, s.half, step, _GUARD_BAND_PX), float(step), s.heat, found)
        share = min(SEAM_SPACING_PX / drawn.scale / s.alike, 1.0)
        return seams, found[0], np.where(found[2] > s.tells, share / (found[1] + of.sigma**2), 0.0)

    def starts(self, scene: Scene, information: NDArray | None, evidence: Evidence) -> Sequence[BodyState]:
        """Start states by colours alone, if the prediction is uncertain, or the fit disagrees with the image.

        If no other sensor measured a body of parts, also of its limbs. information (n, n) is of the prediction.
        """
        of, seen, camera, found = self.of, self.seen, scene.placed(self.of.camera), self._judged
        if self.image is None or seen is None or not of.settings.search or self.waits(scene):
            return ()
        whole = of.starts(scene).whole(scene, camera, seen, information, evidence)
        if whole or information is None or found is None or not self._alone(scene):
            return whole
        return of.starts(scene).limbs(scene, camera, seen, information, evidence, found, self.time)

    def _alone(self, scene: Scene) -> bool:
        """Whether this is the only measurement of a body of rigid parts: then its colours alone locate the limbs."""
        return scene.surface.morphing.is_rigid and self.of.parts(scene).count > 1 and len(scene.measurements) == 1

    def better(self, new: Scene, old: Scene) -> bool | None:
        """Whether the new state has the higher likelihood of all pixels; None unless colours alone locate the limbs."""
        if self.image is None or not self._alone(new):
            return None
        gain = self._explained(new) - self._explained(old)
        self._last = None  # the latest rendering is of the old state
        return gain > _MIN_LIKELIHOOD_GAIN

    def _explained(self, scene: Scene) -> float:
        """Log likelihood ratio of the image with the body at a scene's state against no body."""
        assert self.seen is not None
        camera = scene.placed(self.of.camera)
        x, close = scene.pose.vertices, self.of.settings.outline
        scene.surface.rims(camera).find(x, camera, spacing=_MAX_REACH_PX, close=close)
        return kernels.likelihood(self.seen.image, self.seen.bins, self.seen.ratios.logs, *self._drawn(scene)[:5])

    def evidence(self, scene: Scene) -> Evidence:
        """Share of each segment's contour at which the colours change as expected, and at which they do not."""
        if self.waits(scene):
            return Evidence.none(len(scene.body.tree.segments))
        self._judged = scene.state
        about = scene.state, scene.body, scene.placed(self.of.camera)
        if self._judgement is not None and all(a is b for a, b in zip(self._judgement[0], about)):
            return self._judgement[1]
        rim, areas = self.rim(scene), scene.surface.areas
        found, agrees = np.empty((3, len(rim))), max(_AGREEMENT_PX, _CONTOUR_AGREEMENT_SIGMAS * self.of.sigma)
        step = max(_JUDGE_STEP_PX, math.ceil(_MIN_JUDGE_REACH * agrees / self.of.regions.half))
        kernels.places(self.profiles(scene, rim, step), float(step), self.of.regions.heat, found)
        informative, here = found[2] > self.of.regions.tells, np.abs(found[0]) < agrees
        agreeing = np.bincount(rim.segment[informative & here], minlength=len(areas))
        contrary = np.bincount(rim.segment[informative & ~here], minlength=len(areas))
        spacing = self._spacing / self._drawn(scene).scale
        whole = np.maximum(np.sqrt(np.pi * areas) * self.pixels_per_metre(scene) / spacing, 1.0)  # points, if alone
        out = Evidence(agreeing / whole, _CONTRADICTION_WEIGHT * contrary / whole)
        self._judgement, self.clear = (about, out), float(informative[~rim.inner].mean()) if (~rim.inner).any() else 0.0
        return out

    def compact(self) -> RegionMeasurement:
        """A copy with log ratios about the latest contour in place of the image."""
        out = copy(self)
        if self.image is not None and self.seen is not None and self._lines is not None:
            out.seen = kept(self.seen, self._lines, _JUDGE_STEP_PX * self.of.regions.half, self.of.regions.most)
        out.image = None
        return out

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_last": None, "_lines": None, "_judgement": None}
