"""RRD: read back by Rerun's own server, where it is installed."""

import sys

import numpy as np
import pytest
from tests.exporters.synthetic import smooth_motion

from kinefit.errors import ExportError
from kinefit.exporters import write_rrd


@pytest.fixture(scope="module")
def motion():
    return smooth_motion(12, up="y")


def test_its_server_finds_joints_angles_and_times(motion, tmp_path):
    pytest.importorskip("datafusion")
    server = pytest.importorskip("rerun.server")
    write_rrd(motion, tmp_path / "a.rrd", up="z")
    local = {"host": "127.0.0.1", "addr": "127.0.0.1"}
    with server.Server(**local, datasets={"a": [str(tmp_path / "a.rrd")]}) as made:
        client = made.client()  # which must live as long as what it gives
        view = client.get_dataset("a").filter_contents(["/**"])
        frames = view.reader(index="time")
        table = frames.to_arrow_table()

    def column(ending):
        (name,) = (n for n in table.schema.names if n.endswith(ending))
        return table.column(name).to_pylist()

    found = np.array(column("joints:Points3D:positions"))
    assert np.abs(found - motion.turned("z").joint_centres).max() < 1e-5
    times = [value.total_seconds() if hasattr(value, "total_seconds") else float(value) for value in column("time")]
    assert np.allclose(times, motion.times, atol=1e-6)
    assert np.allclose(np.ravel(column("angles/knee_angle_l:Scalars:scalars")),
                       np.degrees(motion.angles[:, motion.body.tree.coordinate("knee_angle_l")]))  # fmt: skip
    assert np.allclose(np.ravel(column("quality:Scalars:scalars")), motion.quality)
    bones = np.array(column("bones:LineStrips3D:strips"))
    assert bones.shape == (12, len(motion.body.tree.segments) - 1, 2, 3)


def test_what_cannot_be_written_is_told(motion, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ExportError, match=r"kinefit\[rerun\]"):
        write_rrd(motion, tmp_path / "a.rrd")
    assert not list(tmp_path.iterdir())
