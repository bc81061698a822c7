"""What all pages have: header, choice of faces, errors, calls that run in a thread.

All words of the app's pages, in the languages that it speaks: `texts_en.toml` and its translations.
"""

from __future__ import annotations

import asyncio
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote

from nicegui import ui

from kinefit.bodies.rendering import looks
from kinefit.errors import KinefitError, printable
from kinefit.studio.app.desk import Desk

Value = TypeVar("Value")

COLOURS = {
    "fault": looks.RIGHT_COLOUR, "doubt": (176, 132, 0), "note": looks.LEFT_COLOUR, "good": looks.CENTRE_COLOUR,
}  # fmt: skip
"""RGB of the severities of findings: safe for the colour-blind, and dark enough for text."""


def texts() -> Texts:
    """The words of the page that is built, in the language of its browser."""
    request = ui.context.client.request
    return Texts(preferred_language(request.headers.get("accept-language", "")) if request else "en")


def link(page: str, **parameters: object) -> str:
    """Path of a page with parameters, such as a take file."""
    query = "&".join(f"{name}={quote(str(value), safe='', errors='replace')}" for name, value in parameters.items())
    return f"{page}?{query}" if query else page


@contextmanager
def shell(desk: Desk, t: Texts, title: str) -> Iterator[None]:
    """The frame of a page: a header with the way home and the choice of faces, and a column for the content."""
    ui.colors(primary=looks.to_hex(looks.LEFT_COLOUR))
    ui.page_title(f"{title} - kinefit")
    with ui.header().classes("items-center justify-between q-py-xs"):
        ui.link("kinefit", "/").classes("text-white text-lg no-underline font-bold")
        ui.link(t("shell.home"), "/").classes("text-white no-underline")
        ui.space()
        if desk.hide_faces is not None:
            face_switch(desk, t)
    with ui.column().classes("w-full max-w-7xl mx-auto gap-4 p-2"):
        ui.label(title).classes("text-2xl").props('role="heading" aria-level="1"')
        yield


def face_switch(desk: Desk, t: Texts) -> None:
    """The choice of faces as a switch; the page is loaded anew, as all its images change."""

    def change(event: Any) -> None:
        desk.hide_faces = bool(event.value)
        ui.navigate.reload()

    said = "shell.faces_hidden" if desk.hide_faces else "shell.faces_shown"
    switch = ui.switch(t(said), value=desk.hide_faces, on_change=change)
    switch.props("dark color=white").tooltip(t("shell.faces_change"))


def page_frame(address: str, title: str) -> ui.element:
    """Another page within this one."""
    made = ui.element("iframe")
    made.props.update(src=address, title=title)  # as values: a text would be read for further properties
    return made


def card(title: str) -> ui.card:
    """A card with a heading."""
    made = ui.card().classes("w-full")
    with made:
        ui.label(title).classes("text-lg font-medium").props('role="heading" aria-level="2"')
    return made


def show_error(t: Texts, error: KinefitError | dict[str, str]) -> None:
    """An error as a card: what is wrong, where, and what to do."""
    if isinstance(error, KinefitError):
        where = ", ".join(str(part) for part in (error.file, error.place) if part)
        error = {"problem": error.problem, "at": where, "try": error.remedy or ""}
    with ui.card().classes("w-full").style(f"border-left: 6px solid {looks.to_hex(COLOURS['fault'])}"):
        with ui.row().classes("items-center no-wrap"):
            ui.icon("error", size="sm").style(f"color: {looks.to_hex(COLOURS['fault'])}")
            ui.label(error["problem"]).props('role="alert"')
        if error.get("at"):
            ui.label(t("shell.where", at=error["at"])).classes("text-sm text-grey-8 break-all")
        if error.get("try"):
            ui.label(t("shell.remedy", remedy=error["try"])).classes("text-sm")


async def in_thread(function: Callable[..., Value], *arguments: Any, **options: Any) -> Value:
    """Call something slow in a thread, so that the pages answer meanwhile."""
    return await asyncio.to_thread(function, *arguments, **options)


async def loaded(t: Texts, said: str, function: Callable[..., Value], *arguments: Any) -> Value | None:
    """What something slow returns, called in a thread while the page shows a text; None, and its error as a card."""
    waiting = ui.label(said)
    await ui.context.client.connected()
    try:
        return await in_thread(function, *arguments)
    except KinefitError as error:
        show_error(t, error)
        return None
    finally:
        waiting.delete()


def short(path: Path, root: Path) -> str:
    """A path relative to the session's folder where it lies in it."""
    return printable(path.relative_to(root).as_posix() if path.is_relative_to(root) else path)


@contextmanager
def notified() -> Iterator[None]:
    """Notify the user of an error, in place of raising it."""
    try:
        yield
    except (KinefitError, OSError) as error:
        ui.notify(str(error), type="negative", timeout=0, close_button=True)


LANGUAGES = ("en", "de")
"""Languages of the pages; the first is taken for a browser that asks for none of them."""


@cache
def words(language: str) -> dict[str, str]:
    """{"table.key": text} of a language."""
    tables = tomllib.loads(Path(__file__).parents[1].joinpath(f"texts_{language}.toml").read_text("utf-8"))
    return {f"{table}.{key}": text for table, texts in tables.items() for key, text in texts.items()}


class Texts:
    """The words of one language, called with a key and the values that stand in the text."""

    def __init__(self, language: str) -> None:
        self.language = language
        self._words = words(language)

    def __call__(self, key: str, **values: object) -> str:
        """A text, with its values put in."""
        return self._words[key].format(**values)

    def get(self, key: str) -> str | None:
        """A text without values; None if there is none of this key."""
        return self._words.get(key)


def preferred_language(accepted: str) -> str:
    """The first of LANGUAGES that a browser's header `Accept-Language` asks for, such as "de-AT,de;q=0.9,en;q=0.8"."""
    for part in accepted.split(","):
        language = part.split(";")[0].strip().lower().partition("-")[0]
        if language in LANGUAGES:
            return language
    return LANGUAGES[0]
