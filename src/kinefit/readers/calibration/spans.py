"""Locate the value of a key in TOML, JSON or YAML text, so that it can be replaced and all else kept."""

from __future__ import annotations

import json
import re
from typing import NamedTuple

_STRING = r'"(?:\\.|[^"\\\n])*"|\'[^\'\n]*\''
_TOKEN = re.compile(rf"#[^\n]*|({_STRING}|[\w.-]+)(?:[ \t]*([:=]))?")
_BRACKET = re.compile(rf"#[^\n]*|{_STRING}|[\[\]{{}}]")
_LEAD = re.compile(r"\s*(!!opencv-[\w-]+|\{|\[)?")


class ValueSpan(NamedTuple):
    """Position of one value in a text.

    `start:stop` are the brackets of its numbers, `after` is the end of the whole value (an OpenCV matrix has more than
    its numbers), `indent` the text before its key on the key's line; `matrix`: whether it is an OpenCV matrix.
    """

    start: int
    stop: int
    after: int
    indent: str
    matrix: bool


def value_span(text: str, key: str, occurrence: int) -> ValueSpan | None:
    """Span of the list or matrix of the n-th `key` in a text; None if the value has another notation."""
    for token in _TOKEN.finditer(text):
        if token[2] and _name(token[1]) == key:
            if occurrence == 0:
                return _span(text, token)
            occurrence -= 1
    return None


def _name(text: str) -> str:
    return json.loads(text) if text[0] == '"' else text.strip("'")


def _span(text: str, token: re.Match) -> ValueSpan | None:
    indent = text[text.rfind("\n", 0, token.start()) + 1 : token.start()]
    lead = _LEAD.match(text, token.end())
    kind = lead[1] if lead else None
    if lead is None or kind is None:
        return _block(text, token.end(), indent)
    if kind == "[":
        stop = _closing(text, lead.end() - 1)
        return ValueSpan(lead.end() - 1, stop, stop, indent, False) if stop else None
    for inner in _TOKEN.finditer(text, lead.end()):
        if inner[2] and _name(inner[1]) == "data":
            start = text.find("[", inner.end())
            stop = _closing(text, start) if start >= 0 else None
            after = _closing(text, lead.end() - 1) if kind == "{" else stop
            return ValueSpan(start, stop, after, indent, True) if stop and after else None
    return None


def _block(text: str, start: int, indent: str) -> ValueSpan | None:
    """Span of a YAML block sequence: the lines below its key that are indented more."""
    rest = re.compile(rf"[ \t]*\r?\n(?:{' ' * len(indent)}[ \t]+[^\n]*(?:\n|$))+").match(text, start)
    if rest is None or not rest[0].lstrip().startswith("-"):
        return None
    stop = start + len(rest[0].rstrip())
    return ValueSpan(start, stop, stop, indent, False)


def _closing(text: str, start: int) -> int | None:
    """Index behind the bracket that closes the one at `start`."""
    depth = 0
    for token in _BRACKET.finditer(text, start):
        depth += (token[0] in "[{") - (token[0] in "]}")
        if depth == 0:
            return token.end()
    return None
