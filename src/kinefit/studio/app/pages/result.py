"""A result: the 3D figure and the cameras' images on one time line, angles under it, corrections and exports."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import events, ui

from kinefit.bodies.rendering.looks import to_hex
from kinefit.errors import KinefitError
from kinefit.exporters.report.moments import Moment, doubtful_moments
from kinefit.exporters.tables import spoken
from kinefit.fitting.initialization.from_points import clickable
from kinefit.studio.app.desk import Desk
from kinefit.studio.app.pages import shell as s
from kinefit.studio.app.review import Review
from kinefit.takes.batch import corrections
from kinefit.takes.batch.corrections import is_outdated
from kinefit.takes.batch.results import FORMATS, description, write_format

_REFRESH_S = 0.1  # between two looks at the clock of the 3D figure
_IMAGE_PX = 720  # longer side of a camera's image
_IMAGE_REM, _IMAGES_A_ROW = 24.0, 4  # largest height of an image, and number of them side by side
_MAX_POINTS = 2000  # of a curve


async def result_page(desk: Desk, take: Path, folder: Path) -> None:
    """Build the page of one person's result."""
    t = s.texts()
    with s.shell(desk, t, t("result.title", name=take.parent.name)):
        review = await s.loaded(t, t("result.loading"), desk.review, take, folder)
        if review is not None:
            _ResultPage(desk, t, take, review)


class _ResultPage:
    """The parts of the page."""

    def __init__(self, desk: Desk, t: s.Texts, take: Path, review: Review) -> None:
        self._desk, self._t, self._take, self._review = desk, t, take, review
        self._shown = -1
        self._range: list[int | None] = [None, None]
        self._images: dict[str, ui.interactive_image] = {}
        self._large: str | None = None
        motion = review.motion
        if not review.has_cameras:
            ui.label(t("result.other_cameras")).props('role="alert"')
        self._time_line()
        with ui.row().classes("w-full items-stretch"):
            s.page_frame(review.scene.address, "3D").classes("flex-1 min-w-[320px] min-h-[26rem] border")
            wide = "flex-1 min-w-[320px]" if len(review.cameras) < 2 else "w-full"
            with ui.row().classes(f"{wide} content-start gap-1"):
                for camera in review.cameras:
                    image = ui.interactive_image(on_mouse=lambda event, camera=camera: self._click(camera, event))
                    image.props["alt"] = camera
                    self._images[camera] = image
                    self._enlarge(camera, False)
                if review.cameras:
                    with ui.row().classes("items-center w-full"):
                        ui.label(t("result.drag")).classes("text-sm")
                        joints = list(dict.fromkeys((*clickable(motion.body), *motion.body.landmarks.names)))
                        self._joint = ui.select(joints, label=t("result.joint"), with_input=True, clearable=True)
                        self._joint.classes("w-48")
        with s.card(t("result.ranges")):
            ui.label(t("result.ranges_text")).classes("text-sm")
            columns = ("range_of", "left", "right", "middle", "difference")
            text_table([t(f"result.{key}") for key in columns], review.ranges)
            for name in ("report", "gait"):
                if (page := review.folder / f"{name}.html").is_file():
                    desk.files.folders.add(review.folder)
                    ui.link(t(f"take.{name}"), s.link("/file", path=page), new_tab=True)
        with s.card(t("result.angle")):
            names = {name: spoken(name) for name in motion.body.tree.coordinates}
            first = next((name for name in names if name.startswith("knee_angle")), next(iter(names)))
            self._angle = ui.select(names, value=first, with_input=True, on_change=lambda: self._draw_angle())
            self._angle.classes("w-64")
            self._chart = ui.echart({}, on_point_click=lambda event: self._go(event.data_index * self._step))
            self._chart.classes("w-full h-56")
            self._draw_angle()
        with s.card(t("result.corrections_title")):
            self._corrections()
        with s.card(t("result.export_title")):
            self._export()
        self._follow()
        ui.timer(_REFRESH_S, self._follow)

    def _enlarge(self, camera: str, large: bool) -> None:
        """Show a camera's image as wide as there is room, or as small as all of them fit."""
        width, height = self._review.size(camera)
        share = 100.0 / min(len(self._review.cameras), _IMAGES_A_ROW)
        small = f"min({share:.4g}% - 0.25rem, {_IMAGE_REM * width / height:.1f}rem)"
        self._images[camera].style(f"width: {'100%' if large else small}")
        self._large = camera if large else None

    def _time_line(self) -> None:
        """The slider with the marks of doubtful moments, and the keys that move it."""
        t, motion = self._t, self._review.motion
        moments = doubtful_moments(motion)
        last = max(len(motion) - 1, 1)
        marks = "".join(
            f'<span title="{escape(" ".join(m.what))}" style="position:absolute;height:8px;'
            f'left:{100 * m.start / last:.2f}%;width:max(3px,{100 * (m.stop - m.start) / last:.2f}%);'
            f'background:{to_hex(s.COLOURS["fault"])}"></span>'
            for m in moments
        )
        ui.html(f'<div style="position:relative;height:8px">{marks}</div>', sanitize=False).classes("w-full")
        self._slider = ui.slider(min=0, max=last, step=1, value=0).classes("w-full")
        self._slider.props["aria-label"] = t("result.frame")
        self._slider.on("update:model-value", lambda event: self._go(event.args), throttle=0.05)
        with ui.row().classes("items-center"):
            self._play = ui.button(t("result.play"), icon="play_arrow", on_click=self._toggle).props("outline")
            self._now = ui.label()
            if moments:
                ui.button(t("result.next_doubt"), icon="flag", on_click=lambda: self._next(moments)).props("flat")
        ui.keyboard(on_key=self._key)

    def _key(self, event: events.KeyEventArguments) -> None:
        if event.action.keydown and (event.key.arrow_left or event.key.arrow_right):
            self._go(self._review.scene.player.clock.frame + (1 if event.key.arrow_right else -1))
        elif event.action.keydown and not event.action.repeat and event.key == " ":
            self._toggle()

    def _toggle(self) -> None:
        clock = self._review.scene.player.clock
        clock.playing = not clock.playing

    def _go(self, frame: int) -> None:
        clock = self._review.scene.player.clock
        clock.playing = False
        clock.go(int(frame))
        self._follow()

    def _next(self, moments: Sequence[Moment]) -> None:
        now, worst = self._review.scene.player.clock.frame, sorted(moment.worst for moment in moments)
        self._go(next((frame for frame in worst if frame > now), worst[0]))

    def _follow(self) -> None:
        """Bring images and read-outs to the frame of the 3D figure."""
        clock, motion, t = self._review.scene.player.clock, self._review.motion, self._t
        icon, said = ("pause", "result.stop") if clock.playing else ("play_arrow", "result.play")
        self._play.icon, self._play.text = icon, t(said)
        if clock.frame == self._shown:
            return
        self._shown = frame = clock.frame
        self._slider.value = frame
        self._now.text = t(
            "result.time", time=f"{motion.times[frame]:.2f}", frame=frame, count=len(motion),
            quality=f"{100 * motion.quality[frame]:.0f}",
        )  # fmt: skip
        for camera, image in self._images.items():
            image.set_source(
                s.link("/image/frame", folder=self._review.folder, camera=camera, frame=frame, longest=_IMAGE_PX)
            )
        if not clock.playing:
            self._mark_now(frame)

    def _draw_angle(self) -> None:
        """The chosen angle over time with twice its standard deviation."""
        motion, name = self._review.motion, self._angle.value
        d = motion.body.tree.coordinates.index(name)
        self._step = step = max(1, math.ceil(len(motion) / _MAX_POINTS))
        value = np.degrees(motion.angles[::step, d])
        spread = np.degrees(2 * motion.dof_std[::step, 6 + d])
        spread = np.where(np.isfinite(spread) & (spread < 90.0), spread, np.nan)
        line = {"type": "line", "showSymbol": False, "lineStyle": {"width": 2}, "itemStyle": {"color": "#0072b2"}}
        band = {
            **line, "lineStyle": {"width": 0}, "stack": "band", "stackStrategy": "all",  # also across zero
            "silent": True, "tooltip": {"show": False},
        }  # fmt: skip
        self._chart.options.update({
            "animation": False, "grid": {"left": 50, "right": 15, "top": 30, "bottom": 30},
            "tooltip": {"trigger": "axis"},
            "xAxis": {"type": "category", "data": motion.times[::step].round(3).tolist(), "name": "s"},
            "yAxis": {"type": "value", "scale": True, "name": self._t("result.angles_unit")},
            "series": [
                {**line, "name": spoken(name), "data": _numbers(value), "markLine": _mark(0)},
                {**band, "data": _numbers(value - spread)},
                {**band, "data": _numbers(2 * spread), "areaStyle": {"opacity": 0.15}},
            ],
        })  # fmt: skip
        self._mark_now(max(self._shown, 0))

    def _mark_now(self, frame: int) -> None:
        self._chart.options["series"][0]["markLine"] = _mark(frame // self._step)
        self._chart.update()

    def _corrections(self) -> None:
        """Buttons that write into the take file, what was corrected so far, and the way back."""
        t = self._t
        ui.label(t("result.corrections_text"))
        with ui.row().classes("items-center"):
            ui.button(t("result.from"), on_click=lambda: self._set_range(0)).props("outline")
            ui.button(t("result.to"), on_click=lambda: self._set_range(1)).props("outline")
            self._range_text = ui.label(t("result.no_range"))
        cameras = list(self._review.cameras)
        with ui.row().classes("items-center"):
            ui.button(t("result.trim"), icon="content_cut", on_click=self._in_range(
                lambda a, b: corrections.trim(self._take, a, b)))
            if cameras:
                which = ui.select(cameras, value=cameras[0], label=t("result.which")).classes("w-32")
                self._camera_buttons(which)
        self._list()

    def _camera_buttons(self, which: ui.select) -> None:
        t = self._t
        exchange = ui.button(icon="swap_horiz", on_click=self._in_range(
            lambda a, b: corrections.exchange_sides(self._take, which.value, a, b)))
        exclude = ui.button(icon="videocam_off", on_click=self._in_range(
            lambda a, b: corrections.exclude_view(self._take, which.value, a, b)))
        exchange.bind_text_from(which, "value", lambda camera: t("result.exchange", camera=camera))
        exclude.bind_text_from(which, "value", lambda camera: t("result.exclude", camera=camera))

    @ui.refreshable_method
    def _list(self) -> None:
        t = self._t
        try:
            made = corrections.corrections_of(self._take)
        except KinefitError as error:
            s.show_error(t, error)
            made = ()
        if is_outdated(self._review.motion.provenance, self._take):
            ui.label(t("take.outdated")).props('role="alert"')
        for sentence in made:
            ui.label(sentence).classes("text-sm")
        if not made:
            ui.label(t("result.none")).classes("text-sm")
            return
        with ui.row():
            undo = ui.button(t("result.undo"), icon="undo", on_click=lambda: self._edit(corrections.undo, self._take))
            undo.props("flat").set_visibility(corrections.can_undo(self._take))
            ui.button(t("result.again"), icon="play_arrow", on_click=self._again)

    def _again(self) -> None:
        self._desk.start(self._take, "track", str(self._take), "--json")
        ui.navigate.to(s.link("/take", path=self._take))

    def _set_range(self, end: int) -> None:
        self._range[end] = self._review.scene.player.clock.frame
        first, last = self._range
        if first is not None and last is not None:
            self._range = [min(first, last), max(first, last)]
            self._range_text.text = self._t("result.range", first=self._range[0], last=self._range[1])

    def _in_range(self, edit: Callable[[int, int], object]) -> Callable[[], None]:
        """A handler that calls `edit` with the steps of the take of the chosen range."""

        def handle() -> None:
            first, last = self._range
            if first is None or last is None:
                ui.notify(self._t("result.no_range"), type="warning")
                return
            self._edit(edit, self._step_of(first), self._step_of(last) + 1)

        return handle

    def _step_of(self, frame: int) -> int:
        """Step of the take's common time of a frame of the motion."""
        return round(float(self._review.motion.times[frame]) * self._review.seen.rate)

    def _edit(self, edit: Callable[..., object], *arguments: Any) -> None:
        with s.notified():
            edit(*arguments)
        self._list.refresh()

    def _click(self, camera: str, event: events.MouseEventArguments) -> None:
        """Take a click in an image as the place of the chosen joint."""
        joint = self._joint.value
        if not joint:
            before = self._large
            if before is not None:
                self._enlarge(before, False)
            if before != camera:
                self._enlarge(camera, True)
            return
        width, _ = self._review.size(camera)
        share = max(1.0, max(self._review.size(camera)) / _IMAGE_PX)  # of the video's image to the one that is shown
        uv = (event.image_x * share, event.image_y * share)
        if not 0 <= uv[0] < width:
            return
        frame = self._review.scene.player.clock.frame
        self._edit(corrections.add_click, self._take, self._step_of(frame), camera, joint, uv)
        ui.notify(self._t("result.clicked", joint=joint, camera=camera, frame=frame), type="positive")

    def _export(self) -> None:
        t = self._t

        async def write(format: str) -> None:
            with s.notified():
                file = self._review.folder / FORMATS.get(format).file
                await s.in_thread(write_format, self._review.motion, format, file)
                ui.notify(t("result.export_done", file=file), type="positive", timeout=10_000)

        with ui.row():
            for format in FORMATS.names():
                button = ui.button(format, on_click=lambda format=format: write(format)).props("outline no-caps")
                button.tooltip(description(format))


def text_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """A table of texts, whose first column has the names of its rows."""
    heads = [{"name": str(k), "label": head, "field": str(k), "align": "right" if k else "left"}
             for k, head in enumerate(columns)]  # fmt: skip
    cells = [{str(k): text.replace(" ", "\u00a0") if k else text for k, text in enumerate(row)} for row in rows]
    ui.table(columns=heads, rows=cells, row_key="0").classes("w-full").props("dense wrap-cells")


def _numbers(values: np.ndarray) -> list[float | None]:
    """Values as JSON has them: None where they are unknown."""
    return [round(float(value), 2) if np.isfinite(value) else None for value in values]


def _mark(index: int) -> dict[str, Any]:
    line = {"color": to_hex(s.COLOURS["fault"]), "type": "solid"}
    return {"symbol": "none", "silent": True, "label": {"show": False}, "lineStyle": line, "data": [{"xAxis": index}]}
