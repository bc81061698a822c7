"""A recording as a moving 3D scene, frame by frame in a server, or as one page that needs none."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import Motion, known_median, nearest_frame
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Rig
from kinefit.observations import Markers
from kinefit.studio.viewers import figure, scene, stage
from kinefit.studio.viewers.stage import POLICY, CameraImages, open_server, quiet

if TYPE_CHECKING:
    import viser

LAYERS = (*figure.PARTS, "path", "points", "markers", "cameras", "images", "floor")
"""What can be shown and hidden."""

DEFAULT_LAYERS = figure.DEFAULT_PARTS | frozenset(LAYERS) - set(figure.PARTS)
"""What is shown at first."""

CYLINDERS = DEFAULT_LAYERS - figure.DEFAULT_PARTS | figure.CYLINDERS
"""The same with the body's cylinders and bones in place of a skin."""

ALL_CAMERAS, NO_CAMERA = "all cameras", "none"
_POINT, _MARKER, _PATH = (245, 205, 40), (225, 60, 120), (110, 120, 135)


@dataclass(frozen=True, eq=False)
class ViewerContent:
    """What there is to show.

    Parameters
    ----------
    motions : tuple of Motion
        The first one leads the time; the others are shown next to it in other colours, by time.
    rig : Rig, optional
    pictures : CameraImages, optional
    markers : tuple of Markers
        In the take's time: t = frame / rate + `marker_offsets`.
    marker_offsets : tuple of float [s]
    points : (F, K, 3) [m], optional
        Points to show as they are (triangulated keypoints), at `steps`; NaN where unknown.
    steps : (F,) [s], optional
        Times of the take.
    up : str, optional
        Vertical axis of the world; by default that of the first motion. The motions are turned to it.
    name : str

    Raises
    ------
    ObservationError
        There is nothing to show.
    """

    motions: tuple[Motion, ...] = ()
    rig: Rig | None = None
    pictures: CameraImages | None = None
    markers: tuple[Markers, ...] = ()
    marker_offsets: tuple[float, ...] = ()
    points: NDArray | None = None
    steps: NDArray | None = None
    up: str = ""
    name: str = "kinefit"

    def __post_init__(self) -> None:
        up = self.up or (self.motions[0].up if self.motions else "z")
        object.__setattr__(self, "up", up)
        object.__setattr__(self, "motions", tuple(m if m.up == up else m.turned(up) for m in self.motions))
        if not len(self.times):
            raise ObservationError("there is no frame to show", remedy="Give a motion with frames, or a take.")

    @cached_property
    def times(self) -> NDArray:
        """(F,) [s] of the frames that are shown: the first motion's, else the take's, else the markers'."""
        if self.motions:
            return self.motions[0].times
        if self.steps is not None:
            return self.steps
        return self.markers[0].times + self.marker_offsets[0] if self.markers else np.zeros(0)

    @property
    def rate(self) -> float:
        """[Hz] of the frames; 1 of a single one."""
        span = float(self.times[-1] - self.times[0])
        return self.motions[0].rate if self.motions else (len(self.times) - 1) / span if span > 0 else 1.0

    @cached_property
    def places(self) -> NDArray:
        """(N, 3) [m] where things are over time; where there are cameras alone, what they look at."""
        parts = [m.segment_poses()[..., :3, 3].reshape(-1, 3) for m in self.motions]
        parts += [m.positions().reshape(-1, 3) for m in self.motions]
        parts += [m.positions.reshape(-1, 3) for m in self.markers]
        if self.points is not None:
            parts.append(_without_strays(self.points.reshape(-1, 3)))
        found = np.concatenate(parts) if parts else np.zeros((0, 3))
        found = found[np.isfinite(found).all(-1)]
        return found if len(found) or self.rig is None else scene.looked_at(tuple(self.rig))[None]

    def first_places(self) -> NDArray:
        """(N, 3) [m] where the person is in the first frame: joints and landmarks, else keypoints, else markers."""
        if self.motions:
            first = self.motions[0]
            return np.concatenate([first.segment_poses()[0, :, :3, 3], first.positions()[0]])
        x = np.zeros((1, 0, 3)) if self.points is None else self.points
        x = self.markers[0].positions if self.points is None and self.markers else x
        known = np.asarray(np.isfinite(x).all(axis=-1))
        frame = int(np.argmax(known.any(axis=1)))
        return np.asarray(x[frame][known[frame]])

    def way(self) -> NDArray:
        """(F, 3) [m] where the person is over `times`: root of the first motion, else middle of markers or points."""
        if self.motions:
            return self.motions[0].Ts_world_root[:, :3, 3]
        if self.points is not None:
            x, times = self.points, self.times
        elif self.markers:
            x, times = self.markers[0].positions, self.markers[0].times + self.marker_offsets[0]
        else:
            return np.tile(self.places.mean(axis=0) if len(self.places) else np.zeros(3), (len(self.times), 1))
        known = np.isfinite(x).all(axis=-1).any(axis=-1)
        if not known.any():
            return np.zeros((len(self.times), 3))
        middle = np.nanmedian(x[known], axis=1)
        return np.stack([np.interp(self.times, times[known], column) for column in middle.T], axis=1)


@dataclass(frozen=True)
class Choice:
    """What of a recording is shown, and how.

    Parameters
    ----------
    layers : of `LAYERS`
    by_quality : bool
        Colours tell the segments' quality, not left from right.
    rays : str
        Camera whose rays are shown, `ALL_CAMERAS` or `NO_CAMERA`.
    through : str
        Camera that is looked through, or `NO_CAMERA`.
    follow : bool
        The person stays in place and the floor glides beneath it (not while looking through a camera).
    """

    layers: frozenset[str] = DEFAULT_LAYERS
    by_quality: bool = False
    rays: str = NO_CAMERA
    through: str = NO_CAMERA
    follow: bool = False


class Show:
    """A recording in a server's scene; `frame` brings it to one time."""

    def __init__(self, server: viser.ViserServer, recording: ViewerContent) -> None:
        self.server, self.recording = server, recording
        floor = scene.floor_height(recording.places, recording.up)
        self._way = recording.way()
        self._poses = [m.segment_poses() for m in recording.motions]
        facing = self._poses[0][0, 0, :3, 0] if recording.motions else None  # a body's root looks along its x
        self.stage = stage.Stage(
            server, up=recording.up, points=recording.places, floor=floor, rig=recording.rig,
            person=recording.first_places(), facing=facing,
        )  # fmt: skip
        self.figures, self._paths = [], []
        for n, motion in enumerate(recording.motions):
            colour = None if n == 0 else scene.OTHERS[(n - 1) % len(scene.OTHERS)]
            self.figures.append(figure.Figure(server.scene, f"body{n}", motion.body, colour=colour))
            way = motion.Ts_world_root[:, :3, 3]
            path = np.stack([way[:-1], way[1:]], axis=1)
            if len(path):
                shade: Any = _PATH if colour is None else colour
                self._paths.append(server.scene.add_line_segments(f"/world/path{n}", path, shade, thickness=0.008))
        self._fitted = [
            {name: scene.fitted_points(m.body, r) for name, r in m.residuals.items()} for m in recording.motions[:1]
        ]
        norms = [r.norms.ravel() for m in recording.motions[:1] for r in m.residuals.values() if r.unit == "px"]
        middling = known_median(np.concatenate([*norms, np.zeros(0)]))
        self._middling = middling if np.isfinite(middling) else 1.0  # [px]
        self._clouds = list(self._make_clouds())
        self._rays: Any = None
        self._last = Choice(frozenset(LAYERS))  # as the nodes were made

    def frame(self, i: int, choice: Choice = Choice(), *, pictures: bool = True) -> None:
        """Show frame `i` of `recording.times`; without `pictures` the cameras' stay as they are."""
        with self.server.atomic():
            self._show_layers(choice)
            time = float(self.recording.times[i])
            for n, (fig, motion) in enumerate(zip(self.figures, self.recording.motions)):
                f = motion.frame_at(time)
                fig.show_all(f is not None)
                if f is not None:
                    fig.pose(
                        self._poses[n][f], joint_std=motion.joint_std[f], quality=motion.segment_quality[f],
                        by_quality=choice.by_quality and n == 0, see_through=choice.through != NO_CAMERA,
                    )  # fmt: skip
            follow = choice.follow and choice.through == NO_CAMERA
            self.stage.shift(self._way[0] - self._way[i] if follow else np.zeros(3))
            self._show_points(time, choice)
            self._show_rays(i, choice)
            if pictures:
                self._show_pictures(time, choice)
            self._last = choice

    def _show_layers(self, choice: Choice) -> None:
        """Show and hide what has changed."""
        for layer in choice.layers ^ self._last.layers:
            on = layer in choice.layers
            for fig in self.figures:
                if layer in figure.PARTS:
                    fig.show(layer, on)
            if layer == "path":
                for path in self._paths:
                    path.visible = on
            elif layer == "floor":
                self.stage.grid.visible = on
        for name, node in self.stage.cameras.items():
            node.frustum.visible = "cameras" in choice.layers and name != choice.through

    def _show_points(self, time: float, choice: Choice) -> None:
        """Triangulated keypoints and markers, which no segment carries."""
        for cloud, layer, values, times, rate in self._clouds:
            f = nearest_frame(times, time, rate)
            cloud.show(values[f] if f is not None and layer in choice.layers else None)

    def _make_clouds(self) -> Iterator[tuple[figure.ScenePoints, str, NDArray, NDArray, float]]:
        """Every cloud with its layer, its points (F, K, 3) [m], their times (F,) [s] and rate [Hz]."""
        recording, given = self.recording, []
        if recording.points is not None and recording.steps is not None:
            given.append(("points", _POINT, recording.points, recording.steps, recording.rate))
        for markers, offset in zip(recording.markers, recording.marker_offsets):
            given.append(("markers", _MARKER, markers.positions, markers.times + offset, markers.rate))
        if recording.motions and not recording.markers:
            motion = recording.motions[0]
            measured = [r.measured for r in motion.residuals.values() if r.unit == "m"]
            given += [("markers", _MARKER, x, motion.times, motion.rate) for x in measured]
        for n, (layer, colour, values, times, rate) in enumerate(given):
            cloud = figure.ScenePoints(self.server.scene, f"{layer}{n}", values.shape[1], colour)
            yield cloud, layer, values, times, rate

    def _show_rays(self, i: int, choice: Choice) -> None:
        found = self.rays(i, choice.rays)
        if found is None or not len(found.points):
            if self._rays is not None:
                self._rays.visible = False
        elif self._rays is None:
            self._rays = self.server.scene.add_line_segments(
                "/world/rays", found.points, found.colours, thickness=1.6, thickness_units="screen"
            )
        else:
            self._rays.points, self._rays.colors, self._rays.visible = found.points, found.colours, True

    def rays(self, i: int, camera: str) -> scene.Rays | None:
        """Rays of a camera, of `ALL_CAMERAS` or of `NO_CAMERA` in frame `i` of the first motion."""
        if camera == NO_CAMERA or self.recording.rig is None or not self.recording.motions:
            return None
        motion, found = self.recording.motions[0], []
        for name, residuals in motion.residuals.items():
            points = self._fitted[0][name]
            seen_by = next((c for c in self.recording.rig if name == c.name or name.startswith(f"{c.name} ")), None)
            if residuals.unit != "px" or points is None or seen_by is None:
                continue
            if camera in (ALL_CAMERAS, seen_by.name):
                x = motion.body.positions(motion.state(i), points)
                found.append(
                    scene.camera_rays(
                        seen_by, residuals.measured[i], x, residuals.norms[i], residuals.weights[i],
                        middling=self._middling,
                    )
                )  # fmt: skip
        if not found:
            return None
        return scene.Rays(np.concatenate([r.points for r in found]), np.concatenate([r.colours for r in found]))

    def _show_pictures(self, time: float, choice: Choice) -> None:
        pictures = self.recording.pictures
        for name, node in self.stage.cameras.items():
            with_image = pictures is not None and "images" in choice.layers
            shown = with_image and "cameras" in choice.layers and name != choice.through
            node.show(pictures.read(name, time, stage.FRUSTUM_IMAGE_PX) if shown and pictures is not None else None)
            through = choice.through == name
            behind = pictures.read(name, time, stage.BACKGROUND_IMAGE_PX) if through and pictures is not None else None
            node.look(behind)


def _without_strays(x: NDArray) -> NDArray:
    """Points (N, 3) without those far from the rest: single wrong meetings of rays should not size the scene."""
    x = x[np.isfinite(x).all(-1)]
    if not len(x):
        return x
    distance = np.linalg.norm(x - np.median(x, axis=0), axis=1)
    return x[distance <= 5.0 * np.median(distance) + 1e-9]


MOST_FRAMES, MOST_PICTURES = 600, 240
"""Frames and camera pictures that a page holds at most, so that it stays below 10 MB and loads at once."""


def page(recording: ViewerContent, *, choice: Choice = Choice()) -> tuple[str, int]:
    """The scene with its animation as one self-contained HTML text, and the number of frames in it.

    Longer recordings are thinned out evenly to `MOST_FRAMES`; the cameras' pictures change as often as `MOST_PICTURES`
    allow.

    Raises
    ------
    ExportError
        viser is missing.
    """
    frames = chosen_frames(len(recording.times), MOST_FRAMES)
    with_pictures = chosen_frames(len(frames), max(1, MOST_PICTURES // max(len(recording.rig or ()), 1)))
    server = open_server(0)
    try:
        show = Show(server, recording)
        choice = replace(choice, follow=choice.follow or show.stage.goes_far)
        show.frame(0, choice)
        for fig in show.figures:
            fig.blank()
        serializer = server.get_scene_serializer()
        for k, i in enumerate(frames):
            show.frame(int(i), choice, pictures=k in with_pictures)
            step = frames[k + 1] - i if k + 1 < len(frames) else 1
            serializer.insert_sleep(float(step) / recording.rate)
        policy = f'<head><meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        return serializer.as_html().replace("<head>", policy, 1), len(frames)
    finally:
        with quiet():
            server.stop()


def chosen_frames(count: int, most: int) -> NDArray:
    """At most `most` of `count` frames, evenly: every first, second, third ... one."""
    return np.arange(0, count, max(1, -(-count // most)))
