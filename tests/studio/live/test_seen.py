"""What cameras saw, on the steps of one rate, as a take that `track` takes."""

import numpy as np
import pytest

from kinefit.errors import ExportError
from kinefit.observations import MEDIAPIPE_33, KeypointFrame
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.simulation import simulate_keypoints
from kinefit.studio.live.record import SeenRecord, on_grid


def test_between_near_images_straight_and_else_unseen():
    times = np.array([0.0, 0.1, 0.2, 0.5, 0.61])
    rows = np.stack([times, 10.0 * times], axis=1)
    grid = np.arange(8) / 10.0
    out = on_grid(rows, grid, 10.0)
    assert np.array_equal(out[:, 0], grid)
    assert np.allclose(out[[0, 1, 2, 5, 6], 1], [0.0, 1.0, 2.0, 5.0, 6.0])
    assert np.isnan(out[[3, 4, 7], 1]).all()


def test_one_image_alone_is_seen_at_its_step():
    out = on_grid(np.array([[0.2, 7.0]]), np.arange(4) / 10.0, 10.0)
    assert np.isnan(out[[0, 1, 3], 1]).all() and out[2, 1] == 7.0


def simulated(scene):
    return simulate_keypoints(scene.motion, scene.rig, "MEDIAPIPE_33", missing=0.0, outliers=0.0)


@pytest.fixture
def recorded(scene, tmp_path):
    """A record of the simulated take, whose second camera is half a frame late."""
    text = '[take]\nup = "z"\nheight = 1.7\nmass = 61.5\n[calibration]\nfile = "c.toml"\n'
    from kinefit.readers.calibration.read import write_calibration

    (tmp_path / "own").mkdir()
    write_calibration(scene.rig, tmp_path / "own" / "c.toml")
    text += "".join(f'[[camera]]\nname = "{c.name}"\nstream = "0"\n' for c in scene.rig)
    (tmp_path / "own" / "studio.toml").write_text(text)
    take = read_take(tmp_path / "own" / "studio.toml")
    record = SeenRecord(tmp_path / "out", take, scene.rig, rate=scene.motion.rate, alone=False)
    for k in simulated(scene):
        late = 0.5 / k.rate if k.camera == scene.rig.names[1] else 0.0
        for f in range(len(k)):
            uv = np.nan_to_num(k.points[f, 0])  # a detector gives all landmarks
            record.keep([KeypointFrame(k.camera, f / k.rate + late, MEDIAPIPE_33, uv, k.confidence[f, 0])])
    record.close()
    return record


def test_the_take_has_what_was_seen(recorded, scene):
    seen = load_observations(read_take(recorded.path))
    assert set(seen.rig.names) == set(scene.rig.names) and seen.rate == scene.motion.rate
    assert (read_take(recorded.path).height, read_take(recorded.path).mass) == (1.7, 61.5)
    truth = {k.camera: k for k in simulated(scene)}
    for k in seen.keypoints:
        points, sure = truth[k.camera].points, (truth[k.camera].confidence > 0).all(axis=0)  # at all times
        if k.camera == scene.rig.names[1]:
            points = np.concatenate([np.full((1, *points.shape[1:]), np.nan), 0.5 * (points[1:] + points[:-1])])
        both = np.isfinite(points).all(axis=-1) & np.isfinite(k.points[: len(points)]).all(axis=-1) & sure
        assert both.sum() > 0.8 * len(points) * sure.sum() > 0
        assert np.allclose(k.points[: len(points)][both], points[both], atol=0.01)
    assert sorted(p.suffix for p in recorded.folder.iterdir()) == [".npz"] * 4 + [".toml"] * 2


def test_what_came_before_a_restart_is_in_no_take(scene, tmp_path, recorded):
    record = SeenRecord(tmp_path / "again", recorded.take, scene.rig, rate=scene.motion.rate, alone=False)
    first, second = scene.rig.names[:2]
    for f in range(20):
        uv = np.full((len(MEDIAPIPE_33), 2), 10.0 * f)
        for camera in (first, second) if f < 10 else (first,):
            record.keep([KeypointFrame(camera, f / 30.0, MEDIAPIPE_33, uv, np.ones(len(uv)))])
        if f == 9:
            record.restart()
    record.close()
    (k,) = load_observations(read_take(record.path)).keypoints
    assert k.camera == first and len(k) == 10 and k.points[0, 0, 0, 0] == 100.0
    assert not (record.folder / f"{second}.npz").exists()


def test_a_take_of_ones_own_is_not_written_over(scene, tmp_path, recorded):
    own = recorded.take.path
    own.rename(own.with_name("take.toml"))
    with pytest.raises(ExportError, match="would overwrite this take"):
        SeenRecord(own.parent, recorded.take, scene.rig, rate=30.0, alone=False)
