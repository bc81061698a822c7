"""The player: buttons, sliders and read-outs next to the scene, and the loop that follows them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import Motion
from kinefit.studio.viewers import figure, scene
from kinefit.studio.viewers.show import ALL_CAMERAS, DEFAULT_LAYERS, LAYERS, NO_CAMERA, Choice, Show, ViewerContent
from kinefit.studio.viewers.stage import look_through

if TYPE_CHECKING:
    import viser

_TICK, _TELL = 1 / 60, 0.1  # [s] between looks at the page, and between read-outs while playing
_STEPS = {"-10": -10, "-1": -1, "+1": 1, "+10": 10}
_HELP = "drag: turn, right drag: shift, wheel: zoom; P plays, B and N step"


@dataclass
class PlaybackClock:
    """Where the player is: `position` [frames] runs on while playing."""

    count: int
    rate: float
    position: float = 0.0
    playing: bool = False
    speed: float = 1.0

    @property
    def frame(self) -> int:
        """Frame to show."""
        return min(int(self.position), self.count - 1)

    def tick(self, elapsed: float) -> None:
        """Let `elapsed` seconds pass."""
        if self.playing:
            self.position = (self.position + elapsed * self.rate * self.speed) % max(self.count, 1)

    def step(self, frames: int) -> None:
        """Stop, and go some frames on or back, round the ends."""
        self.playing, self.position = False, float((self.frame + frames) % self.count)

    def go(self, frame: int) -> None:
        """Go to a frame."""
        self.position = float(min(max(frame, 0), self.count - 1))


class Player:
    """A recording with everything to operate it, in a server's page.

    Parameters
    ----------
    server : viser.ViserServer
    recording : ViewerContent
    layers : of `LAYERS`, those that are shown at first
    """

    def __init__(
        self, server: viser.ViserServer, recording: ViewerContent, *, layers: frozenset[str] = DEFAULT_LAYERS
    ) -> None:  # fmt: skip
        self.server, self.recording, self._first_layers = server, recording, layers
        self.show = Show(server, recording)
        self.clock = PlaybackClock(len(recording.times), recording.rate)
        self._shown: tuple[int, Choice] | None = None
        self._sent: tuple[Any, ...] = ()
        self._since_sent = 0.0
        self._through = NO_CAMERA
        self._before: dict[int, tuple[NDArray, NDArray, NDArray, float]] = {}  # each browser's own view
        self._slider_shows = 0
        self._slider: Any = None
        self._speed: Any = None
        self._playback()
        self._layers()
        self._plots: list[_Angle] = []
        if recording.motions:
            with server.gui.add_folder("Angles"):
                for _ in range(2):
                    self._plots.append(_Angle(server.gui, recording.motions[0], len(self._plots)))
            with server.gui.add_folder("This frame"):
                self._text = server.gui.add_markdown("")
        server.on_client_connect(self._welcome)

    def choice(self) -> Choice:
        """What the page's boxes ask for."""
        return Choice(
            frozenset(layer for layer, box in self._boxes.items() if box.value),
            by_quality=self._colour.value == "quality" if self._colour else False,
            rays=self._rays.value if self._rays else NO_CAMERA,
            through=self._look.value if self._look else NO_CAMERA,
            follow=bool(self._follow and self._follow.value),
        )

    def tick(self, elapsed: float) -> None:
        """Let `elapsed` seconds pass and show what is due."""
        if int(self._slider.value) != self._slider_shows:  # moved by a user
            self.clock.go(int(self._slider.value))
        self.clock.speed = float(self._speed.value)
        self.clock.tick(elapsed)
        frame, choice = self.clock.frame, self.choice()
        if choice.through != self._through:
            self._through = choice.through
            for client in self.server.get_clients().values():
                self._aim(client)
        if (frame, choice) != self._shown:
            self.show.frame(frame, choice)
            self._shown = frame, choice
        self._since_sent += elapsed
        state = frame, *(plot.box.value for plot in self._plots)
        if state != self._sent and (not self.clock.playing or self._since_sent > _TELL):
            self._sent, self._since_sent = state, 0.0
            self._tell(frame)

    def run(self, stopped: Callable[[], bool] = lambda: False) -> None:
        """Follow the page until `stopped()` or Ctrl-C."""
        last = time.monotonic()
        while not stopped():
            time.sleep(_TICK)
            now = time.monotonic()
            self.tick(now - last)
            last = now

    def _playback(self) -> None:
        gui, count = self.server.gui, self.clock.count
        with gui.add_folder("Time"):
            self._slider = gui.add_slider("frame", 0, max(count - 1, 1), 1, 0, disabled=count < 2)
            self._now = gui.add_markdown("")
            play = gui.add_button("play / pause", icon=None)
            steps = gui.add_button_group("step", tuple(_STEPS))
            self._speed = gui.add_slider("speed", 0.05, 2.0, 0.05, 1.0)

        def toggle(_: Any) -> None:
            self.clock.playing = not self.clock.playing

        play.on_click(toggle)
        steps.on_click(lambda event: self.clock.step(_STEPS[event.target.value]))
        gui.add_command("Play or pause", hotkey="P").on_trigger(toggle)
        gui.add_command("One frame back", hotkey="B").on_trigger(lambda _: self.clock.step(-1))
        gui.add_command("One frame on", hotkey="N").on_trigger(lambda _: self.clock.step(1))

    def _layers(self) -> None:
        gui, cameras = self.server.gui, tuple(self.show.stage.cameras)
        motions = self.recording.motions
        there = dict.fromkeys(LAYERS, True)
        there |= {layer: bool(motions) for layer in (*figure.PARTS, "path")}
        there |= {"points": self.recording.points is not None, "markers": bool(self.recording.markers)}
        there |= {"cameras": bool(cameras), "images": self.recording.pictures is not None}
        self._rays = self._look = self._colour = self._follow = None
        with gui.add_folder("Show"):
            if cameras:
                self._look = gui.add_dropdown("look through", (NO_CAMERA, *cameras))
            if cameras and motions and self.show.rays(0, ALL_CAMERAS) is not None:
                self._rays = gui.add_dropdown("rays of", (NO_CAMERA, ALL_CAMERAS, *cameras))
            if motions:
                self._colour = gui.add_dropdown("colours", ("side", "quality"))
            if motions or self.recording.markers or self.recording.points is not None:
                self._follow = gui.add_checkbox("follow", self.show.stage.goes_far)
            first = self._first_layers
            self._boxes = {layer: gui.add_checkbox(layer, layer in first) for layer in LAYERS if there[layer]}
            gui.add_markdown(_HELP)

    def _welcome(self, client: viser.ClientHandle) -> None:
        if self._through != NO_CAMERA:
            self._aim(client)

    def _aim(self, client: viser.ClientHandle) -> None:
        """Set a browser's view to the camera that is looked through, or back to what it was."""
        at = client.camera
        if self._through in self.show.stage.cameras:
            self._before.setdefault(client.client_id, (at.position, at.look_at, at.up_direction, at.fov))
            look_through(client, self.show.stage.cameras[self._through])
        elif client.client_id in self._before:
            position, target, up, fov = self._before.pop(client.client_id)
            with client.atomic():
                at.up_direction, at.position, at.look_at, at.fov = up, position, target, fov

    def _tell(self, frame: int) -> None:
        self._slider_shows = frame
        if int(self._slider.value) != frame:
            self._slider.value = frame
        self._now.content = f"frame **{frame}** of {self.clock.count}, {self.recording.times[frame]:.3f} s"
        for plot in self._plots:
            plot.tell(frame)
        if self.recording.motions:
            self._text.content = summary(self.recording.motions[0], frame)


def summary(motion: Motion, frame: int) -> str:
    """Words about one frame (Markdown): quality, lost segments, residuals of every sensor."""
    lines = [f"quality **{motion.quality[frame]:.2f}** of 1"]
    lost = [name for name, gone in zip(motion.body.tree.segments, motion.lost[frame]) if gone]
    if lost:
        lines.append("lost: " + ", ".join(map(scene.as_markdown, lost)))
    for name, residuals in motion.residuals.items():
        out = int(residuals.rejected[frame].sum())
        extra = f", {out} rejected" if out else ""
        extra += ", left/right swap corrected" if residuals.swapped[frame] else ""
        middle = residuals.median_text(residuals.norms[frame])
        lines.append(f"{scene.as_markdown(name)}: {middle}{extra}")
    return "\n\n".join(lines)


@dataclass
class _Angle:
    """A coordinate to choose, its course with twice its standard deviation, and its value now."""

    gui: Any
    motion: Motion
    number: int
    chosen: str = field(default="")

    def __post_init__(self) -> None:
        names = self.motion.body.tree.coordinates
        usual = [n for n in names if n.startswith("knee_angle")] or list(names)
        first = usual[min(self.number, len(usual) - 1)]
        self.box = self.gui.add_dropdown(f"angle {self.number + 1}", names, initial_value=first)
        self.line = self.gui.add_markdown("")
        edge = {"stroke": "rgba(70,140,255,0.35)", "width": 1, "points": {"show": False}}
        series = (
            {"label": "s"}, {"label": "value", "stroke": "#2060d0", "width": 2, "points": {"show": False}},
            {"label": "+2σ", **edge}, {"label": "−2σ", **edge},
            {"label": "now", "stroke": "#e03030", "points": {"show": True, "size": 9, "fill": "#e03030"}},
        )  # fmt: skip
        self.plot = self.gui.add_uplot(
            course(self.motion, first, 0), series, bands=({"series": (2, 3), "fill": "rgba(70,140,255,0.18)"},),
            height=130, legend={"show": False}, scales=self._scales(first),
        )  # fmt: skip

    def _scales(self, coordinate: str) -> dict[str, Any]:
        return {"x": {"time": False}, "y": {"auto": False, "range": course_range(self.motion, coordinate)}}

    def tell(self, frame: int) -> None:
        """Show a frame."""
        name = self.box.value
        if name != self.chosen:
            self.chosen, self.plot.scales = name, self._scales(name)
        value = scene.angle_line(self.motion, name, frame).removeprefix(name)
        self.line.content = f"**{scene.as_markdown(name)}**{value}"
        self.plot.data = course(self.motion, name, frame)


def course(motion: Motion, coordinate: str, frame: int) -> tuple[NDArray, ...]:
    """Times [s], values, values + 2σ and - 2σ, and the value now alone (NaN elsewhere); [deg], prismatic [mm].

    Where a coordinate is not observed, 2σ is a million: the band fills the plot.
    """
    value, spread, _ = scene.angle_course(motion, coordinate)
    spread = np.where(np.isfinite(spread), spread, 1e6)
    now = np.full(len(value), np.nan)
    now[frame] = value[frame]
    return motion.times, value, value + spread, value - spread, now


def course_range(motion: Motion, coordinate: str) -> tuple[float, float]:
    """Lowest and highest of what a plot of a coordinate shows: all values, and 2σ about them where it is below 45°."""
    value, spread, unit = scene.angle_course(motion, coordinate)
    known = np.where(spread < (45.0 if unit == "°" else 100.0), spread, 0.0)
    low, high = float((value - known).min()), float((value + known).max())
    margin = max(0.05 * (high - low), 0.5)
    return low - margin, high + margin

