"""Paths of version 0.2 lead to where the modules are, with a warning."""

from importlib import import_module
from importlib.util import find_spec

import pytest

import kinefit
from kinefit._doors import public_names
from kinefit._moved import MOVED_PATHS, moved


@pytest.mark.parametrize("old", MOVED_PATHS)
def test_every_old_path_leads_to_a_module(old):
    assert find_spec(moved(f"kinefit.{old}"))


@pytest.mark.parametrize(
    ("old", "new"),
    [("motion", "bodies.motion"), ("calibration.board.calibrate", "rigs.board.calibrate"),
     ("markers.subject", "fitting.markers.subject"), ("readers.keypoints", "readers.landmarks.keypoints")],
)  # fmt: skip
def test_a_module_is_one_under_both_names(old, new):
    with pytest.warns(DeprecationWarning, match=f"kinefit.{new} now"):
        module = import_module(f"kinefit.{old}")
    assert module is import_module(f"kinefit.{new}") and module.__spec__.name == f"kinefit.{new}"


def test_rooms_of_old_are_attributes():
    assert kinefit.recipes is import_module("kinefit.papers")
    assert kinefit.rendering is import_module("kinefit.bodies.rendering")


def test_what_never_was_is_no_module():
    with pytest.raises(ModuleNotFoundError):
        import_module("kinefit.nothing")
    with pytest.raises(ModuleNotFoundError, match="nothing"), pytest.warns(DeprecationWarning):
        import_module("kinefit.tracking.nothing")
    assert not moved("kinefit.markers")  # the room of that name


def test_names_of_old_lead_to_their_rooms_with_a_warning():
    for room, name in (("exporters", "write_bvh"), ("geometry", "huber")):
        with pytest.warns(FutureWarning, match=rf"kinefit\.{room}\.{name} now"):
            assert getattr(kinefit, name) is getattr(getattr(kinefit, room), name)


def test_every_name_of_a_door_is_there():
    for name, package in public_names().items():
        assert getattr(import_module(package), name) is not None
    with pytest.raises(AttributeError, match="'kinefit.solving' has no attribute 'nothing'"):
        kinefit.solving.nothing  # noqa: B018


def test_a_name_that_is_none_loads_no_room(monkeypatch):
    public_names.cache_clear()
    monkeypatch.setattr("kinefit._doors.import_module", lambda name: pytest.fail(f"{name} is loaded"))
    assert not hasattr(kinefit, "nothing")
