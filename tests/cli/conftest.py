"""A small synthetic take, copied for every test."""

import pytest


@pytest.fixture
def take(copy_take, tmp_path):
    """A take file of its own, which a test may damage."""
    return copy_take(tmp_path / "take")


@pytest.fixture
def change():
    """Replace a text in a file; the text must be there."""

    def replace(path, old, new):
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    return replace
