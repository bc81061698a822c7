"""OpenCV FileStorage text, YAML or XML, as nested tables, in time proportional to the length of the text."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, NoReturn
from xml.etree import ElementTree

_MAX_DEPTH = 40  # tables within tables; calibrations have five
_NUMBER = re.compile(r"[-+]?(?:\d+(\.\d*)?|(\.\d+))([eE][-+]?\d+)?")
_WORDS = {".inf": float("inf"), "+.inf": float("inf"), "-.inf": -float("inf"), ".nan": float("nan"), "null": None}
_QUOTED = r"\"(?:[^\"\\]|\\.)*+\"|'(?:[^']|'')*+'"
_ESCAPE = re.compile(r"\\(x[0-9a-fA-F]{2}|.)", re.DOTALL)
_ESCAPES = {"n": "\n", "t": "\t", "r": "\r", "0": "\0"}


class _BoundedTree(ElementTree.TreeBuilder):
    """Builder of XML elements with a limited depth."""

    depth = 0

    def start(self, tag: Any, attributes: Any) -> Any:
        self.depth += 1
        _check_depth(self.depth)
        return super().start(tag, attributes)

    def end(self, tag: Any) -> Any:
        self.depth -= 1
        return super().end(tag)


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
    return ElementTree.fromstring(text, ElementTree.XMLParser(target=_BoundedTree()))


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

    Block and flow collections, quoted and plain scalars and comments are read; tags are skipped. Anchors and text over
    several lines raise ValueError.
    """
    # Headers differ: OpenCV 4 writes "%YAML:1.0" and "---", OpenCV 5 "%YAML 1.2", people write none.
    lines = ["" if line.startswith(("%", "---", "...")) else line for line in text.splitlines()]
    return _Yaml("\n".join(lines)).document()


class _Yaml:
    """Recursive-descent parser of a YAML text."""

    _GAP = re.compile(r"(?:[ \t\n]++|#[^\n]*+)*+")
    _TAG = re.compile(r"!\S*+")
    _ENTRY = re.compile(r"-(?=[ \n]|\Z)")
    _KEY = re.compile(rf"({_QUOTED}|[^\s\"'#\[\]{{}},][^:\n]*+)[ \t]*+:(?:[ \t]*+!\S*+)?[ \t]*+")
    _FLOW_KEY = re.compile(rf"({_QUOTED}|[^\s\"'#\[\]{{}},:][^:\n,\[\]{{}}]*+)[ \t]*+:(?:[ \t]*+!\S*+)?[ \t]*+")
    _QUOTED_TEXT = re.compile(_QUOTED)
    _PLAIN = re.compile(r"[^\n]*+")
    _FLOW_PLAIN = re.compile(r"[^\n,\[\]{}#]++")
    _PLAIN_LIST = re.compile(r"\[([^\[\]{}\"'#]*+)\]")

    def __init__(self, text: str) -> None:
        self._text, self._at, self._depth = text, 0, 0

    def document(self) -> Any:
        value = self._block(-1)
        if self._at < len(self._text):
            self._fail("unexpected indentation or text")
        return value

    def _block(self, parent: int) -> Any:
        """A value on lines that are indented by more than `parent` columns; None where there is none."""
        self._skip()
        if (tag := self._TAG.match(self._text, self._at)) is not None:
            self._at = tag.end()
            self._skip()
        column = self._column()
        if column <= parent:
            return None
        if self._ENTRY.match(self._text, self._at):
            return self._nested(self._sequence, column)
        if self._KEY.match(self._text, self._at):
            return self._nested(self._mapping, column)
        return self._inline()

    def _sequence(self, column: int) -> list[Any]:
        out = []
        while self._column() == column and (entry := self._ENTRY.match(self._text, self._at)):
            self._at = entry.end()
            out.append(self._block(column))
            self._skip()
        return out

    def _mapping(self, column: int) -> dict[str, Any]:
        out: dict[str, Any] = {}
        while self._column() == column and not self._ENTRY.match(self._text, self._at):
            name = self._key(self._KEY, out)
            if self._text.startswith(("\n", "#"), self._at) or self._at == len(self._text):
                self._skip()  # the value follows on lines of its own; a sequence may stand below its key
                below = self._ENTRY.match(self._text, self._at) is not None and self._column() == column
                out[name] = self._block(column - below)
            else:
                out[name] = self._inline()
            self._skip()
        return out

    def _inline(self) -> Any:
        """A value that begins on this line: a flow collection or a scalar."""
        if self._text.startswith(("[", "{"), self._at):
            return self._nested(self._flow)
        if (quoted := self._QUOTED_TEXT.match(self._text, self._at)) is not None:
            return self._take(quoted)
        return _scalar(re.split(r"[ \t]#", self._take_text(self._PLAIN), maxsplit=1)[0].strip())

    def _flow(self) -> Any:
        if (plain := self._PLAIN_LIST.match(self._text, self._at)) is not None:
            self._at = plain.end()
            items = plain[1].split(",")
            return [_scalar(item.strip()) for item in (items if items[-1].strip() else items[:-1])]
        keyed = self._text[self._at] == "{"
        close, table, items = "}" if keyed else "]", dict[str, Any](), list[Any]()
        self._at += 1
        self._skip()
        while not self._text.startswith(close, self._at):
            name = self._key(self._FLOW_KEY, table) if keyed else ""
            value = self._flow_value()
            table[name] = value
            items.append(value)
            self._skip()
            if self._text.startswith(",", self._at):
                self._at += 1
                self._skip()
            elif not self._text.startswith(close, self._at):
                self._fail(f"a comma or '{close}' is missing")
        self._at += 1
        return table if keyed else items

    def _flow_value(self) -> Any:
        self._skip()
        if self._text.startswith(("[", "{"), self._at):
            return self._nested(self._flow)
        if (quoted := self._QUOTED_TEXT.match(self._text, self._at)) is not None:
            return self._take(quoted)
        return _scalar(self._take_text(self._FLOW_PLAIN).strip())

    def _key(self, pattern: re.Pattern[str], table: dict[str, Any]) -> str:
        if (found := pattern.match(self._text, self._at)) is None:
            self._fail("a key with a colon is missing")
        name = _unquoted(found[1].strip())
        if name in table:
            self._fail(f"the key '{name}' appears twice")
        self._at = found.end()
        return name

    def _nested(self, read: Callable[..., Any], *where: int) -> Any:
        self._depth += 1
        _check_depth(self._depth)
        value = read(*where)
        self._depth -= 1
        return value

    def _take(self, quoted: re.Match[str]) -> str:
        self._at = quoted.end()
        return _unquoted(quoted[0])

    def _take_text(self, pattern: re.Pattern[str]) -> str:
        found = pattern.match(self._text, self._at)
        if found is None or found[0].startswith(("&", "*", "|", ">", "`", "@", '"', "'", "- ")):
            self._fail("a value that OpenCV does not write")
        self._at = found.end()
        return found[0]

    def _skip(self) -> None:
        self._at = self._GAP.match(self._text, self._at).end()  # type: ignore[union-attr]

    def _column(self) -> int:
        """Of the next character; -1 at the end."""
        return self._at - self._text.rfind("\n", 0, self._at) - 1 if self._at < len(self._text) else -1

    def _fail(self, problem: str) -> NoReturn:
        raise ValueError(f"line {self._text.count(chr(10), 0, self._at) + 1}: {problem}")


def _scalar(text: str) -> Any:
    """The number of a plain scalar, else its text."""
    number = _NUMBER.fullmatch(text)
    if number is None:
        return _WORDS[text.lower()] if text.lower() in _WORDS else text
    return float(text) if any(number.groups(default="")) or number[1] is not None else int(text)


def _unquoted(text: str) -> str:
    if text[:1] == '"':
        return _ESCAPE.sub(lambda m: chr(int(m[1][1:], 16)) if len(m[1]) > 1 else _ESCAPES.get(m[1], m[1]), text[1:-1])
    return text[1:-1].replace("''", "'") if text[:1] == "'" else text


def _check_depth(depth: int) -> None:
    if depth > _MAX_DEPTH:
        raise ValueError("tables are nested too deeply for a calibration")
