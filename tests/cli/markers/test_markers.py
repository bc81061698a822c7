"""`kinefit markers`: learn, identify, audit and fit, from file to file."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from kinefit import Markers, read_markers
from kinefit.bodies.marker_sets import placement
from kinefit.cli import main
from kinefit.exporters import write_markers
from kinefit.simulation import squat_and_wave


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """labelled.c3d, the same in any order and without labels (points.c3d), with two labels swapped (swapped.c3d)."""
    out = tmp_path_factory.mktemp("markers")
    motion = squat_and_wave(rate=30)
    points = placement(motion.body, "CMU_41").points
    labelled = Markers(points.names, 30.0, motion.positions(points), up="z", first_frame=11)
    write_markers(labelled, out / "labelled.c3d")
    order = np.random.default_rng(0).permutation(len(points))
    names = tuple(f"*{i + 1}" for i in range(len(points)))
    write_markers(replace(labelled, names=names, positions=labelled.positions[:, order]), out / "points.c3d")
    x = np.array(labelled.positions)
    a, b = labelled.names.index("LKNE"), labelled.names.index("RKNE")
    x[20:40, [a, b]] = x[20:40, [b, a]]
    write_markers(replace(labelled, positions=x), out / "swapped.c3d")
    return out


def call(*words):
    told = CliRunner().invoke(main, ["markers", *map(str, words)])
    return told.exit_code, told.output


@pytest.fixture(scope="module")
def subject(folder):
    code, text = call("learn", folder / "labelled.c3d", "-o", folder / "anna.json", "--name", "Anna")
    assert code == 0, text
    assert "Anna: 41 markers in" in text
    assert "Written:" in text
    return folder / "anna.json"


def test_points_get_their_labels_back(folder, subject):
    code, text = call("identify", folder / "points.c3d", subject)
    assert code == 0, text
    truth, named = read_markers(folder / "labelled.c3d"), read_markers(folder / "points-named.c3d")
    assert set(named.names) == set(truth.names)
    order = [named.names.index(n) for n in truth.names]
    off = np.linalg.norm(named.positions[:, order] - truth.positions, axis=-1)
    assert np.isfinite(off).mean() > 0.99
    assert np.nanmax(off) < 0.001
    assert named.first_frame == 11
    rows = list(csv.DictReader((folder / "points-named-doubts.csv").read_text().splitlines()))
    assert all(int(r["first_frame"]) >= 11 for r in rows)
    assert ("doubtful frames: none" in text) == (not rows)


def test_labels_by_sapm_as_published(folder, subject, tmp_path):
    take = read_markers(folder / "points.c3d")
    x = np.array(take.positions[:8])
    x[3], x[5, 4:9] = np.nan, np.nan
    write_markers(replace(take, positions=x, residual=None), tmp_path / "short.c3d")
    words = ("identify", tmp_path / "short.c3d", subject, "--method", "sapm", "--no-fill")
    code, text = call(*words, "-o", tmp_path / "sapm.c3d")
    assert code == 0, text
    truth, named = read_markers(folder / "labelled.c3d"), read_markers(tmp_path / "sapm.c3d")
    at = named.positions[:, [named.names.index(n) for n in truth.names]]
    assert np.isnan(at[3]).all()
    right = np.linalg.norm(at - truth.positions[:8], axis=-1) < 0.001
    assert right[[0, 1, 2, 4, 6, 7]].mean() > 0.9
    assert 0.4 < right[5].mean() < right[4].mean()  # beta loses segments that lack a marker
    assert (tmp_path / "sapm-doubts.csv").read_text().startswith("first_frame,last_frame")
    code, _ = call(*words, "-o", tmp_path / "low.c3d", "--beta", 0.5)
    lower = read_markers(tmp_path / "low.c3d")
    lower = lower.positions[5, [lower.names.index(n) for n in truth.names]]
    assert np.isfinite(lower[:, 0]).sum() > np.isfinite(at[5, :, 0]).sum()


def test_settings_of_sapm_belong_to_sapm(folder, subject, tmp_path):
    code, text = call("identify", folder / "points.c3d", subject, "--beta", 0.5)
    assert code == 2 and "--method sapm" in text
    write_markers(Markers(("a", "b"), 30.0, np.ones((3, 2, 3))), tmp_path / "two.c3d")
    code, text = call("identify", tmp_path / "two.c3d", subject, "--method", "sapm")
    assert code == 2 and "matches no segment of Anna" in text


def test_learn_from_one_frame(folder, tmp_path):
    code, text = call("learn", folder / "labelled.c3d", "--frame", 3, "-o", tmp_path / "one.json")
    assert code == 0, text
    assert (tmp_path / "one.json").is_file()
    code, text = call("learn", folder / "labelled.c3d", "--frame", 99999, "-o", tmp_path / "two.json")
    assert code == 2
    assert "--frame 99999 does not exist" in text
    assert not (tmp_path / "two.json").exists()


def test_audit_finds_the_swap(folder):
    code, text = call("audit", folder / "labelled.c3d", folder / "swapped.c3d", "--strict")
    assert code == 2
    assert "labelled.c3d: no wrong labels found" in text
    assert "LKNE" in text.split("swapped.c3d")[1]


@pytest.mark.slow
def test_fit_of_points_without_names(folder, subject, tmp_path):
    words = ("--subject", subject, "-o", tmp_path / "out", "--formats", "mot,osim")
    code, text = call("fit", folder / "points.c3d", *words)
    assert code == 0, text
    assert (tmp_path / "out" / "motion.mot").is_file()
    assert (tmp_path / "out" / "points-named.c3d").is_file()


def test_what_is_wrong_is_told(folder, subject, tmp_path):
    code, text = call("identify", folder / "nothing.c3d", subject)
    assert code == 2
    assert "no such file" in text
    code, text = call("identify", folder / "points.c3d", folder / "labelled.c3d")
    assert code == 2
    assert "kinefit markers learn" in text
    code, text = call("learn", folder / "labelled.c3d", "--no-set", "--frame", 1)
    assert code == 2


@pytest.mark.parametrize("name", ["learn", "identify", "fit", "audit"])
def test_help_has_examples(name):
    code, text = call(name, "--help")
    assert code == 0
    assert f"kinefit markers {name}" in text
