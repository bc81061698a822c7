"""OpenCV FileStorage text, YAML or XML, as nested tables, in time proportional to the length of the text."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import takewhile
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

if TYPE_CHECKING:
    from yaml import Event

_NUMBER = re.compile(r"[-+]?(?:\d+(\.\d*)?|(\.\d+))([eE][-+]?\d+)?")
_WORDS = {
    ".inf": float("inf"), "+.inf": float("inf"), "-.inf": -float("inf"), ".nan": float("nan"), "null": None, "": None
}  # fmt: skip
_AS_OPENCV = re.compile(
    r"#[^\n]*|(?<![^\s\[{,:])(?:(?P<text>\"(?:[^\"\\]|\\.)*+\")|'(?:[^']|'')*+')|"
    r"(?<![^{,\n])(?P<key>[ \t]*+(?:-[ \t]++)*+[A-Za-z_][\w.-]*+:)(?=[^\s:/])"
)
"""What OpenCV writes otherwise than YAML: quotes with a backslash in texts, keys whose colon no blank follows."""
_DEEPEST = 100  # tables within tables; a calibration has five


def parse_xml(text: str) -> ElementTree.Element:
    """Parse an XML text to its root element.

    Raises
    ------
    ValueError
        A document type: its entities may expand to gigabytes.
    ElementTree.ParseError
        No XML.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("a document type (<!DOCTYPE ...>), which no calibration has")
    return ElementTree.fromstring(text)


def storage_of_xml(text: str) -> Any:
    """Values of OpenCV's XML: dicts, lists, numbers, texts, None."""
    return _element(parse_xml(text))


def _element(element: ElementTree.Element) -> Any:
    values = _words(element.text)
    if not len(element):
        return values if len(values) > 1 else values[0] if values else None
    if all(child.tag == "_" for child in element):
        for child in element:
            values += [_element(child), *_words(child.tail)]
        return values
    out: dict[str, Any] = {}
    for child in element:
        if child.tag in out:
            raise ValueError(f"<{child.tag}> twice in <{element.tag}>")
        out[child.tag] = _element(child)
    return out


def _words(text: str | None) -> list[Any]:
    """Numbers and texts, quoted or not, between blanks."""
    words = re.findall(r"\"[^\"]*+\"|\S++", text or "")
    return [word[1:-1] if word[0] == '"' and len(word) > 1 else _scalar(word) for word in words]


def storage_of_yaml(text: str) -> Any:
    """Values of OpenCV's YAML: dicts, lists, numbers, texts, None.

    Tags are skipped, and no word but null and the infinities has a meaning; a repeated key and an anchor that
    is used raise ValueError, as all that is no YAML does.
    """
    import yaml

    # Headers differ: OpenCV 4 writes "%YAML:1.0" and "---", OpenCV 5 "%YAML 1.2", people write none.
    lines = ["" if line.startswith(("%", "---", "...")) else line for line in text.splitlines()]
    try:
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        events = iter(yaml.parse(_AS_OPENCV.sub(_as_yaml, "\n".join(lines)), loader))
        root = next(e for e in events if not isinstance(e, yaml.StreamStartEvent | yaml.DocumentStartEvent))
        value = None if isinstance(root, yaml.StreamEndEvent) else _value(root, events, {})
        list(events)  # what follows has to be YAML, too
        return value
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise ValueError(f"line {mark.line + 1}: {error.problem}" if mark else str(error.problem)) from None
    except yaml.YAMLError as error:
        raise ValueError(str(error).partition("\n")[0]) from None


def _as_yaml(found: re.Match[str]) -> str:
    if found["text"]:
        return re.sub(r"(\\\\)|\\'", lambda quote: quote[1] or "'", found[0])
    return f"{found[0]} " if found["key"] else found[0]


def _value(event: Event, events: Iterator[Event], anchors: dict[str, str], depth: int = 0) -> Any:
    """The value that begins with an event; `anchors`: places by name.

    Not of yaml.compose, which recurses in C: ten thousand tables within tables end the process.
    """
    place, kind, anchor = f"line {event.start_mark.line + 1}", type(event).__name__, getattr(event, "anchor", None)
    if kind == "AliasEvent" and anchor in anchors:
        raise ValueError(f"{anchors[anchor]}: an anchor that is used again, which OpenCV does not write")
    if kind == "AliasEvent":
        raise ValueError(f"{place}: found undefined alias '{anchor}'")
    if anchor is not None:
        anchors[anchor] = place
    if kind == "ScalarEvent":
        return event.value if getattr(event, "style", None) else _scalar(event.value)
    if depth > _DEEPEST:
        raise ValueError(f"{place}: nested too deeply")
    if kind == "SequenceStartEvent":
        return [_value(item, events, anchors, depth + 1) for item in takewhile(_goes_on, events)]
    out: dict[str, Any] = {}
    for key in takewhile(_goes_on, events):
        name, place = getattr(key, "value", None), f"line {key.start_mark.line + 1}"
        if name is None or name in out:
            raise ValueError(f"{place}: the key '{name or ''}' appears twice, or is no text")
        out[name] = _value(next(events), events, anchors, depth + 1)
    return out


def _goes_on(event: Event) -> bool:
    return type(event).__name__ not in ("SequenceEndEvent", "MappingEndEvent")


def _scalar(text: str) -> Any:
    """The number of a plain scalar, else its text."""
    number = _NUMBER.fullmatch(text)
    if number is None:
        return _WORDS[text.lower()] if text.lower() in _WORDS else text
    return float(text) if any(number.groups(default="")) or number[1] is not None else int(text)
