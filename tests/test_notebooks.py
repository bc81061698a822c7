"""Every notebook of the examples runs from top to bottom on a real recording, and prints what it shows."""

import ast
import contextlib
import io
import json
import re
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.ipynb"))
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


def printed(code, names):
    """What a cell prints, its last expression included."""
    tree, told = ast.parse(code), io.StringIO()
    last = tree.body.pop().value if isinstance(tree.body[-1], ast.Expr) else None
    with contextlib.redirect_stdout(told):
        exec(compile(tree, "cell", "exec"), names)
        if last is not None and (value := eval(compile(ast.Expression(last), "cell", "eval"), names)) is not None:
            print(value)
    return told.getvalue()


def test_there_is_a_notebook():
    assert [path.stem for path in NOTEBOOKS] == ["first_recording"]


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_as_it_stands(path, tmp_path, monkeypatch, data_dir):
    monkeypatch.setenv("KINEFIT_DATA", str(data_dir("video_balancing_4cam").parent))
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__notebook__"}
    for cell in json.loads(path.read_text("utf-8"))["cells"]:
        if cell["cell_type"] != "code":
            continue
        got = printed("".join(cell["source"]), names)
        shown = "".join(line for output in cell["outputs"] for line in output["text"])
        assert NUMBER.sub("#", got) == NUMBER.sub("#", shown)
        numbers = [[float(n) for n in NUMBER.findall(text)] for text in (got, shown)]
        assert numbers[0] == pytest.approx(numbers[1], rel=0.1, abs=2), got
