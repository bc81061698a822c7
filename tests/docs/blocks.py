"""The blocks of code that the documentation shows, page by page, with the line on which each begins."""

import re
from dataclasses import dataclass

from tests.conftest import ROOT

PAGES = {
    page.relative_to(ROOT).with_suffix("").as_posix().removeprefix("docs/"): page
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
    if not {"generated", "_build"} & set(page.parts)
}
"""{name: path}: README, and the pages of docs by their place in it."""

_SHOWN = re.compile(r"^```(\w+)\n(.*?)^```$", re.S | re.M)


@dataclass(frozen=True)
class Block:
    """One block: its page, its first line's number, its text."""

    page: str
    line: int
    text: str

    @property
    def first(self):
        """Its first line, by which lists name it."""
        return self.text.partition("\n")[0].split("  #")[0].strip()


def blocks(page, kind):
    text = PAGES[page].read_text("utf-8")
    return [Block(page, text.count("\n", 0, m.start(2)) + 1, m[2]) for m in _SHOWN.finditer(text) if m[1] == kind]


def pages(kind):
    return [page for page in PAGES if blocks(page, kind)]
