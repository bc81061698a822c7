"""`[[region]]` of take files: every key acts, and what cannot be is refused."""

import cv2
import numpy as np
import pytest
from tests.sensors.region_scenes import CAMERA, RIG, image, off, state, thing

from kinefit.bodies import BodyState
from kinefit.errors import TakeError
from kinefit.fitting.tracking.take_recording import recording_of
from kinefit.readers.calibration.read import write_calibration
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.takes.track import track_take


def written(folder, *, region='[[region]]\ncamera = "cam"\n', start=True, scale=1, count=4):
    """A take of a thing that moves, its video a folder of images."""
    truth = [state((0.004 * k, 0.0, 0.0), (0.0, 0.03 * k, 0.0)) for k in range(count)]
    (folder / "img").mkdir()
    for k, one in enumerate(truth):
        picture = cv2.resize(image(one, seed=k), None, fx=scale, fy=scale)
        cv2.imwrite(str(folder / "img" / f"{k:03d}.png"), picture[..., ::-1])
    mesh = thing().surfaces[0]
    lines = [f"v {' '.join(map(str, v))}" for v in mesh.vertices]
    lines += [f"f {' '.join(map(str, f + 1))}" for f in mesh.faces]
    (folder / "thing.obj").write_text("\n".join(lines))
    (folder / "thing.toml").write_text(
        '[body]\nname = "thing"\n[[segment]]\nname = "thing"\njoint = { name = "free", type = "free" }\n'
        'surface = { mesh = "thing.obj" }\n'
    )
    write_calibration(RIG, folder / "calibration.toml")
    T = truth[0].T_world_root
    begin = f"[start]\nat = {T[:3, 3].tolist()}\nforward = {T[:3, 0].tolist()}\nupward = {T[:3, 1].tolist()}\n"
    (folder / "take.toml").write_text(
        '[take]\nrate = 30.0\nup = "-y"\nbody = "thing.toml"\nsize = false\n' + (begin if start else "")
        + '[calibration]\nfile = "calibration.toml"\n[[camera]]\nname = "cam"\nvideo = "img"\n'
        + ('image = "scaled"\n' if scale != 1 else "") + region
    )  # fmt: skip
    return folder / "take.toml", truth


@pytest.mark.parametrize("scale", [1, 2])
def test_a_rigid_thing_is_followed(tmp_path, scale):
    """Also in a video that is not of the calibration's size."""
    take, truth = written(tmp_path, scale=scale)
    motion, seen = track_take(take)
    assert seen.of_kind("region")[0].size == CAMERA.size and seen.of_kind("region")[0].frame(0).size == CAMERA.size
    for k, one in enumerate(truth):
        assert off(BodyState(motion.Ts_world_root[k], motion.angles[k]), one) < (0.012, 2.5)
    assert motion.quality.min() > 0.6 and "region cam" in motion.residuals
    assert np.isfinite(motion.dof_std).all()


def test_sigma_is_the_sensors(tmp_path):
    take, _ = written(tmp_path, region='[[region]]\ncamera = "cam"\nsigma = 2.5\n')
    parsed = read_take(take)
    recording, _ = recording_of(parsed, load_observations(parsed), thing())
    assert recording.sigma["region cam"] == 2.5
    take.write_text(take.read_text().replace("sigma = 2.5\n", ""))
    parsed = read_take(take)
    assert "region cam" not in recording_of(parsed, load_observations(parsed), thing())[0].sigma


@pytest.mark.parametrize("region, message", [
    ('[[region]]\ncamera = "cam"\nsigma = 0.0\n', "sigma = 0.0. Give a positive"),
    ('[[region]]\ncamera = "other"\n', "other"),
    ('[[region]]\ncamera = "cam"\n[[region]]\ncamera = "cam"\n', r"two \[\[region\]\]"),
    ('[[region]]\ncamera = "cam"\nfile = "masks"\n', "file"),
    ('[[camera]]\nname = "blind"\n[[region]]\ncamera = "blind"\n', "blind"),
])  # fmt: skip
def test_what_cannot_be_is_refused(tmp_path, region, message):
    take, _ = written(tmp_path, region=region, count=1)
    with pytest.raises(TakeError, match=message):
        read_take(take)


def test_colours_alone_do_not_begin_a_take(tmp_path):
    take, _ = written(tmp_path, start=False, count=1)
    with pytest.raises(TakeError, match=r"\[\[region\]\]: it alone does not determine"):
        track_take(take.read_text() and take)
