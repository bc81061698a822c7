"""Forces of a child's steps on real plates, and on the page."""

import numpy as np
import pytest

from kinefit import fit_marker_subject, fit_markers, load_body, read_markers
from kinefit.exporters.gait.forces import PERCENT, force_plots, step_forces
from kinefit.exporters.gait.page import write_gait_page
from kinefit.exporters.gait.plates import standing_mass
from kinefit.exporters.gait.record import gait_record


@pytest.fixture(scope="module")
def walk(data_dir):
    folder = data_dir("gait_biomechzoo") / "HC030A"
    markers = read_markers(folder / "straight.c3d")
    motion = fit_markers(fit_marker_subject(load_body("humanoid"), markers, frames=12), markers, smooth=False)
    return motion.with_mass(standing_mass([read_markers(folder / "static.c3d").plates], motion.body))


def test_a_step_bears_the_weight_brakes_and_pushes(walk):
    right, left = step_forces(walk)
    assert (right.side, left.side) == ("right", "left")
    for step in (right, left):
        assert step.vertical.shape == step.forward.shape == PERCENT.shape
        assert 1.0 < step.vertical.max() < 1.4 and step.vertical[[0, -1]].max() < 0.1
        early, late = step.forward[10:30].mean(), step.forward[75:95].mean()
        assert early < -0.08 and late > 0.08


def test_forces_are_on_the_page(walk, tmp_path):
    assert len(force_plots([walk])) == 4 and not force_plots([walk.part(slice(0, 3))])
    page = write_gait_page(gait_record({"walk": walk}), tmp_path / "gait.html").read_text("utf-8")
    assert "Ground forces" in page and "45.8 kg" in page
    assert np.isfinite(walk.centre_of_mass).all()
