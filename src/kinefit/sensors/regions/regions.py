"""A body's contour in a colour image, by the colours inside and outside of it (P3 2.4): no masks, no background plate.

Points of the occluding contour, as drawn at the state, each look along their normal: where along it do colours change
from the body's to those around it? The likelihood of every place gives one row a line, its residual the mean, its
variance the variance of that place. Lines that no place explains well tell nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.correspondences.contours.rims import Rim
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.images import _kernels_regions as kernels
from kinefit.images.regions import Ratios, RegionColours, colour_bins
from kinefit.losses import geman_mcclure
from kinefit.observations import ColourFrame
from kinefit.sensors.base import Measurement, Sensor
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.regions.region_image import Coloured, kept
from kinefit.sensors.regions.region_matched import RegionMatched
from kinefit.sensors.regions.region_parts import OTHER, Drawn, Lines, Parts
from kinefit.sensors.regions.region_seams import SPACING, Seams
from kinefit.sensors.regions.region_starts import Starts
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings

_LEARNT = 0.6  # share of what is seen of a body of parts that must speak for it, if its colours are to be learnt
_CLEAR = 0.5  # share of its outline that must tell anything: in a new light nothing does, at first
# Images, and then [s], after which colours of a body of parts are learnt; of people, whose clothes fold, of every one.
_FIRST, _OFTEN = 10, 0.05
_WIDE = 1e4  # [px] to which lines reach where nothing is known of how well the body is expected
_FEW = 16  # one vertex in so many tells how far a body has moved
_GAIN = 200.0  # logarithms by which another limb must explain the image better: of fits from wrong ones 5 % gain 90
_STALE = 1.0  # [px] by which a body may have moved since it was drawn: the width of its edge in the drawing
_GUARD = 4.0  # [px] about the contour in which a line always tells: as far as a state may be off its drawing
# Of the median offset of lines, in deviations, that the loss takes for one: the fit then needs 5 steps in place of 6,
# and at its end the loss is as it was; 1.5 (the deviation that a median stands for) let outliers in.
_SPREAD = 0.5
_JUDGED = 2  # [px] step of the lines by which a state is judged: they reach twice as far as the last ones of the fit
_AGREES = 1.5, 3.0  # [px], [deviations of the contour] within which a line speaks for its segment
_ROOM = 4.0  # times as far judging lines reach at least: one that points anywhere agrees in a quarter of cases
# Of rendered sequences in which nothing was reset, right poses have at most a third of such lines off in 97 %, wrong
# ones more than that in 65 %: a wrong silhouette agrees along half of its contour by chance.
_AGAINST = 2.0  # lines that agree, which one that does not outweighs


class RegionSensor(Sensor):
    """The colours inside and outside of a body's contour in one camera.

    Parameters
    ----------
    camera : Camera, whose name frames bear; the sensor's own is "region CAMERA".
    sigma : float [px] standard deviation of the contour, shape of the body included, in the camera's image.
        None for `TrackSettings.region` of a body of meshes, and `shape` of one of simple shapes where it is first seen.
    settings : TrackSettings
    """

    state_attributes = ("sigma", "_stated", "colours", "ratios", "reach", "_known", "_learnt", "_searches")

    def __init__(self, camera: Camera, sigma: float | None, settings: TrackSettings) -> None:
        self.sigma, self._stated = settings.region if sigma is None else sigma, sigma is not None
        self.name, self.camera, self.settings = f"region {camera.name}", camera, settings
        self.bins, self.count = colour_bins(settings.regions.space, settings.regions.levels)
        self.regions, self.colours = settings.regions, RegionColours.none(self.count, settings.regions)
        self.ratios: Ratios | None = None
        self.reach, self._searches = _WIDE, dict[str, Any]()  # [px] how far off the contour may be; of `Starts`
        self._parts: Parts | None = None
        self._starts: Starts | None = None
        self._known, self._learnt = False, -np.inf  # colours were counted of the body; [s] when they were last

    def parts(self, scene: Scene) -> Parts:
        """Parts of the body that have colours of their own."""
        if self._parts is None:
            self._parts = Parts(scene.body, scene.surface.morphing.mesh, self.regions.anchors, self.regions.parts)
        return self._parts

    def starts(self, scene: Scene) -> Starts:
        """What the body is sought with."""
        if self._starts is None:
            self._starts = Starts(scene, self.parts(scene).label, self.settings, self._searches)
        return self._starts

    def prepare(self, frame: ColourFrame, scene: Scene) -> RegionMeasurement:
        """The image with what is known of colours; before anything is known they are those at the scene's state.

        Raises
        ------
        ObservationError
            An image of another size than the camera's.
        BodyError
            A body without surfaces.
        """
        if frame.size != self.camera.size:
            problem = f"images of {frame.sensor} are {frame.size} px, its camera has {self.camera.size}"
            raise ObservationError(problem, remedy="Give images in the size of those that were calibrated.")
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
        """Blend in the colours of a step in which the body was seen; and how far it was from where it was expected."""
        if measurement.waits(scene):
            self.colours, self._known = RegionColours.none(self.count, self.regions), sure
            self._know(measurement, scene)
            return
        self._known, told = True, measurement.evidence(scene)
        parts, wrong = self.parts(scene), told.lost | told.hidden
        if parts.count > 1:  # some limb is often lost: what is not may well be learnt from
            share = float(told.agreeing.sum()) / max(float((told.agreeing + told.contrary).sum()), 1e-9)
            sure = share > _LEARNT and measurement.clear > _CLEAR
        if not sure or told.hidden.all():
            self.reach = _WIDE
            return
        off = 2.0 * measurement.off(scene)
        self.reach = off if self.reach >= _WIDE else max(off, 0.7 * self.reach)
        often = parts.count == 1 or parts.simple or self.colours.images < _FIRST
        if often or abs(measurement.time - self._learnt) > _OFTEN:
            self._know(measurement, scene, wrong)
            self._learnt = measurement.time

    def _know(self, measurement: RegionMeasurement, scene: Scene, wrong: NDArray | None = None) -> None:
        self.colours = measurement.counted(scene, self.colours, wrong)
        self.ratios = self.colours.ratios(self.regions, self.parts(scene).of)


class RegionMeasurement(Measurement):
    """A colour image of one time, with the statistics of colours that it is compared with.

    Parameters
    ----------
    of : RegionSensor
    frame : ColourFrame
    scene : Scene with the body where it is expected.

    Attributes
    ----------
    image : (H, W, 3) uint8 RGB; None once it is compact
    seen : Coloured, what lines look at
    first : whether its colours are those at the state at which the body was only expected
    clear : share of the outline's lines that tell anything at the state that was judged last
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
        self._told: tuple[tuple[BodyState, Body, Camera], Evidence] | None = None
        self._judged: BodyState | None = None
        self.clear, self.first = 0.0, False

    def _few(self, scene: Scene) -> NDArray:
        return scene.placed(self.of.camera).project(scene.pose.vertices[::_FEW])

    def waits(self, scene: Scene) -> bool:
        """Whether it tells nothing yet: no colours are known, and depth shows where the body is."""
        return self.first and any(m.depth_image() is not None for m in scene.measurements)

    def pixels_per_metre(self, scene: Scene) -> float:
        """[px/m] at the body's distance."""
        camera = scene.placed(self.of.camera)
        z = float(np.median(scene.pose.vertices[::_FEW] @ camera.T_camera_world[2, :3])) + camera.T_camera_world[2, 3]
        return float(camera.matrix[0, 0]) / max(z, 0.1)

    def off(self, scene: Scene) -> float:
        """[px] how far the body is from where it was expected, at most."""
        return float(np.nanmax(np.abs(self._few(scene) - self._expected), initial=0.0))

    def rim(self, scene: Scene) -> Rim:
        """The occluding contour at a scene's state, of parts before others too; kept for the state asked for last."""
        vertices, camera = scene.pose.vertices, scene.placed(self.of.camera)
        if self._last is None or self._last[0] is not vertices or self._last[1] is not camera:
            finder, others = scene.surface.rims(camera), [s for s in scene.others if s.body.surfaces]
            rim = finder.find(
                vertices, camera, spacing=self._spacing or 1.0, inner=self.of.parts(scene).count > 1,
                stale=0.0 if others and self._last is None else _STALE, close=self.of.settings.outline,
                others=[(s.pose.vertices, s.surface.morphing.mesh.faces) for s in others],
            )  # fmt: skip
            if not self._spacing:  # the first look tells how long the contour is
                self._spacing = max(len(rim) / self.of.regions.lines, 1.0)
                count = int(len(rim) / self._spacing)
                rim = rim.chosen((np.arange(count) * self._spacing).astype(np.int64))
            self._last = vertices, camera, rim
        return self._last[2]

    def _drawn(self, scene: Scene) -> Drawn:
        """The body as it was drawn last."""
        finder, parts = scene.surface.rims(scene.placed(self.of.camera)), self.of.parts(scene)
        w = finder.window
        return Drawn(finder.face, parts.label, w.left, w.top, w.scale, parts.joined)

    def counted(self, scene: Scene, before: RegionColours, wrong: NDArray | None = None) -> RegionColours:
        """What is known of colours, with those of this image, the body being where a scene has it.

        Of segments that are `wrong` (S,) bool nothing is learnt.
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
        """(N, 2 half) log ratios along the normals of a contour, in samples of `step` pixels."""
        assert self.seen is not None
        drawn = self._drawn(scene)
        self._lines = self.of.parts(scene).lines(rim, drawn)
        return self.seen.profiles(self._lines, drawn, self.of.regions.half, step, _GUARD)

    def match(self, scene: Scene, reach: float) -> RegionMatched:
        """Where along its normals the contour of the body is."""
        of, s, rim = self.of, self.of.regions, self.rim(scene)
        step = max(min(round(reach / of.settings.near), math.ceil(self.reach / s.half)), 1)
        lines, told = self.profiles(scene, rim, step), np.empty((3, len(rim)))
        kernels.places(lines, float(step), s.heat, told)
        if s.rule == "shift":
            kernels.shifts(lines, float(step), told[:2])
        place = np.array(rim.outline)
        place[:2] += told[0] * place[2:]
        # Errors are alike along a piece of the contour, of which several lines tell.
        share = min(self._spacing / self._drawn(scene).scale / s.alike, 1.0)
        weight = np.where(told[2] > s.tells, share / (told[1] + of.sigma**2), 0.0)
        if self.waits(scene):
            return RegionMatched(self, rim, place, 0.0 * weight, geman_mcclure(s.loss), None, told[0], told[1])
        # While the body is not where the image shows it most lines say so: outliers are those beyond the others.
        off = np.sort((np.square(told[0]) * weight)[weight > 0.0])
        spread = max(_SPREAD * math.sqrt(off[len(off) // 2]), math.sqrt(share)) if len(off) else math.sqrt(share)
        loss = geman_mcclure(s.loss * spread)
        seams = self._seams(scene, step)
        return RegionMatched(self, rim, place, weight, loss, *seams)

    def _seams(self, scene: Scene, step: int) -> tuple[Seams | None, NDArray, NDArray]:
        """Where parts of the body run into each other, how far off [px] and how sure [1/px²] that is in the image."""
        of, s, none = self.of, self.of.regions, np.zeros(0)
        parts, camera, seen = of.parts(scene), scene.placed(of.camera), self.seen
        known = parts.count > 1 and not parts.simple and scene.surface.morphing.is_rigid
        if not known or seen is None or self.image is None:
            return None, none, none
        drawn = self._drawn(scene)
        seams = Seams.found(scene, scene.surface.rims(camera), camera, drawn, parts.group)
        told = np.empty((3, len(seams)))
        kernels.places(seen.profiles(seams.lines, drawn, s.half, step, _GUARD), float(step), s.heat, told)
        share = min(SPACING / drawn.scale / s.alike, 1.0)
        return seams, told[0], np.where(told[2] > s.tells, share / (told[1] + of.sigma**2), 0.0)

    def starts(self, scene: Scene, information: NDArray | None, told: Evidence) -> Sequence[BodyState]:
        """Where colours alone show the body, if it is expected too roughly, or not where it was found.

        Of a body of parts that nothing else was measured of, also where its limbs may be.
        """
        of, seen, camera, found = self.of, self.seen, scene.placed(self.of.camera), self._judged
        if self.image is None or seen is None or not of.settings.search or self.waits(scene):
            return ()
        whole = of.starts(scene).whole(scene, camera, seen, information, told)
        if whole or information is None or found is None or not self._alone(scene):
            return whole
        return of.starts(scene).limbs(scene, camera, seen, information, told, found, self.time)

    def _alone(self, scene: Scene) -> bool:
        """Whether nothing else was measured of a body of rigid parts: its colours alone then tell where limbs are."""
        return scene.surface.morphing.is_rigid and self.of.parts(scene).count > 1 and len(scene.measurements) == 1

    def better(self, new: Scene, old: Scene) -> bool | None:
        """Of a body of parts: whether the colours of all its pixels say so."""
        if self.image is None or not self._alone(new):
            return None
        gain = self._explained(new) - self._explained(old)
        self._last = None  # what was drawn last is neither
        return gain > _GAIN

    def _explained(self, scene: Scene) -> float:
        """By how much better the body where a scene has it explains the image than no body does, in logarithms."""
        assert self.seen is not None
        camera = scene.placed(self.of.camera)
        scene.surface.rims(camera).find(scene.pose.vertices, camera, spacing=_WIDE, close=self.of.settings.outline)
        return kernels.likelihood(self.seen.image, self.seen.bins, self.seen.ratios.logs, *self._drawn(scene)[:5])

    def evidence(self, scene: Scene) -> Evidence:
        """Points of each segment's contour at which colours change as they should, and those at which they do not."""
        if self.waits(scene):
            return Evidence.none(len(scene.body.tree.segments))
        self._judged = scene.state
        about = scene.state, scene.body, scene.placed(self.of.camera)
        if self._told is not None and all(a is b for a, b in zip(self._told[0], about)):
            return self._told[1]
        rim, areas = self.rim(scene), scene.surface.areas
        told, agrees = np.empty((3, len(rim))), max(_AGREES[0], _AGREES[1] * self.of.sigma)
        step = max(_JUDGED, math.ceil(_ROOM * agrees / self.of.regions.half))
        kernels.places(self.profiles(scene, rim, step), float(step), self.of.regions.heat, told)
        tells, here = told[2] > self.of.regions.tells, np.abs(told[0]) < agrees
        agreeing = np.bincount(rim.segment[tells & here], minlength=len(areas))
        contrary = np.bincount(rim.segment[tells & ~here], minlength=len(areas))
        spacing = self._spacing / self._drawn(scene).scale
        whole = np.maximum(np.sqrt(np.pi * areas) * self.pixels_per_metre(scene) / spacing, 1.0)  # points, if alone
        out = Evidence(agreeing / whole, _AGAINST * contrary / whole)
        self._told, self.clear = (about, out), float(tells[~rim.inner].mean()) if (~rim.inner).any() else 0.0
        return out

    def compact(self) -> RegionMeasurement:
        """Without the image: log ratios about the contour as it was drawn last."""
        out = copy(self)
        if self.image is not None and self.seen is not None and self._lines is not None:
            out.seen = kept(self.seen, self._lines, _JUDGED * self.of.regions.half, self.of.regions.most)
        out.image = None
        return out

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_last": None, "_lines": None, "_told": None}
