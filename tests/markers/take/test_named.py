"""Markers of a take that have no names get those of the subject's model."""

import numpy as np
import pytest
from benchmarks.marker_takes import broken

from kinefit.bodies.marker_sets import placement
from kinefit.errors import FileError, ObservationError
from kinefit.exporters import write_markers
from kinefit.markers.model.learn import learn_model
from kinefit.markers.model.model import save_model
from kinefit.markers.take.takes import named_markers, with_names
from kinefit.observations import Markers
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.simulation import squat_and_wave


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A subject's model, and a take of its markers: columns in another order, without names, some broken in two."""
    folder = tmp_path_factory.mktemp("named")
    motion = squat_and_wave(rate=60)
    points = placement(motion.body, "CMU_41").points
    labelled = Markers(points.names, 60.0, motion.positions(points), up="z")
    save_model(learn_model(labelled, name="Anna"), folder / "anna.json")
    cut = broken(labelled, 1, cut=1.0, ghosts=1.0).markers
    cut = Markers(tuple(f"*{i + 1}" for i in range(len(cut.names))), 60.0, cut.positions[:40])
    write_markers(cut, folder / "points.trc")
    return folder, labelled


def take(folder, keys=""):
    (folder / "take.toml").write_text(f'[[markers]]\nfile = "points.trc"\n{keys}')
    told = read_take(folder / "take.toml")
    return told, load_observations(told)


def test_markers_of_a_take_are_named(folder):
    folder, labelled = folder
    told, seen = take(folder, 'model = "anna.json"\n')
    assert told.markers[0].model == folder / "anna.json" and len(seen.markers[0].names) > 41
    (named,) = with_names(told, seen).markers
    assert set(named.names) == set(labelled.names) and len(named) == 40
    truth = labelled.positions[:40, [labelled.names.index(n) for n in named.names]]
    known = np.isfinite(named.positions).all(axis=2)
    assert known.mean() > 0.9
    assert np.linalg.norm(named.positions - truth, axis=2)[known].max() < 1e-4  # [m] TRC's decimals: none is filled
    np.testing.assert_array_equal(
        named_markers(seen.markers[0], folder / "anna.json").positions, named.positions
    )


def test_what_has_no_model_stays_and_another_subject_is_told(folder):
    folder, _ = folder
    told, seen = take(folder)
    assert with_names(told, seen) is seen
    (folder / "no.json").write_text("{}")
    told, seen = take(folder, 'model = "no.json"\n')
    with pytest.raises(FileError, match="model") as caught:
        with_names(told, seen)
    assert caught.value.place == "markers points.trc"
    with pytest.raises(FileError, match="no such file or folder"):
        take(folder, 'model = "gone.json"\n')
    random = Markers(tuple("abcdef"), 60.0, np.random.default_rng(0).normal(size=(9, 6, 3)))
    with pytest.raises(ObservationError, match="does not fit the model of Anna"):
        named_markers(random, folder / "anna.json")
