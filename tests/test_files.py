"""TOML of any content: an answer within bounds, with the place and what would work."""

import time

import pytest

from kinefit._files import parse_toml
from kinefit.errors import BodyError, FileError


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('[a]\nfile = "C:\\Users\\me\\x.toml"', r"line 2.*single quotes. Write 'C:\\Users\\me\\x.toml'"),
        ('file = "C:\\data\\x.toml"', "forward slashes"),
        ("size = True", "Write true"),
        ("rate = 29,97", "a point, not a comma"),
        ("a = " + "[" * 5000 + "]" * 5000, "nested too deep"),
        ("a = " + "9" * 5000, "number too long"),
        ("\n" + "a." * 20_000 + "a = 1", "line 2.*more than 50 parts"),
        ("'a'. \"b\" ." * 100 + "a = 1", "more than 50 parts"),
        ("#" * 5_000_000, "5 MB"),
    ],
)
def test_what_is_no_toml_is_told_at_once(text, told):
    began = time.monotonic()
    with pytest.raises(FileError, match=f"(?s)x.toml.*{told}") as error:
        parse_toml(text, "x.toml")
    assert time.monotonic() - began < 2.0 and len(str(error.value)) < 600


def test_the_error_is_of_the_kind_asked_for():
    with pytest.raises(BodyError):
        parse_toml("a = = 1", "x.toml", BodyError)


def test_dots_in_texts_and_numbers_are_no_keys():
    text = "a = '" + "x." * 40 + "'\nb = [" + "1.5, " * 500 + "]\nc.d.e = 1"
    assert parse_toml(text, "x.toml")["c"] == {"d": {"e": 1}}
