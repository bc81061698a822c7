"""The printed summary says the same of doubtful moments as the report."""

import re

import numpy as np
import pytest
from tests.exporters.report.test_report import changed, changed_residuals, good_motion, page_of, segment

from kinefit.cli._summary import MOMENTS, print_summary
from kinefit.exporters.report.moments import doubtful_moments, when


def wide(motion):
    return changed(motion, "joint_std", slice(10, 20), segment(motion, "hand_r"), 0.1)


def off(motion):
    for camera in ("cam0", "cam1"):
        motion = changed_residuals(motion, camera, slice(40, 52), slice(None), values=60.0)
    return motion


def often(motion):
    for start in range(0, 80, 10):
        motion = changed(motion, "joint_std", slice(start, start + 3), segment(motion, "hand_r"), 0.1)
    return motion


@pytest.mark.parametrize("doubt", [lambda motion: motion, wide, off, often, lambda motion: off(wide(motion))])
def test_both_count_and_name_the_same_moments(doubt, tmp_path, capsys):
    motion = doubt(good_motion())
    print_summary(motion)
    told, moments = capsys.readouterr().out.replace("\u00a0", " "), doubtful_moments(motion)
    page = page_of(motion, tmp_path).replace("\u00a0", " ")
    assert len(moments) == {wide: 1, off: 1, often: 8}.get(doubt, len(moments))
    if not moments:
        assert "doubtful moments: none\n" in told and "no doubtful moment." in page
        return
    (count,) = re.findall(r"doubtful moments: (\d+ \(\d+ % of the frames\))", told)
    assert f"doubtful moments: {count}." in page and count.startswith(f"{len(moments)} ")
    for moment in moments[:MOMENTS]:
        assert f"  {when(motion, moment)}: {' '.join(moment.what)}".replace("\u00a0", " ") in told
    assert (f"and {len(moments) - MOMENTS} more" in told) == (len(moments) > MOMENTS)


def test_a_motion_without_measurements_is_not_called_sure(capsys):
    motion = good_motion(offsets=())
    assert np.all(motion.quality == 0.9) and not doubtful_moments(motion)
    print_summary(motion)
    assert "doubtful moments: none known, because the motion has no measurements" in capsys.readouterr().out
