"""The five papers' pages: a heading a row with its parts, values as the log has them, an index of one line a row."""

import re

import pytest
from benchmarks.ledger import LOG, read
from benchmarks.page import living, worded
from benchmarks.papers.papers_rows import INDEX, ROWS, filled_index, filled_page, pages, read_rows

PARTS = ("In the paper", "Here", "What differs", "Figure")
TEXTS = [page.read_text("utf-8") for page in pages()]


def test_every_row_has_its_heading_and_all_parts():
    rows = read_rows(TEXTS)
    assert len(rows) == ROWS == len({row.item for row in rows}) and len(TEXTS) == 5
    for text in TEXTS:
        for section in re.findall(r"^## P\d-\d+.*?(?=^## |\Z)", text, re.M | re.S):
            assert [part for part in PARTS if section.count(f"**{part}") != 1] == [], section.partition("\n")[0]
    assert not [row.item for row in rows if not row.source or not (row.parts or row.tests)]
    root = INDEX.parents[1]
    assert not [test for row in rows for test in row.tests if not (root / test).exists()]


def test_no_row_shows_a_figure_that_is_retired():
    shown = {name for row in read_rows(TEXTS) for name in row.figures}
    assert shown - living(read(LOG), worded()).keys() == set()


def test_pages_and_index_show_what_the_log_says():
    records = read(LOG)
    hint = "values are printed, not written: python -m benchmarks.page"
    assert [filled_page(text, records) for text in TEXTS] == TEXTS, hint
    index = INDEX.read_text("utf-8")
    assert filled_index(index, read_rows(TEXTS), records) == index, hint


@pytest.mark.parametrize(("was", "by_hand"), [("| met |", "| **missed** |"), ("% |", "0 % |"), ("| <= ", "| <= 9")])
def test_what_is_written_by_hand_is_found(was, by_hand):
    text = next(text for text in TEXTS if was in text)
    assert filled_page(text.replace(was, by_hand, 1), read(LOG)) == text


def test_a_line_that_is_lost_comes_back_in_its_place():
    index, rows = INDEX.read_text("utf-8"), read_rows(TEXTS)
    without = re.sub(r"^\| \[P3-4\].*\n", "", index, flags=re.M)
    assert without != index and filled_index(without, rows, read(LOG)) == index


def test_an_unknown_figure_is_an_error():
    with pytest.raises(KeyError, match="nothing_has_this_name"):
        filled_page("## P9-1 A row\n\n| `nothing_has_this_name` | 1 | <= 2 | met |", read(LOG))


def test_a_row_names_its_way_its_misses_and_its_figures():
    text = (
        "## P9-1 A title\n\n**Here.** `kinefit x --a`. Tests: `a/test_b.py`, `test_c.py`.\n\n"
        "**Figure** (real). Missed.\n\n| `f` |\n"
    )
    (row,) = read_rows([text])
    assert (row.title, row.way, row.source) == ("A title", "`kinefit x --a`", "real")
    assert row.misses and row.figures == ("f",)
    assert row.tests == ("tests/a/test_b.py", "tests/a/test_c.py")
    assert row.commands[0][0] == "pytest"
