"""The page of a live session: the report's moving figure, moved by packets."""

from __future__ import annotations

from html import escape
from importlib import resources

import numpy as np

from kinefit.bodies import Body
from kinefit.exporters.report.figure import live_figure
from kinefit.exporters.report.page import to_json
from kinefit.motion import rotation_between_up
from kinefit.serving.policy import inline_policy
from kinefit.serving.server import Page

_WAITING = '<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="1"><p>waiting for the body'


def live_page(title: str, body: Body | None, up: str) -> Page:
    """Self-contained HTML; without a body it loads itself again until there is one."""
    if body is None:
        return Page(_WAITING.encode())
    figure, capsules = live_figure(body)
    report = resources.files("kinefit.exporters.report")
    own = resources.files("kinefit.live.receivers")
    places = {
        "segments": np.asarray(capsules.segments), "points": np.asarray(capsules.points),
        "turn": rotation_between_up(up, "z"),
    }  # fmt: skip
    style = (report / "page.css").read_text("utf-8") + (own / "page.css").read_text("utf-8")
    scripts = [(room / name).read_text("utf-8") for room, name in ((report, "player.js"), (own, "page.js"))]
    html = (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{style}</style></head><body><main>'
        f'<h1>{escape(title)}</h1><p id="told">waiting</p>{figure}<p id="sensors"></p></main>'
        f'<script type="application/json" id="capsules">{to_json(places)}</script>'
        f"{''.join(f'<script>{script}</script>' for script in scripts)}</body></html>"
    )
    return Page(html.encode(), policy=inline_policy(scripts, [style], "connect-src 'self'"))
