"""All recordings of the session in one table, with their states as they change, and what to do with those chosen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nicegui import ui

from kinefit.app.desk import Desk
from kinefit.app.jobs import DONE, RUNNING
from kinefit.app.overview import SessionRow, recordings
from kinefit.app.pages.shell import in_thread, link, shell, short, texts
from kinefit.app.texts import Texts

_REFRESH_S = 2.0  # between two looks at the folders
_TEXTS, _NUMBERS = ("take", "state", "subject", "date", "movement"), ("seconds", "agreement")
_LINK = '<q-td :props="props"><a :href="props.row.page" class="text-primary">{{ props.value }}</a></q-td>'
"""Of the recording's cell: the way to its page."""


async def session_page(desk: Desk) -> None:
    """Build the page."""
    t = texts()
    with shell(desk, t, t("session.title", folder=desk.root)):
        if desk.hide_faces is None:
            ui.navigate.to("/")
            return
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
            rows = [_row(desk, t, found) for found in await in_thread(recordings, desk.root)]
            if rows != table.rows:
                table.rows = rows
            table.props["no-data-label"] = t("home.session_none")

        ui.timer(_REFRESH_S, look)


def _row(desk: Desk, t: Texts, found: SessionRow) -> dict[str, Any]:
    """A row of the table: texts, and numbers, by which it is sorted."""
    file = found.take.file
    name = short(file.parent if file.name == "take.toml" else file, desk.root)
    return {
        "key": f"{file} {found.person}", "file": str(file), "folder": str(found.folder or ""),
        "page": desk.prefix + link("/take", path=file),
        "take": t("session.of_person", name=name, number=found.person) if found.person else name,
        **{key: found.session.get(key, "") for key in ("subject", "date", "movement")},
        "state": found.problem or _state(desk, t, found),
        "seconds": found.seconds and round(found.seconds, 1),
        "agreement": found.agreement and round(100 * found.agreement),
    }  # fmt: skip


def _state(desk: Desk, t: Texts, found: SessionRow) -> str:
    """That of the last job of the take unless it is done, else that of its files."""
    job = next((job for job in reversed(desk.jobs.jobs) if job.take == found.take.file and job.state != DONE), None)
    if job is None:
        return t(f"state.{found.state}")
    share = [progress.share for progress in job.steps.values()][-1:] if job.state == RUNNING else []
    return t(f"state.{job.state}") + "".join(f" {100 * done:.0f} %" for done in share)


def _compute(desk: Desk, t: Texts, table: ui.table) -> None:
    if not table.selected:
        ui.notify(t("session.none"), type="warning")
    for file in dict.fromkeys(row["file"] for row in table.selected):
        desk.start(Path(file), "track", file, "--json")


def _compare(t: Texts, table: ui.table) -> None:
    keys = {row["key"] for row in table.selected}
    chosen = sorted((row for row in table.rows if row["key"] in keys), key=lambda row: row["date"])
    if len(chosen) != 2 or not all(row["folder"] for row in chosen):
        ui.notify(t("session.two"), type="warning")
        return
    ui.navigate.to(link("/compare", a=chosen[0]["folder"], b=chosen[1]["folder"]))
