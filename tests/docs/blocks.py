"""The blocks of code that the documentation shows, page by page, with the line on which each begins.

A page with parts that take different things for granted is read part by part: `PARTS` names them.
"""

import re
from dataclasses import dataclass

from tests.conftest import ROOT

PARTS = {
    "animator": ("tutorials", "Animator: from videos to a moving character"),
    "anny": ("bodies", "A realistic body"),
    "blender": ("files", "In Blender"),
    "comparison": ("limitations", "Comparison with other tools"),
    "depth-start": ("depth", "A start from one depth image"),
    "face": ("detect", "Head, jaw and eyes"),
    "gait-laboratory": ("tutorials", "Gait laboratory: cycles, steps and knee angles with error bars"),
    "hands": ("detect", "Hands with fingers"),
    "marker-fitting": ("markers", "Fitting labelled markers"),
    "morphing": ("bodies", "Morphing: bodies that change with their pose"),
    "one-camera": ("telephones", "One camera"),
    "photogrammetry": ("tutorials", "Photogrammetry: displacement and strain of a surface"),
    "printed-cga": ("papers/p1", "The paper's equations, run"),
    "printed-metaballs": ("papers/p4", "Metaball bodies"),
    "printed-regions": ("papers/p3", "Regions as printed"),
    "printed-sapm": ("papers/p5", "Segment-based articulated point matching"),
    "printed-voodoo": ("papers/p2", "VooDoo, and its experiment"),
    "robot": ("tutorials", "Robot: a person in front of a depth camera"),
    "rows": ("own-sensor", "Rows"),
    "solvers": ("smoothing", "Solvers"),
    "sport": ("tutorials", "Sport: bodies with gear"),
    "stereo": ("depth", "Stereo pairs, skin, free space, and bodies that change"),
    "several-telephones": ("telephones", "A few telephones"),
    "view": ("report", "The 3D viewer"),
    "which-setup": ("first-recording", "Which set-up do I need?"),
}
"""{part: (its page, the heading that it begins with)}: it ends with the page or where the next part begins."""

_FILES = {
    page.relative_to(ROOT).with_suffix("").as_posix().removeprefix("docs/"): page
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
    if not {"generated", "_build"} & set(page.parts)
}
PAGES = {name: _FILES[PARTS[name][0] if name in PARTS else name] for name in (*_FILES, *PARTS)}
"""{name: path}: README, the pages of docs by their place in it, and their parts."""

_SHOWN = re.compile(r"^```(\w+)\n(.*?)^```$", re.S | re.M)


@dataclass(frozen=True)
class Block:
    """One block: its page or part, its first line's number in the file, its text."""

    page: str
    line: int
    text: str

    @property
    def first(self):
        """Its first line, by which lists name it."""
        return self.text.partition("\n")[0].split("  #")[0].strip()


def _begins(text, heading):
    found = re.search(rf"^## {re.escape(heading)}$", text, re.M)
    assert found, f"no heading '{heading}'"
    return found.start()


def _span(page):
    """From where to where a page goes without its parts, or a part."""
    path, text = PAGES[page], PAGES[page].read_text("utf-8")
    starts = {name: _begins(text, heading) for name, (of, heading) in PARTS.items() if _FILES[of] == path}
    begin = starts.get(page, 0)
    return begin, min((start for start in starts.values() if start > begin), default=len(text))


def part_text(page):
    """The text of a page without its parts, or of a part."""
    begin, end = _span(page)
    return PAGES[page].read_text("utf-8")[begin:end]


def blocks(page, kind):
    text, (begin, end) = PAGES[page].read_text("utf-8"), _span(page)
    shown = [m for m in _SHOWN.finditer(text) if m[1] == kind and begin <= m.start() < end]
    return [Block(page, text.count("\n", 0, m.start(2)) + 1, m[2]) for m in shown]


def pages(kind):
    return [page for page in PAGES if blocks(page, kind)]
