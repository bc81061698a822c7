"""One self-contained HTML page: every picture, plot and script lies in the file, which loads nothing.

A page is made of parts of type `Html`; plain text is escaped wherever it is given. A rule in the head of the page (its
content security policy) forbids the browser to load anything from elsewhere. Plots are drawn by plotly.js, which is put
in once, compressed, and only where there is a plot. `kinefit.readers.assets` fetches it before the first page with a
plot; a page that is written where it cannot be fetched says so and has no plots.

    text = page("Balancing", [
        section("Quality", paragraph("All frames were tracked."), plot([{"x": times, "y": quality}])),
    ])
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from html import escape
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote as urlquote

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies.rendering import looks
from kinefit.errors import AssetError, ExportError
from kinefit.findings import Finding

# Left and right as in overlays.
LEFT_COLOUR, RIGHT_COLOUR = looks.to_hex(looks.LEFT_COLOUR), looks.to_hex(looks.RIGHT_COLOUR)
CENTRE_COLOUR = looks.to_hex(looks.CENTRE_COLOUR)
SERIES = (LEFT_COLOUR, RIGHT_COLOUR, CENTRE_COLOUR, "#cc79a7", "#7a5195", "#56b4e9", "#b8860b", "#4d4d4d")
SEVERITIES = {"good": "✓", "note": "i", "warning": "!", "bad": "✕"}
_FINDINGS = {
    "fault": ("bad", "Fault"), "doubt": ("warning", "Doubt"), "note": ("note", "Note"), "good": ("good", "In order"),
}  # fmt: skip

_PLOTS_REMEDY = "Run kinefit warmup once where the package index can be reached, then write this page again."
_SHADES = 20  # steps of the ground of a table's cell, from white to the right side's orange; text stays dark on all

MAX_CURVE_POINTS = 1000  # points of a curve; the page is about as many pixels wide
_ROW_PX, _GAP_PX, _HEAD_PX = 190, 34, 62  # height of one row, of the gap to the next, of legend and names above


class Html(str):
    """Text that is HTML already and not escaped again."""

    __slots__ = ()


@dataclass(frozen=True)
class Section:
    """A part of the page with a heading, named in the contents; `anchor` is what links point to."""

    title: str
    anchor: str
    html: Html


def page(title: str, sections: Iterable[Section | str], *, subtitle: str = "", contents: bool = True) -> str:
    """The text of a whole page.

    Parameters
    ----------
    title, subtitle : str
        Heads the page.
    sections : Section, Html, or text
        In this order; the sections are listed in the contents.
    contents : bool
        Whether there is a list of links to the sections.
    """
    parts = list(sections)
    links = [f'<a href="#{p.anchor}">{escape(p.title)}</a>' for p in parts if isinstance(p, Section)]
    body = "\n".join(_section_html(p) if isinstance(p, Section) else inline(p) for p in parts)
    scripts = [_resource(name) for name in ("page.js", *(["player.js"] if 'class="player"' in body else []))]
    style, library, allowed = _resource("page.css") + _shades(), "", list(scripts)
    if 'class="plot"' in body:
        script, packed = _plotly()
        if packed:
            library = f'<script type="text/plain" id="plotly-gzip">{packed}</script>'
            allowed.append(script)
        else:
            body = callout("note", "The plots of this page are missing", script, _PLOTS_REMEDY) + body
    # plotly.js adds its rules to style elements that are empty when they are made
    policy = inline_policy(allowed, [style, ""], "img-src data: blob:; font-src data:")
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title>\n<style>{style}</style>\n</head>\n<body>",
            f"<header><h1>{escape(title)}</h1>" + (f'<p class="sub">{inline(subtitle)}</p>' if subtitle else ""),
            (f"<nav>{''.join(links)}</nav>" if contents and links else "") + "</header>\n<main>",
            "<noscript><p>The plots and the moving figure of this page need JavaScript.</p></noscript>",
            f"{body}\n</main>",
            library,
            *(f"<script>{script}</script>" for script in scripts),
            "</body>\n</html>\n",
        ]
    )


def inline(content: str) -> Html:
    """The content as HTML: `Html` as it is, other text escaped."""
    return content if isinstance(content, Html) else Html(escape(str(content)))


def joined(*parts: str) -> Html:
    """Parts one after the other."""
    return Html("".join(inline(part) for part in parts))


def section(title: str, *parts: str, anchor: str | None = None) -> Section:
    """A section of the page; plain text becomes a paragraph each."""
    return Section(title, anchor or slug(title), joined(*(_block(part) for part in parts)))


def slug(text: str) -> str:
    """Name for an anchor: small letters, digits and dashes."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") or "part"


def heading(text: str, level: int = 3) -> Html:
    """A heading within a section."""
    return Html(f'<h{level} id="{slug(text)}">{inline(text)}</h{level}>')


def paragraph(*texts: str, small: bool = False) -> Html:
    """A paragraph of text and inline parts."""
    return Html(f"<p{' class=small' if small else ''}>{joined(*texts)}</p>")


def strong(text: str) -> Html:
    """Text that stands out."""
    return Html(f"<strong>{inline(text)}</strong>")


def link(anchor: str, text: str) -> Html:
    """Link to a place in this page."""
    return Html(f'<a href="#{escape(anchor)}">{inline(text)}</a>')


def moment(seconds: float, text: str) -> Html:
    """Link that moves the page's 3D figure to a time [s]."""
    return Html(f'<a class="seek" href="#figure" data-time="{float(seconds):.6g}">{inline(text)}</a>')


def bullets(items: Iterable[str]) -> Html:
    """A list of points."""
    return Html("<ul>" + "".join(f"<li>{inline(item)}</li>" for item in items) + "</ul>")


def callout(severity: str, title: str, *parts: str) -> Html:
    """A box that stands out; severity "good", "note", "warning" or "bad" (shown by sign and colour)."""
    sign = SEVERITIES[severity]
    body = "".join(_block(part) for part in parts)
    return Html(
        f'<div class="callout {severity}"><div class="sign" aria-hidden="true">{sign}</div>'
        f'<div><p class="head">{inline(title)}</p>{body}</div></div>'
    )


def folded(title: str, *parts: str, opened: bool = False) -> Html:
    """Parts that unfold at a click."""
    body = "".join(_block(part) for part in parts)
    return Html(f"<details{' open' if opened else ''}><summary>{inline(title)}</summary>{body}</details>")


def chooser(label: str, choices: Mapping[str, str]) -> Html:
    """A menu of parts {name: part} of which one is shown; all are printed."""
    options = "".join(f"<option>{escape(name)}</option>" for name in choices)
    parts = "".join(
        f'<div class="choice"{" hidden" if k else ""}><p class="name">{escape(name)}</p>{_block(part)}</div>'
        for k, (name, part) in enumerate(choices.items())
    )
    return Html(f'<div class="chooser"><label>{inline(label)} <select>{options}</select></label>{parts}</div>')


def facts(pairs: Mapping[str, str]) -> Html:
    """Names with their values, in a compact grid."""
    items = "".join(f"<div><dt>{inline(k)}</dt><dd>{inline(v)}</dd></div>" for k, v in pairs.items())
    return Html(f'<dl class="facts">{items}</dl>')


def table(columns: Sequence[str], rows: Iterable[Sequence[str]], *, caption: str = "", first_left: int = 1) -> Html:
    """A table; the first `first_left` columns are set left, the others right as numbers are.

    A cell may be text, `Html`, or what `shaded` gives.
    """

    def cell(tag: str, at: int, content: str) -> str:
        if content.startswith("<td") and isinstance(content, Html):
            return content
        return f"<{tag}{' class=l' if at < first_left else ''}>{inline(content)}</{tag}>"

    head = "".join(cell("th", i, name) for i, name in enumerate(columns))
    body = "".join("<tr>" + "".join(cell("td", i, c) for i, c in enumerate(row)) + "</tr>" for row in rows)
    caption_tag = f"<caption>{inline(caption)}</caption>" if caption else ""
    table = f"<table>{caption_tag}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return Html(f'<div class="wide">{table}</div>')


def shaded(text: str, share: float) -> Html:
    """Cell of a table whose ground is the darker the nearer `share` is to 1; none where it is not finite."""
    if not math.isfinite(share):
        return Html(f"<td>{inline(text)}</td>")
    return Html(f'<td class="shade-{round(_SHADES * min(max(share, 0.0), 1.0))}">{inline(text)}</td>')


def quote(text: str) -> Html:
    """A text to take over as it stands."""
    return Html(f"<blockquote>{inline(text)}</blockquote>")


def file_link(path: str, text: str | None = None) -> Html:
    """Link to a file that lies next to the page, by its relative path."""
    return Html(f'<a href="{escape(urlquote(path))}">{inline(path if text is None else text)}</a>')


def code(text: str) -> Html:
    """Text set as it is, line by line."""
    return Html(f"<pre>{escape(text)}</pre>")


def scaled(image: NDArray[np.uint8], longest: int) -> NDArray[np.uint8]:
    """An image (H, W, 3) whose longer side has at most `longest` [px]."""
    share = longest / max(image.shape[:2])
    if share >= 1.0:
        return image
    size = max(1, round(share * image.shape[1])), max(1, round(share * image.shape[0]))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def picture(
    image: NDArray[np.uint8], *, caption: str = "", width: int = 900, quality: int = 80, lossless: bool = False
) -> Html:
    """A picture (H, W, 3) uint8 RGB with its caption, put in as JPEG (or PNG) at most `width` px wide and high.

    Raises
    ------
    ExportError
        Where the array is no picture.
    """
    array = np.asarray(image)
    if array.ndim != 3 or array.shape[2] != 3 or array.dtype != np.uint8 or 0 in array.shape:
        raise ExportError(f"an image of shape {array.shape}, {array.dtype}", remedy="Give (H, W, 3) uint8 RGB.")
    array = scaled(array, width)
    kind, options = ("png", []) if lossless else ("jpeg", [cv2.IMWRITE_JPEG_QUALITY, quality])
    encoded, data = cv2.imencode(f".{kind}", cv2.cvtColor(array, cv2.COLOR_RGB2BGR), options)
    if not encoded:
        raise ExportError("an image cannot be encoded", remedy="Give (H, W, 3) uint8 RGB.")
    text = base64.b64encode(data.tobytes()).decode("ascii")
    caption_tag = f"<figcaption>{inline(caption)}</figcaption>" if caption else ""
    return Html(
        f'<figure><img alt="{escape(re.sub("<[^>]*>", "", caption))}" width="{array.shape[1]}" '
        f'height="{array.shape[0]}" src="data:image/{kind};base64,{text}">{caption_tag}</figure>'
    )


def gallery(pictures: Iterable[Html], *, size: str = "medium") -> Html:
    """Pictures side by side, none narrower than 170 ("small"), 230 ("medium") or 420 px ("large")."""
    return Html(f'<div class="gallery gallery-{size}">{"".join(pictures)}</div>')


def plot(
    traces: Iterable[Mapping[str, Any]], layout: Mapping[str, Any] | None = None, *,
    height: int = 320, label: str = "", seeks: bool = False,
) -> Html:  # fmt: skip
    """A plot by plotly.js.

    Parameters
    ----------
    traces : list of dicts
        As plotly.js takes them; arrays may hold NaN, which become gaps.
    layout : dict, optional
        What differs from the page's own layout.
    height : int [px]
    label : str
        What the plot shows, for readers who do not see it.
    seeks : bool
        Whether x is the time [s], so that a click moves the page's 3D figure there.
    """
    data = to_json({"data": list(traces), "layout": {**dict(layout or {}), "height": height}})
    marks = " data-seeks" if seeks else ""
    return Html(
        f'<div class="plot" role="img" aria-label="{escape(label)}" data-height="{height}"{marks}>'
        f'<script type="application/json">{data}</script></div>'
    )


def to_json(value: Any) -> str:
    """JSON to stand in a script: floats to six digits, what is not finite as null, no "</" that would end it."""
    text = json.dumps(_plain(value), separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def _block(part: str) -> Html:
    return part if isinstance(part, Html) else paragraph(part)


def _section_html(part: Section) -> Html:
    return Html(f'<section id="{escape(part.anchor)}"><h2>{escape(part.title)}</h2>{part.html}</section>')


@lru_cache(maxsize=8)
def _resource(name: str) -> str:
    return Path(__file__).with_name(name).read_text("utf-8")


def _shades() -> str:
    """Rules of `shaded` cells: a page's policy allows no style of a single element."""
    rules = []
    for k in range(_SHADES + 1):
        red, green, blue = (round(255 + (end - 255) * 0.75 * k / _SHADES) for end in looks.RIGHT_COLOUR)
        rules.append(f".shade-{k} {{ background: rgb({red},{green},{blue}); }}\n")
    return "".join(rules)


@lru_cache(maxsize=1)
def _plotly() -> tuple[str, str]:
    """plotly.js, and compressed, 2 MB where it has 5; the page unpacks it. Why it cannot be had, and ""."""
    from kinefit.readers.assets import PLOTLY_PACKAGE, fetch

    try:
        script = (fetch(PLOTLY_PACKAGE) / "plotly.min.js").read_bytes()
    except AssetError as error:
        return str(error), ""
    return script.decode("utf-8"), base64.b64encode(gzip.compress(script, 9, mtime=0)).decode("ascii")


def finding_callout(found: Finding, where: str = "") -> Html:
    """One finding; `where` says of what, on a page about several takes."""
    look, title = _FINDINGS[found.severity]
    parts = [paragraph(text, small=True) for text in (found.confidence, found.alike) if text]
    if found.remedy:
        parts.append(paragraph(strong("What to do: "), found.remedy))
    head = joined(strong(f"{where}{': ' if where else ''}{title}. "), found.text)
    return callout(look, head, *parts)


def fault_sections(faults: Iterable[Finding]) -> list[Section]:
    """The first section of a report on a motion whose inputs have faults; none where they have none."""
    boxes = [finding_callout(found) for found in faults]
    if not boxes:
        return []
    text = "The results below follow from inputs with these faults. Correct them and track again."
    return [section("Faults of the inputs", paragraph(text), *boxes)]


class Stroke(NamedTuple):
    """How a line is drawn: its colour, its width [px], its dashes ("" for none)."""

    color: str
    width: float
    dash: str = ""


def line(
    x: ArrayLike, y: ArrayLike, name: str, stroke: Stroke, *, hover: str = "", row: int = 0, legend: bool = False,
    **more: Any,
) -> dict[str, Any]:  # fmt: skip
    """A line in a row, of single points where it has no more than two; without `hover` it says nothing of itself."""
    return {
        "x": x, "y": y, "mode": "lines" if np.size(x) > 2 else "markers", "name": name, "legendgroup": name,
        "line": {name: value for name, value in stroke._asdict().items() if value}, "showlegend": legend,
        **({"hovertemplate": f"{hover}<extra></extra>"} if hover else {"hoverinfo": "skip"}), **_axes(row), **more,
    }  # fmt: skip


def band(x: NDArray, middle: NDArray, half: NDArray, name: str, colour: str, row: int = 0) -> list[dict[str, Any]]:
    """A band about a line: closed polygons, one for each run of finite halves; nothing where there is none."""
    known = np.flatnonzero(np.isfinite(half))
    xs: list[NDArray] = []
    ys: list[NDArray] = []
    for part in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1):
        xs += [x[part], x[part[::-1]], np.full(1, np.nan)]
        ys += [(middle + half)[part], (middle - half)[part[::-1]], np.full(1, np.nan)]
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    trace = {
        "x": np.concatenate(xs)[:-1], "y": np.concatenate(ys)[:-1], "mode": "none", "fill": "toself",
        "fillcolor": f"rgba({red},{green},{blue},0.17)", "hoverinfo": "skip", "showlegend": False, "legendgroup": name,
        **_axes(row),
    }  # fmt: skip
    return [trace] if len(known) else []


def mark(along: str, at: float, stroke: Stroke) -> dict[str, Any]:
    """A straight line across a plot at a place on its axis "x" (of all rows) or "y"."""
    other = "y" if along == "x" else "x"
    place = {f"{along}ref": along, f"{along}0": at, f"{along}1": at, f"{other}ref": "paper", f"{other}0": 0}
    return {"type": "line", **place, f"{other}1": 1, "line": stroke._asdict()}


def stacked(
    traces: Iterable[dict[str, Any]], rows: Sequence[dict[str, Any]], x: str, label: str, *, names: Sequence[str] = (),
    marks: Iterable[dict[str, Any]] = (), seeks: bool = False,
) -> Html:  # fmt: skip
    """Rows of plots one below the other on one x axis: what differs of their y axes, and their names above them."""
    n, notes = len(rows), []
    height = _ROW_PX * n + _HEAD_PX + 16
    gap = _GAP_PX / (_ROW_PX * n)
    tall = (1 - gap * (n - 1)) / n
    layout: dict[str, Any] = {"margin": {"l": 52, "r": 12, "t": _HEAD_PX, "b": 42}, "shapes": list(marks)}
    for k, row in enumerate(rows):
        top = 1 - k * (tall + gap)
        layout[f"yaxis{k + 1}" if k else "yaxis"] = {"domain": [max(0.0, top - tall), top], "anchor": "x", **row}
        notes += [{
            "text": text, "x": 0, "xref": "paper", "xanchor": "left", "y": top, "yref": "paper", "yanchor": "bottom",
            "showarrow": False, "font": {"size": 12.5, "weight": 600},  # a part in bold would be a style of its element
        } for text in names[k : k + 1]]  # fmt: skip
    legend = {"orientation": "h", "x": 0, "xanchor": "left", "y": 1 + 32 / height, "yanchor": "bottom"}
    layout |= {"xaxis": {"title": x, "anchor": f"y{n}" if n > 1 else "y"}, "annotations": notes, "legend": legend}
    below_lines = sorted(traces, key=lambda trace: "fill" not in trace)  # bands first
    return plot(below_lines, layout, height=height, label=label, seeks=seeks)


def thinned(values: NDArray, most: int = MAX_CURVE_POINTS) -> NDArray:
    """Frames that keep the shape of a curve (F,): the lowest and highest value of each of `most` / 2 equal parts."""
    if len(values) <= most:
        return np.arange(len(values))
    parts = np.array_split(np.arange(len(values)), most // 2)
    ends = [p[k] for p in parts for k in (np.argmin(values[p]), np.argmax(values[p]))]
    return np.unique([0, *ends, len(values) - 1])


def _axes(row: int) -> dict[str, str]:
    return {"xaxis": "x", "yaxis": f"y{row + 1}" if row else "y"}


def inline_policy(scripts: Iterable[str], styles: Iterable[str], more: str = "") -> str:
    """A policy under which a page runs exactly these inline scripts and styles, by their hashes, and fetches nothing.

    Parameters
    ----------
    scripts, styles : texts of the elements, to the letter
    more : further directives, such as "img-src data:"
    """
    hashes = [" ".join(_hash(text) for text in texts) or "'none'" for texts in (scripts, styles)]
    rules = ["default-src 'none'", f"script-src {hashes[0]}", f"style-src {hashes[1]}"]
    return "; ".join([*rules, *([more] if more else []), "base-uri 'none'", "form-action 'none'"])


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
