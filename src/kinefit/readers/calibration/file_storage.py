"""OpenCV FileStorage text, YAML or XML, as nested tables, in time proportional to the length of the text."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
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
_OPENED: dict[str, Callable[[], Any]] = {"SequenceStartEvent": list, "MappingStartEvent": dict}
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

    Tags are skipped, and no word but null and the infinities has a meaning; a repeated key and an anchor raise
    ValueError, as all that is no YAML does.
    """
    import yaml

    # Headers differ: OpenCV 4 writes "%YAML:1.0" and "---", OpenCV 5 "%YAML 1.2", people write none.
    lines = ["" if line.startswith(("%", "---", "...")) else line for line in text.splitlines()]
    try:
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        return _values(yaml.parse(_AS_OPENCV.sub(_as_yaml, "\n".join(lines)), loader))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise ValueError(f"line {mark.line + 1}: {error.problem}" if mark else str(error.problem)) from None
    except yaml.YAMLError as error:
        raise ValueError(str(error).partition("\n")[0]) from None


def _as_yaml(found: re.Match[str]) -> str:
    if found["text"]:
        return re.sub(r"(\\\\)|\\'", lambda quote: quote[1] or "'", found[0])
    return f"{found[0]} " if found["key"] else found[0]


def _values(events: Iterable[Event]) -> Any:
    """Value of the document. Events, not yaml.compose: that recurses in C, and ten thousand "[" end the process."""
    inside: list[Any] = [[]]  # what is open, the document first
    keys: list[str | None] = [None]  # of each, the key that waits for its value
    for event in events:
        place, value = f"line {event.start_mark.line + 1}", getattr(event, "value", None)
        if getattr(event, "anchor", None) is not None:
            raise ValueError(f"{place}: an anchor, which OpenCV does not write")
        if (opens := _OPENED.get(type(event).__name__)) is not None:
            value = opens()
        elif type(event).__name__ in ("SequenceEndEvent", "MappingEndEvent"):
            inside.pop()
            keys.pop()
        if value is None:
            continue
        if isinstance(inside[-1], dict) and keys[-1] is None:
            if not isinstance(value, str) or value in inside[-1]:
                raise ValueError(f"{place}: the key '{value or ''}' appears twice, or is no text")
            keys[-1] = value
            continue
        read = _scalar(value) if isinstance(value, str) and not getattr(event, "style", None) else value
        if isinstance(inside[-1], dict):
            inside[-1][keys[-1]], keys[-1] = read, None
        else:
            inside[-1].append(read)
        if opens is not None:
            inside.append(value)
            keys.append(None)
            if len(inside) > _DEEPEST:
                raise ValueError(f"{place}: nested too deeply")
    return inside[0][0] if inside[0] else None


def _scalar(text: str) -> Any:
    """The number of a plain scalar, else its text."""
    number = _NUMBER.fullmatch(text)
    if number is None:
        return _WORDS[text.lower()] if text.lower() in _WORDS else text
    return float(text) if any(number.groups(default="")) or number[1] is not None else int(text)
