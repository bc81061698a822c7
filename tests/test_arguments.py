"""Wrong types in the public functions and records are told by name, with what is wanted, before any work."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike

import kinefit
from kinefit._arguments import checked
from kinefit._doors import public_names
from kinefit.bodies import load_body
from kinefit.bodies.motion import UP_AXES
from kinefit.errors import KinefitError, ObservationError
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.geometry.camera import Rig
from kinefit.observations import KEYPOINT_SIGMA
from kinefit.readers.take.entries import KeypointsEntry
from kinefit.sensors.settings import TrackSettings

WRONG = {
    "None": None, "text": "text", "bytes": b"bytes", "whole": 3, "number": 2.5, "nan": float("nan"), "list": [],
    "map": {}, "thing": object(), "texts": ["a"], "nones": [None], "array": np.zeros(3), "array of text": np.array("x"),
    "set": {1}, "function": len, "class": int, "generator": ...,
}  # fmt: skip


MADE_BY_READERS = {
    "ClickVideo", "CloudVideo", "ColourVideo", "DepthSensor", "DepthVideo", "KeypointVideo", "KinematicTree",
    "LineVideo", "MeshSurface", "Morphing", "SilhouetteVideo", "TaperedCylinder", "by_record",
}  # fmt: skip
"""Records of files, which their readers check, and what sorts them."""


def public():
    for name, package in public_names().items():
        thing = getattr(import_module(package), name)
        if callable(thing) and not (inspect.isclass(thing) and issubclass(thing, BaseException)):
            if name not in MADE_BY_READERS and not inspect.isabstract(thing):
                yield thing


@pytest.mark.parametrize("function", list(public()), ids=lambda thing: thing.__name__)
def test_every_wrong_type_is_a_typed_error_or_right(function, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    needed = [p for p in inspect.signature(function).parameters.values() if p.default is p.empty]
    places = [p for p in needed if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    if not places:
        return
    for value in WRONG.values():
        make = lambda value=value: (x for x in [1]) if value is ... else value
        try:
            function(*(make() for _ in places), **{p.name: make() for p in needed if p.kind == p.KEYWORD_ONLY})
        except KinefitError as error:
            assert len(str(error)) <= 600, str(error)
        except TypeError as error:
            assert "required" in str(error) and "missing" in str(error)  # of a format that has more of them


@checked
def some(
    path: str | Path, values: ArrayLike, names: Sequence[str] = (), count: int = 1, *,
    table: Mapping[str, float] | None = None, tell: Callable | None = None,
):  # fmt: skip
    return path


RIGHT = [
    (("a", [1, 2]), {}), ((Path("a"), np.zeros(2)), {"names": ["a"]}), (("a", 1.0, ("a", "b"), np.int64(2)), {}),
    (("a", [[1, 2], [3, 4]]), {"table": {"a": 1}, "tell": len}),
]  # fmt: skip


@pytest.mark.parametrize(("args", "more"), RIGHT)
def test_what_is_right_goes_through(args, more):
    assert some(*args, **more) is args[0]


@pytest.mark.parametrize(("args", "more", "said"), [
    ((None, [1]), {}, "some: path is a NoneType. Give str or Path"), ((3, [1]), {}, "path is a int"),
    (("a", "b"), {}, "values is a str. Give an array of numbers"), (("a", [[1], [2, 3]]), {}, "values is a list"),
    (("a", 1, "abc"), {}, "names is a str. Give Sequence of str"),
    (("a", 1, [1]), {}, "names is a list of the wrong"),
    (("a", 1, (), 1.5), {}, "count is a float. Give int"),
    (("a", 1), {"table": {"a": "b"}}, "table is a dict of the wrong"),
    (("a", 1), {"tell": 3}, "tell is a int"),
])  # fmt: skip
def test_what_is_wrong_is_told(args, more, said):
    with pytest.raises(ObservationError) as told:
        some(*args, **more)
    assert said in str(told.value)


def test_an_annotation_for_type_checkers_alone_leaves_the_others_checked():
    def partly(path: str, thing: "Somewhere"):  # noqa: F821
        return path

    assert checked(partly)("a", 3) == "a"
    with pytest.raises(ObservationError, match="partly: path is a int. Give str"):
        checked(partly)(3, 3)


def test_what_is_missing_is_python_s_own_error():
    with pytest.raises(TypeError):
        some("a")


def test_an_old_name_is_read_for_one_version_and_named():
    body, rig = load_body("humanoid"), Rig(())
    with pytest.warns(FutureWarning, match="accuracy is called sigma now"):
        assert Tracker(body, rig, accuracy={"mocap": 0.002}).sigma == {"mocap": 0.002}
    with pytest.raises(ObservationError, match="accuracy and sigma are the same"):
        Tracker(body, rig, accuracy={}, sigma={})


def test_one_vertical_axis_and_one_deviation_of_keypoints_is_meant_everywhere():
    body, rig = load_body("humanoid"), Rig(())
    assert np.array_equal(Tracker(body, rig).up, UP_AXES[inspect.signature(Recording).parameters["up"].default])
    assert np.array_equal(Tracker(body, rig, up="-y").up, (0.0, -1.0, 0.0))
    with pytest.raises(ObservationError, match="vertical axis"):
        Tracker(body, rig, up="upwards")
    default = lambda function: inspect.signature(function).parameters["sigma"].default
    stated = [default(f) for f in (Recording.of_keypoints, kinefit.refine, kinefit.calibrate_people)]
    assert {TrackSettings().pixel, KeypointsEntry(file="x", camera="cam01").sigma, *stated} == {KEYPOINT_SIGMA}
