"""A small synthetic take, drawn once and copied for every test."""

import shutil

import pytest

from kinefit.simulation import write_synthetic_take


@pytest.fixture(scope="session")
def drawn_take(tmp_path_factory):
    return write_synthetic_take(tmp_path_factory.mktemp("drawn"))


@pytest.fixture
def take(drawn_take, tmp_path):
    """A take file of its own, which a test may damage."""
    shutil.copytree(drawn_take.parent, tmp_path / "take")
    return tmp_path / "take" / "take.toml"


@pytest.fixture
def change():
    """Replace a text in a file; the text must be there."""

    def replace(path, old, new):
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    return replace
