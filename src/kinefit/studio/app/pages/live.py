"""Live: follow cameras or a replayed recording, and find, use, record and calibrate the cameras of this computer."""

from __future__ import annotations

import time
from base64 import b64encode
from pathlib import Path

from nicegui import ui

from kinefit.errors import KinefitError
from kinefit.studio.app import live
from kinefit.studio.app.desk import Desk
from kinefit.studio.app.jobs import FAILED, Job
from kinefit.studio.app.pages import shell as s
from kinefit.studio.app.people import jpeg, unrecognisable

_REFRESH_S = 0.5  # between two looks at the session
_PREVIEW_PX = 240


async def live_page(desk: Desk) -> None:
    """Build the page."""
    t = s.texts()
    with s.shell(desk, t, t("live.title")):
        await ui.context.client.connected()
        _LivePage(desk, t, await s.in_thread(live.followable, desk.root))


class _LivePage:
    """The session and the cameras."""

    def __init__(self, desk: Desk, t: s.Texts, takes: dict[Path, bool]) -> None:
        self._desk, self._t, self._takes = desk, t, takes
        self._webcams: list[live.Webcam] | None = None
        self._calibrations: list[Path] = []
        self._shown: tuple[object, ...] = ()
        with ui.card().classes("w-full"):
            self._session()
        with s.card(t("live.cameras")):
            self._cameras()
        ui.timer(_REFRESH_S, self._look)

    @property
    def _job(self) -> Job | None:
        return self._desk.jobs.sessions[-1] if self._desk.jobs.sessions else None

    async def _look(self) -> None:
        """Show the session anew if its state changed, and how much is recorded."""
        job = self._job
        was_up = self._shown[:1] == (job,) and self._shown[-1]
        state = (job, job.state, was_up or await s.in_thread(live.is_up, job)) if job else ()
        if state != self._shown:
            self._shown = state
            self._session.refresh()
        if self._desk.recorder is not None:
            self._recorded.text = self._said()

    @ui.refreshable_method
    def _session(self) -> None:
        t, job = self._t, self._job
        if job is not None and job.is_open:
            ui.label(s.short(job.take, self._desk.root)).classes("break-all")
            if self._shown and self._shown[-1]:
                s.page_frame(live.page_of(job), t("live.page")).classes("w-full h-[36rem] border")
            else:
                ui.label(t("live.starting"))
            ui.button(t("live.stop"), icon="stop", on_click=job.pause)
            return
        if job is not None:
            self._ended(job)
        if not self._takes:
            ui.label(t("live.no_takes"))
            return
        names = {
            str(file): t("live.stream" if streams else "live.replay", name=s.short(file, self._desk.root))
            for file, streams in self._takes.items()
        }
        choice = ui.select(names, value=next(iter(names)), label=t("live.take")).classes("w-full max-w-xl")
        ui.button(t("live.start"), icon="videocam", on_click=lambda: self._start(Path(choice.value)))

    def _ended(self, job: Job) -> None:
        t = self._t
        if job.state == FAILED and job.error is not None:
            s.show_error(t, job.error)
            return
        ui.label(t("live.ended"))
        for line in job.printed.splitlines()[1:]:  # behind the address of the page
            ui.label(line).classes("text-sm text-grey-8 break-all")
        if take := live.recorded_take(job):
            ui.link(t("live.recorded"), s.link("/take", path=take))

    def _start(self, take: Path) -> None:
        live.start_live(self._desk.jobs, take)

    @ui.refreshable_method
    def _cameras(self) -> None:
        """The cameras that were found, with what they see: to follow one, or several whose places are known."""
        t = self._t
        if self._desk.recorder is not None:
            self._recorded = ui.label(self._said())
            ui.button(t("live.end"), icon="stop", on_click=self._end)
            return
        ui.button(t("live.find"), icon="search", on_click=self._find).props("outline")
        if self._webcams is None:
            return
        if not self._webcams:
            ui.label(t("live.none"))
            return
        boxes = {}
        with ui.row():
            for webcam in self._webcams:
                with ui.column().classes("gap-0"):
                    image = unrecognisable(webcam.image) if self._desk.hide_faces else webcam.image
                    data = b64encode(jpeg(image, _PREVIEW_PX)).decode()
                    preview = ui.image(f"data:image/jpeg;base64,{data}").classes("w-60")
                    preview.props["alt"] = webcam.name
                    boxes[webcam.number] = ui.checkbox(webcam.name, value=True)
        ui.label(t("live.one_alone"))
        places = {"": t("live.no_calibration")}
        places |= {str(file): s.short(file, self._desk.root) for file in self._calibrations}
        where = ui.select(places, value="", label=t("live.calibration")).classes("w-full max-w-xl")

        def chosen() -> dict[int, tuple[int, int]]:
            sizes = {w.number: (w.image.shape[1], w.image.shape[0]) for w in self._webcams or ()}
            return {number: size for number, size in sizes.items() if boxes[number].value}

        with ui.row():
            ui.button(t("live.use"), icon="videocam", on_click=lambda: self._use(chosen(), where.value))
            walk = ui.button(t("live.walk"), icon="directions_walk", on_click=lambda: self._record(chosen()))
            walk.props("outline")

    async def _find(self) -> None:
        ui.notify(self._t("live.finding"))
        self._webcams = await s.in_thread(live.find_webcams)
        self._calibrations = await s.in_thread(live.found_cameras, self._desk.root)
        self._cameras.refresh()

    def _use(self, sizes: dict[int, tuple[int, int]], calibration: str) -> None:
        if not sizes or (len(sizes) > 1 and not calibration):
            ui.notify(self._t("live.needs_calibration" if sizes else "live.choose"), type="warning")
            return
        with s.notified():
            self._start(live.write_live_take(self._desk.root, sizes, Path(calibration) if calibration else None))

    async def _record(self, sizes: dict[int, tuple[int, int]]) -> None:
        if not sizes:
            ui.notify(self._t("live.choose"), type="warning")
            return
        folder = self._desk.root / f"walk-{time.strftime('%Y%m%d-%H%M%S')}"
        with s.notified():
            take = await s.in_thread(live.write_live_take, self._desk.root, sizes)
            self._desk.recorder = await s.in_thread(live.Recorder, take, folder)
        self._cameras.refresh()

    def _said(self) -> str:
        recorder = self._desk.recorder
        return self._t("live.recording", folder=recorder.folder, count=recorder.count) if recorder else ""

    async def _end(self) -> None:
        recorder, self._desk.recorder = self._desk.recorder, None
        if recorder is None:
            return
        ui.notify(self._t("live.writing"))
        try:
            ui.navigate.to(s.link("/take", path=await s.in_thread(recorder.stop)))
        except (KinefitError, OSError) as error:
            ui.notify(str(error), type="negative", timeout=0, close_button=True)
            self._cameras.refresh()
