"""Videos of a board: frames of one number are of one time, whatever rates the cameras have."""

import pytest

from kinefit.errors import CalibrationError
from kinefit.rigs.board.sources import opened


def test_frames_of_cameras_of_unequal_rates_count_by_steps_of_time(write_frames, tmp_path):
    size = (64, 48)
    sources = {
        "fast": write_frames(tmp_path / "fast.mp4", range(20), size=size),
        "slow": write_frames(tmp_path / "slow.mp4", range(10), rate=25, size=size),
        "lost": write_frames(tmp_path / "lost.mp4", [k for k in range(20) if k not in (5, 7)], size=size),
    }
    with opened(sources) as cameras:
        assert cameras["fast"].numbers == tuple(range(20))
        assert cameras["slow"].numbers == tuple(range(0, 20, 2))
        assert cameras["lost"].numbers == (*range(5), 6, *range(8, 20))
        assert cameras["slow"].read(8).mean() == pytest.approx(20 + 5 * 4, abs=3)
        assert cameras["lost"].read(8).mean() == pytest.approx(60, abs=3)
        assert cameras["fast"].read(8).mean() == pytest.approx(60, abs=3)
    sources["slow"] = write_frames(tmp_path / "late.mp4", range(20), rate=25, size=size)
    with pytest.raises(CalibrationError, match="slow 39"), opened(sources):
        pass
