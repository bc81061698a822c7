"""Who is meant: pictures of the people of a take, once they are detected, as a choice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nicegui import ui

from kinefit.app.desk import Desk
from kinefit.app.pages.shell import in_thread, link, notified
from kinefit.app.people import PersonPicture
from kinefit.app.texts import Texts
from kinefit.batch import corrections
from kinefit.errors import KinefitError
from kinefit.readers.take.file import read_take

_REFRESH_S = 3.0  # between two looks at what is detected


def people_cards(desk: Desk, t: Texts, take: Path, who: ui.select) -> None:
    """Pictures that appear below once there are several people; a click writes the choice into the take file.

    `who` is the choice by words, which then stands for what the take file says.
    """
    shown: list[tuple[PersonPicture, ...]] = [()]

    def choose(number: int | None) -> None:
        with notified():
            corrections.choose_person(take, number)
        who.value = ""
        cards.refresh()

    @ui.refreshable
    def cards() -> None:
        pictures, chosen = shown[0], _chosen(take)
        said = t("people.choose", number=chosen) if chosen else t("people.everybody")
        who.set_options({**_options(who), "": said}, value=who.value)
        if not pictures:
            return
        ui.label(t("people.text"))
        with ui.row().classes("items-end"):
            for picture in pictures:
                number, said = picture.number, t("people.choose", number=picture.number)
                with ui.column().classes("gap-1 items-center"):
                    source = link("/image/person", path=take, number=number)
                    image = ui.image(source).classes("w-28 h-40 cursor-pointer").props("fit=contain")
                    image.props["alt"] = said
                    image.on("click", lambda n=number: choose(n))
                    _button(said, number == chosen, lambda n=number: choose(n))
            _button(t("people.everybody"), not chosen, lambda: choose(None))
        if chosen:
            ui.label(t("people.chosen", number=chosen)).classes("text-sm")

    async def look() -> None:
        found = await in_thread(desk.people.of, take, hide_faces=bool(desk.hide_faces))
        if found is not shown[0] and (found or shown[0]):
            shown[0] = found
            cards.refresh()

    cards()
    ui.timer(_REFRESH_S, look)


def _options(who: ui.select) -> dict[Any, Any]:
    assert isinstance(who.options, dict)
    return who.options


def _chosen(take: Path) -> int | None:
    """Number of the person that the take file names; None for everybody, and where words say who."""
    try:
        person = read_take(take).person
    except KinefitError:
        return None
    return person if isinstance(person, int) else None


def _button(text: str, is_chosen: bool, on_click: Any) -> None:
    ui.button(text, icon="check" if is_chosen else "person", on_click=on_click).props("" if is_chosen else "outline")
