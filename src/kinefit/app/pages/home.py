"""The first page: the choice of faces, then a recording from this computer or by dropping its videos."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from nicegui import ui

from kinefit._files import writing
from kinefit.app.desk import Desk
from kinefit.app.folders import subfolders, takes_below, video_files
from kinefit.app.pages.shell import card, in_thread, link, shell, short, show_error, texts
from kinefit.app.pages.take import use_folder
from kinefit.app.texts import Texts
from kinefit.errors import KinefitError, printable

_MAX_UPLOAD_BYTES = 2**30  # of a dropped video; larger ones are opened where they are
_MAX_NAMES = 6  # of videos that are listed


async def home_page(desk: Desk) -> None:
    """Build the page."""
    t = texts()
    with shell(desk, t, t("shell.home")):
        if desk.hide_faces is None:
            _ask_faces(desk, t)
            return
        with ui.row().classes("w-full items-stretch"):
            with ui.column().classes("flex-1 min-w-[300px]"), card(t("home.open_title")):
                ui.label(t("home.open_text"))
                _FolderChoice(desk, t)
            with ui.column().classes("flex-1 min-w-[300px]"), card(t("home.drop_title")):
                _drop_area(desk, t)
        with card(t("home.session_title", folder=desk.root)):
            await _takes(desk, t)


def _ask_faces(desk: Desk, t: Texts) -> None:
    def choose(hide: bool) -> None:
        desk.hide_faces = hide
        ui.navigate.reload()

    with card(t("home.faces_title")):
        ui.label(t("home.faces_text"))
        with ui.row():
            ui.button(t("home.hide"), icon="visibility_off", on_click=lambda: choose(True))
            ui.button(t("home.show"), icon="visibility", on_click=lambda: choose(False)).props("outline")


class _FolderChoice:
    """A list of folders to walk through by clicks, with a field for a path."""

    def __init__(self, desk: Desk, t: Texts) -> None:
        self._desk, self._t, self._at = desk, t, desk.root
        self._field = ui.input(t("home.path"), value=str(self._at)).classes("w-full")
        self._field.on("keydown.enter", lambda: self._go(Path(self._field.value).expanduser()))
        self._list()

    @ui.refreshable_method
    def _list(self) -> None:
        t = self._t
        try:
            inside = subfolders(self._at)
        except KinefitError as error:
            show_error(t, error)
            inside = []
        videos = video_files(self._at)
        with ui.scroll_area().classes("w-full h-48 border"), ui.list().props("dense").classes("w-full"):
            if self._at.parent != self._at:  # two elements an entry: hundreds of folders are listed in a moment
                ui.item(f"↑ {t('home.up')}", on_click=lambda: self._go(self._at.parent))
            for folder in inside:
                ui.item(printable(folder.name), on_click=lambda folder=folder: self._go(folder))
        more = " ..." if len(videos) > _MAX_NAMES else ""
        names = printable(", ".join(video.name for video in videos[:_MAX_NAMES]) + more)
        ui.label(t("home.videos_here", count=len(videos), names=names) if videos else t("home.no_videos"))
        ui.button(t("home.use"), icon="folder_open", on_click=self._open)

    def _go(self, folder: Path) -> None:
        self._at = folder
        self._field.value = printable(folder)
        self._list.refresh()

    def _open(self) -> None:
        use_folder(self._desk, Path(self._field.value).expanduser())


def _drop_area(desk: Desk, t: Texts) -> None:
    folder = desk.root / f"recording-{time.strftime('%Y%m%d-%H%M%S')}"
    ui.label(t("home.drop_text", folder=folder))

    async def keep(event: Any) -> None:
        for file in event.files:
            name = Path(file.name).name  # of a browser that sends a path
            try:
                folder.mkdir(parents=True, exist_ok=True)
                with writing(folder / name) as temporary:
                    await file.save(temporary)
            except (OSError, KinefitError) as error:
                ui.notify(t("home.drop_failed", name=name, reason=error), type="negative", timeout=0)
                return
        use_folder(desk, folder)

    def refuse(_: Any) -> None:
        ui.notify(t("home.drop_refused"), type="negative", timeout=0)

    ui.upload(
        label=t("home.drop_label"), multiple=True, auto_upload=True, max_file_size=_MAX_UPLOAD_BYTES,
        on_multi_upload=keep, on_rejected=refuse,
    ).props("accept='video/*,.mkv,.mts,.m2ts,.mxf'").classes("w-full")  # fmt: skip


async def _takes(desk: Desk, t: Texts) -> None:
    takes = await in_thread(lambda: [(take, take.state) for take in takes_below(desk.root)])
    if others := await in_thread(lambda root: takes_below(root, addressable=False), desk.root):
        names = ", ".join(short(take.file.parent, desk.root) for take in others[:_MAX_NAMES])
        ui.label(t("home.session_unnamed", count=len(others), names=names))
    if not takes:
        ui.label(t("home.session_none"))
    for take, state in takes:
        job = desk.jobs.open(take.file)
        with ui.row().classes("items-center w-full"):
            ui.link(short(take.file.parent, desk.root), link("/take", path=take.file)).classes("flex-1")
            ui.label(t(f"state.{job.state if job else state}"))
    if takes:
        ui.link(t("home.session"), "/session")
    ui.link(t("home.live"), "/live")
