"""Forces of a child's steps on real plates, and on the page."""

import numpy as np
import pytest

from kinefit import read_markers
from kinefit.exporters.gait.files import PERCENT, force_plots, step_forces, write_gait_page
from kinefit.exporters.gait.plates import standing_mass
from kinefit.exporters.gait.record import gait_record


@pytest.fixture(scope="module")
def weighed(walk, data_dir):
    static = read_markers(data_dir("gait_biomechzoo") / "HC030A" / "static.c3d").plates
    return walk.with_mass(standing_mass([static], walk.body))


def test_a_step_bears_the_weight_brakes_and_pushes(weighed):
    right, left = step_forces(weighed)
    assert (right.side, left.side) == ("right", "left")
    for step in (right, left):
        assert step.vertical.shape == step.forward.shape == PERCENT.shape
        assert 1.0 < step.vertical.max() < 1.4 and step.vertical[[0, -1]].max() < 0.1
        early, late = step.forward[10:30].mean(), step.forward[75:95].mean()
        assert early < -0.08 and late > 0.08


def test_forces_are_on_the_page(weighed, tmp_path):
    assert len(force_plots([weighed])) == 4 and not force_plots([weighed.part(slice(0, 3))])
    page = write_gait_page(gait_record({"walk": weighed}), tmp_path / "gait.html").read_text("utf-8")
    assert "Ground forces" in page and "45.8 kg" in page
    assert np.isfinite(weighed.centre_of_mass).all()
