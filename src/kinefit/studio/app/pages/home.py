"""The first page, with the choice of faces and the recordings; the session at a glance; two results side by side."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from nicegui import ui

from kinefit._files import writing
from kinefit.bodies.rendering import looks
from kinefit.errors import KinefitError, printable
from kinefit.exporters.tables import spoken
from kinefit.readers.assets import write_sample_take
from kinefit.studio.app.desk import Desk
from kinefit.studio.app.folders import SessionRow, openable_files, recordings, subfolders, takes_below
from kinefit.studio.app.jobs import DONE, RUNNING
from kinefit.studio.app.pages import shell as s
from kinefit.studio.app.pages.result import text_table
from kinefit.studio.app.pages.take import use_folder
from kinefit.studio.app.review import Comparison

_MAX_UPLOAD_BYTES = 2**30  # of a dropped video; larger ones are opened where they are
_MAX_NAMES = 6  # of videos that are listed


async def home_page(desk: Desk) -> None:
    """Build the page."""
    t = s.texts()
    with s.shell(desk, t, t("shell.home")):
        if desk.hide_faces is None:
            _ask_faces(desk, t)
            return
        with ui.row().classes("w-full items-stretch"):
            with ui.column().classes("flex-1 min-w-[300px]"), s.card(t("home.open_title")):
                ui.label(t("home.open_text"))
                _FolderChoice(desk, t)
            with ui.column().classes("flex-1 min-w-[300px]"), s.card(t("home.drop_title")):
                _drop_area(desk, t)
        with s.card(t("home.session_title", folder=desk.root)):
            await _takes(desk, t)
            ui.button(t("home.demo"), icon="directions_run", on_click=lambda: _demo(desk)).props("flat no-caps")


def _ask_faces(desk: Desk, t: s.Texts) -> None:
    def choose(hide: bool) -> None:
        desk.hide_faces = hide
        ui.navigate.reload()

    with s.card(t("home.faces_title")):
        ui.label(t("home.faces_text"))
        with ui.row():
            ui.button(t("home.hide"), icon="visibility_off", on_click=lambda: choose(True))
            ui.button(t("home.show"), icon="visibility", on_click=lambda: choose(False)).props("outline")


async def _demo(desk: Desk) -> None:
    """Open the sample recording; it is written below the session's folder, unless it is there, with its corrections."""
    take = desk.root / "demo" / "take.toml"
    with s.notified():
        if not take.is_file():
            await s.in_thread(write_sample_take, take.parent)
        ui.navigate.to(s.link("/take", path=take))


class _FolderChoice:
    """A list of folders to walk through by clicks, with a field for a path."""

    def __init__(self, desk: Desk, t: s.Texts) -> None:
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
            s.show_error(t, error)
            inside = []
        files = openable_files(self._at)
        with ui.scroll_area().classes("w-full h-48 border"), ui.list().props("dense").classes("w-full"):
            if self._at.parent != self._at:  # two elements an entry: hundreds of folders are listed in a moment
                ui.item(f"↑ {t('home.up')}", on_click=lambda: self._go(self._at.parent))
            for folder in inside:
                ui.item(printable(folder.name), on_click=lambda folder=folder: self._go(folder))
        more = " ..." if len(files) > _MAX_NAMES else ""
        names = printable(", ".join(file.name for file in files[:_MAX_NAMES]) + more)
        ui.label(t("home.files_here", count=len(files), names=names) if files else t("home.no_files"))
        ui.button(t("home.use"), icon="folder_open", on_click=self._open)

    def _go(self, folder: Path) -> None:
        self._at = folder
        self._field.value = printable(folder)
        self._list.refresh()

    def _open(self) -> None:
        use_folder(self._desk, Path(self._field.value).expanduser())


def _drop_area(desk: Desk, t: s.Texts) -> None:
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


async def _takes(desk: Desk, t: s.Texts) -> None:
    takes = await s.in_thread(lambda: [(take, take.state) for take in takes_below(desk.root)])
    if others := await s.in_thread(lambda root: takes_below(root, addressable=False), desk.root):
        names = ", ".join(s.short(take.file.parent, desk.root) for take in others[:_MAX_NAMES])
        ui.label(t("home.session_unnamed", count=len(others), names=names))
    if not takes:
        ui.label(t("home.session_none"))
    for take, state in takes:
        job = desk.jobs.open(take.file)
        with ui.row().classes("items-center w-full"):
            ui.link(s.short(take.file.parent, desk.root), s.link("/take", path=take.file)).classes("flex-1")
            ui.label(t(f"state.{job.state if job else state}"))
    if takes:
        ui.link(t("home.session"), "/session")
    ui.link(t("home.live"), "/live")


_REFRESH_S = 2.0  # between two looks at the folders
_TEXTS, _NUMBERS = ("take", "state", "subject", "date", "movement"), ("seconds", "agreement")
_LINK = '<q-td :props="props"><a :href="props.row.page" class="text-primary">{{ props.value }}</a></q-td>'
"""Of the recording's cell: the way to its page."""


async def session_page(desk: Desk) -> None:
    """Build the page."""
    t = s.texts()
    with s.shell(desk, t, t("session.title", folder=desk.root)):
        columns = [
            {"name": key, "label": t(f"session.{key}"), "field": key, "sortable": True,
             "align": "left" if key in _TEXTS else "right"} for key in (*_TEXTS, *_NUMBERS)
        ]  # fmt: skip
        table = ui.table(columns=columns, rows=[], row_key="key", selection="multiple")
        table.classes("w-full").props("dense hide-selected-banner")
        table.props["no-data-label"] = t("session.reading")
        table.add_slot("body-cell-take", _LINK)
        with ui.row():
            ui.button(t("session.compute"), icon="play_arrow", on_click=lambda: _compute(desk, t, table))
            compare = ui.button(t("session.compare"), icon="compare", on_click=lambda: _compare(t, table))
            compare.props("outline")
        ui.label(t("session.agreement_text")).classes("text-sm")

        async def look() -> None:
            rows = [_row(desk, t, found) for found in await s.in_thread(recordings, desk.root)]
            if rows != table.rows:
                table.rows = rows
            table.props["no-data-label"] = t("home.session_none")

        ui.timer(_REFRESH_S, look)


def _row(desk: Desk, t: s.Texts, found: SessionRow) -> dict[str, Any]:
    """A row of the table: texts, and numbers, by which it is sorted."""
    file = found.take.file
    name = s.short(file.parent if file.name == "take.toml" else file, desk.root)
    return {
        "key": f"{file} {found.person}", "file": str(file), "folder": str(found.folder or ""),
        "page": desk.prefix + s.link("/take", path=file),
        "take": t("session.of_person", name=name, number=found.person) if found.person else name,
        **{key: found.session.get(key, "") for key in ("subject", "date", "movement")},
        "state": found.problem or _state(desk, t, found),
        "seconds": found.seconds and round(found.seconds, 1),
        "agreement": found.agreement and round(100 * found.agreement),
    }  # fmt: skip


def _state(desk: Desk, t: s.Texts, found: SessionRow) -> str:
    """That of the last job of the take unless it is done, else that of its files."""
    job = next((job for job in reversed(desk.jobs.jobs) if job.take == found.take.file and job.state != DONE), None)
    if job is None:
        return t(f"state.{found.state}")
    share = [progress.share for progress in job.steps.values()][-1:] if job.state == RUNNING else []
    return t(f"state.{job.state}") + "".join(f" {100 * done:.0f} %" for done in share)


def _compute(desk: Desk, t: s.Texts, table: ui.table) -> None:
    if not table.selected:
        ui.notify(t("session.none"), type="warning")
    for file in dict.fromkeys(row["file"] for row in table.selected):
        desk.start(Path(file), "track", file, "--json")


def _compare(t: s.Texts, table: ui.table) -> None:
    keys = {row["key"] for row in table.selected}
    chosen = sorted((row for row in table.rows if row["key"] in keys), key=lambda row: row["date"])
    if len(chosen) != 2 or not all(row["folder"] for row in chosen):
        ui.notify(t("session.two"), type="warning")
        return
    ui.navigate.to(s.link("/compare", a=chosen[0]["folder"], b=chosen[1]["folder"]))


_MAX_POINTS = 2000  # of a curve


async def compare_page(desk: Desk, before: Path, after: Path) -> None:
    """Build the page of two folders of results."""
    t = s.texts()
    with s.shell(desk, t, t("compare.title")):
        names = t("compare.before", name=s.short(before, desk.root)), t("compare.after", name=s.short(after, desk.root))
        with ui.row().classes("items-center"):
            for name in names:
                ui.label(name).classes("break-all")
            to = s.link("/compare", a=after, b=before)
            ui.button(t("compare.swap"), icon="swap_horiz", on_click=lambda: ui.navigate.to(to)).props("flat")
        both = await s.loaded(t, t("compare.loading"), desk.comparison, before, after)
        if both is None:
            return
        with s.card(t("compare.scene")):
            s.page_frame(both.scene.address, t("compare.scene")).classes("w-full h-[32rem] border")
        with s.card(t("compare.angle")):
            _angles(t, both, names)
        with s.card(t("compare.ranges")):
            _ranges(t, both)


def _angles(t: s.Texts, both: Comparison, names: tuple[str, str]) -> None:
    """A choice of an angle, and its two curves from the first frame of each on."""

    def draw() -> None:
        series = [
            {"type": "line", "name": names[k], "showSymbol": False, "data": both.points(choice.value, k, _MAX_POINTS),
             "itemStyle": {"color": looks.to_hex((looks.LEFT_COLOUR, looks.RIGHT_COLOUR)[k])},
             "lineStyle": {"type": ("solid", "dashed")[k]}} for k in (0, 1)
        ]  # fmt: skip
        chart.options.update({
            "animation": False, "grid": {"left": 45, "right": 25, "top": 70, "bottom": 30},
            "legend": {"top": 0, "orient": "vertical"}, "tooltip": {"trigger": "axis"},
            "xAxis": {"type": "value", "name": "s"},
            "yAxis": {"type": "value", "scale": True, "name": t("result.angles_unit")}, "series": series,
        })  # fmt: skip
        chart.update()

    angles = {name: spoken(name) for name in both.angles}
    first = next((name for name in angles if name.startswith("knee_angle")), next(iter(angles)))
    choice = ui.select(angles, value=first, label=t("compare.angle"), on_change=draw).classes("w-64")
    chart = ui.echart({}).classes("w-full h-[22rem]")
    draw()


def _ranges(t: s.Texts, both: Comparison) -> None:
    ui.label(t("compare.ranges_text")).classes("text-sm")
    columns = [t(f"compare.{key}") for key in ("angle", "range_before", "range_after", "change")]
    rows = ((of.angle, of.before, of.after, "● " * of.is_clear + of.change) for of in both.ranges)
    text_table(columns, rows)
