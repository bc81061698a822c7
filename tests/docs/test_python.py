"""Every Python block of the pages runs, in order, with the names and files that its page takes for granted."""

import pytest
from tests.docs.blocks import PAGES, PARTS, blocks, pages
from tests.docs.python_pages import AFTER, NETWORK, PREPARED, SLOW

ELSEWHERE = {
    "printed-cga": "its examples are run, and their results compared, by tests/geometry/test_cga_docs.py",
    **{part: "tests/test_tutorials.py runs them whole" for part, (page, _) in PARTS.items() if page == "tutorials"},
}
"""{page: where its blocks are run}."""

RUN = [page for page in pages("python") if page not in ELSEWHERE]


def marks(page):
    return [getattr(pytest.mark, name) for name, held in (("slow", SLOW), ("network", NETWORK)) if page in held]


def test_every_page_with_python_is_run():
    assert set(RUN) == set(PREPARED)
    assert set(ELSEWHERE) <= set(PAGES) and set(AFTER) | SLOW | NETWORK <= set(PREPARED)


@pytest.mark.parametrize("page", [pytest.param(p, marks=marks(p)) for p in RUN])
def test_blocks_run_as_they_stand(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__docs__"}
    prepared = PREPARED[page](tmp_path)
    given = next(prepared)
    for block in blocks(page, "python"):
        names |= given
        text = "\n" * (block.line - 1) + block.text  # a traceback then tells the page's line
        exec(compile(text, str(PAGES[page]), "exec"), names)
        try:
            given = prepared.send(names)
        except StopIteration:
            given = {}
    for call in AFTER.get(page, ()):
        exec(call, names)
