"""Left and right at every door: fit, audit, track and check."""

import numpy as np
import pytest
from click.testing import CliRunner

from kinefit import Markers
from kinefit.bodies import load_body
from kinefit.bodies.marker_sets import find_placement, placement, read_sides
from kinefit.cli import main
from kinefit.errors import ObservationError
from kinefit.exporters import write_markers
from kinefit.simulation import squat_and_wave

BODY = load_body("humanoid")


@pytest.fixture(scope="module")
def take(tmp_path_factory):
    """A take file of a mirrored recording, m.trc."""
    truth = squat_and_wave(rate=10)
    points = placement(truth.body, "CMU_41").points
    x = read_sides(points.names, truth.positions(points), "mirrored-y")[1]
    folder = tmp_path_factory.mktemp("mirrored")
    write_markers(Markers(points.names, 10.0, x, up="z"), folder / "m.trc")
    (folder / "take.toml").write_text('[take]\nup = "z"\n\n[[markers]]\nfile = "m.trc"\n', "utf-8")
    return folder / "take.toml"


def _run(*words):
    done = CliRunner().invoke(main, [str(w) for w in words])
    return done.exit_code, " ".join((done.output + str(done.exception or "")).split())


def test_no_door_lets_a_mirrored_recording_pass(take, tmp_path):
    file = take.with_name("m.trc")
    for words in (("markers", "fit", file, "-o", tmp_path / "fit"), ("track", take, "-o", tmp_path / "track"),
                  ("markers", "audit", file, "--strict"), ("check", take, "--strict", "-o", tmp_path / "check.html")):
        code, text = _run(*words)
        assert code, words
        assert "The world is mirrored (left-handed): the body fits" in text, words
    assert not (tmp_path / "fit" / "motion.npz").exists()


def test_the_option_of_the_remedy_mends_it(take, tmp_path):
    words = ("markers", "fit", take.with_name("m.trc"), "-o", tmp_path, "--formats", "mot", "--sides", "mirrored-y")
    code, text = _run(*words)
    assert code == 0, text
    rows = (tmp_path / "motion.mot").read_text("utf-8").splitlines()
    names = next(row for row in rows if row.startswith("time")).split()
    values = np.array([row.split() for row in rows[rows.index("endheader") + 2 :] if row], float)
    assert np.ptp(values[:, names.index("knee_angle_r")]) > 30.0


def test_a_set_that_explains_few_labels_is_not_taken():
    labels = [*(f"Q{k}" for k in range(22)), "RKNE", "LKNE", "RANK", "LANK", "RHEE", "LHEE"]
    with pytest.raises(ObservationError, match="no marker set explains most of the labels: .* 6 of 28") as error:
        find_placement(BODY, labels)
    assert "kinefit markers set" in error.value.remedy
    assert len(find_placement(BODY, labels, "PIG").points) == 6
