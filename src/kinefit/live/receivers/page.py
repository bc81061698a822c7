"""The page of a live session: the report's moving figure, moved by packets."""

from __future__ import annotations

from html import escape
from importlib import resources

import numpy as np

from kinefit.bodies import Body
from kinefit.exporters.report.figure import live_figure
from kinefit.exporters.report.page import to_json
from kinefit.motion import rotation_between_up


def page(title: str, body: Body | None, up: str) -> str:
    """Self-contained HTML; without a body it loads itself again until there is one."""
    if body is None:
        return '<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="1"><p>waiting for the body'
    figure, capsules = live_figure(body)
    report = resources.files("kinefit.exporters.report")
    own = resources.files("kinefit.live.receivers")
    places = {
        "segments": np.asarray(capsules.segments), "points": np.asarray(capsules.points),
        "turn": rotation_between_up(up, "z"),
    }  # fmt: skip
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{(report / "page.css").read_text()}'
        f'{(own / "page.css").read_text()}</style></head><body><main><h1>{escape(title)}</h1>'
        f'<p id="told">waiting</p>{figure}<p id="sensors"></p></main>'
        f'<script type="application/json" id="capsules">{to_json(places)}</script>'
        f'<script>{(report / "player.js").read_text()}</script><script>{(own / "page.js").read_text()}</script>'
        "</body></html>"
    )
