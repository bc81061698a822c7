"""Two results side by side."""

import urllib.request
from dataclasses import replace

import numpy as np
import pytest

from kinefit.errors import FileError
from kinefit.exporters import write_motion
from kinefit.simulation import squat_and_wave
from kinefit.studio.app.review import Comparison


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """A motion, and one whose right knee moves half as far, three seconds later."""
    folder = tmp_path_factory.mktemp("both")
    before = replace(squat_and_wave(), dof_std=np.full_like(squat_and_wave().dof_std, np.radians(0.5)))
    angles = before.angles.copy()
    angles[:, before.body.tree.coordinates.index("knee_angle_r")] *= 0.5
    write_motion(before, folder / "a" / "motion.npz")
    write_motion(replace(before, angles=angles, times=before.times + 3.0), folder / "b" / "motion.npz")
    comparison = Comparison(folder / "a", folder / "b")
    yield folder, comparison
    comparison.close()


def test_a_change_is_given_with_its_error_and_marked_where_it_is_larger(both):
    rows = {row.angle: row for row in both[1].ranges}
    knee, other = rows["knee flexion, right"], rows["knee flexion, left"]
    assert knee.is_clear and not other.is_clear and other.change == "0 ± 2"
    before, after = (float(text.split()[0]) for text in (knee.before, knee.after))
    assert after == pytest.approx(before / 2, abs=1.0)
    value, _, twice = knee.change.replace("−", "-").split()
    assert float(value) == pytest.approx(after - before, abs=1.0) and twice == "2" and knee.before.endswith("± 1")


def test_curves_begin_at_zero_and_have_no_more_points_than_asked_for(both):
    comparison = both[1]
    a, b = (np.array(comparison.points("knee_angle_r", k, 30)) for k in (0, 1))
    assert len(a) <= 30 and a[0, 0] == b[0, 0] == 0.0
    np.testing.assert_allclose(b[:, 1], a[:, 1] / 2, atol=0.01)


def test_both_are_in_one_scene_that_the_browser_can_open(both):
    comparison = both[1]
    assert len(comparison.scene.player.recording.motions) == 2
    with urllib.request.urlopen(comparison.scene.address, timeout=10) as answer:
        assert answer.status == 200


def test_a_motion_that_is_written_anew_is_noticed(both):
    folder, comparison = both
    assert comparison.is_current(False)
    (folder / "b" / "motion.npz").unlink()
    assert not comparison.is_current(False)
    with pytest.raises(FileError, match="no such motion"):
        Comparison(folder / "a", folder / "b")
