"""Two results side by side: both motions in one scene, their angles over each other, ranges of motion and changes."""

from __future__ import annotations

from pathlib import Path

from nicegui import ui

from kinefit.app.compare import Comparison
from kinefit.app.desk import Desk
from kinefit.app.pages.shell import card, link, loaded, page_frame, shell, short, texts
from kinefit.app.texts import Texts
from kinefit.rendering import looks

_MAX_POINTS = 2000  # of a curve


async def compare_page(desk: Desk, before: Path, after: Path) -> None:
    """Build the page of two folders of results."""
    t = texts()
    with shell(desk, t, t("compare.title")):
        if desk.hide_faces is None:
            ui.navigate.to("/")
            return
        names = t("compare.before", name=short(before, desk.root)), t("compare.after", name=short(after, desk.root))
        with ui.row().classes("items-center"):
            for name in names:
                ui.label(name).classes("break-all")
            to = link("/compare", a=after, b=before)
            ui.button(t("compare.swap"), icon="swap_horiz", on_click=lambda: ui.navigate.to(to)).props("flat")
        both = await loaded(t, t("compare.loading"), desk.comparison, before, after)
        if both is None:
            return
        with card(t("compare.scene")):
            page_frame(both.scene.address, t("compare.scene")).classes("w-full h-[32rem] border")
        with card(t("compare.angle")):
            _angles(t, both, names)
        with card(t("compare.ranges")):
            _ranges(t, both)


def _angles(t: Texts, both: Comparison, names: tuple[str, str]) -> None:
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

    angles = list(both.angles)
    first = next((name for name in angles if name.startswith("knee_angle")), angles[0])
    choice = ui.select(angles, value=first, label=t("compare.angle"), on_change=draw).classes("w-48")
    chart = ui.echart({}).classes("w-full h-[22rem]")
    draw()


def _ranges(t: Texts, both: Comparison) -> None:
    ui.label(t("compare.ranges_text")).classes("text-sm")
    keys = ("angle", "range_before", "range_after", "change")
    columns = [
        {"name": key, "label": t(f"compare.{key}"), "field": key, "align": "left" if key == "angle" else "right"}
        for key in keys
    ]
    rows = []
    for of in both.ranges:
        values = (text.replace(" ", "\u00a0") for text in (of.before, of.after, "● " * of.is_clear + of.change))
        rows.append(dict(zip(keys, (of.angle, *values), strict=True)))
    ui.table(columns=columns, rows=rows, row_key="angle").classes("w-full").props("dense wrap-cells")
