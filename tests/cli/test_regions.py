"""A real hand-held object by its colours, through the command."""

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from kinefit import read_calibration, read_motion
from kinefit.bodies import BodyState
from kinefit.bodies.rendering import render_body, scaled
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.cli import main

FRAMES = 9


def test_a_real_object_is_followed_by_its_mesh(tmp_path, data_dir):
    folder = data_dir("region_cat")
    rows = np.loadtxt(folder / "img" / "pose.txt")[:FRAMES]
    R, t, K = rows[:, :9].reshape(-1, 3, 3), 1e-3 * rows[:, 9:], np.loadtxt(folder / "K.txt").reshape(3, 3)
    (tmp_path / "cat.toml").write_text(
        '[body]\nname = "cat"\n[[segment]]\nname = "cat"\njoint = { name = "free", type = "free" }\n'
        f'surface = {{ mesh = "{folder}/Cat.obj", unit = "mm" }}\n'
    )
    (tmp_path / "calibration.toml").write_text(
        f'[cam]\nname = "cam"\nsize = [640.0, 512.0]\nmatrix = {K.tolist()}\ndistortions = [0.0, 0.0, 0.0, 0.0]\n'
        "rotation = [0.0, 0.0, 0.0]\ntranslation = [0.0, 0.0, 0.0]\nfisheye = false\n"
    )
    (tmp_path / "take.toml").write_text(
        f'[take]\nrate = 30.0\nup = "-y"\nbody = "cat.toml"\nsize = false\nframes = [0, {FRAMES}]\n[start]\n'
        f"at = {np.round(t[0], 2).tolist()}\nforward = {np.round(R[0, :, 0], 1).tolist()}\n"
        f"upward = {np.round(R[0, :, 1], 1).tolist()}\n"
        f'[calibration]\nfile = "calibration.toml"\n[[camera]]\nname = "cam"\nvideo = "{folder}/img/*.png"\n'
        '[[region]]\ncamera = "cam"\n'
    )
    told = CliRunner().invoke(
        main, ["track", str(tmp_path / "take.toml"), "-o", str(tmp_path / "out"), "--formats", "motion", "--no-report"]
    )
    assert told.exit_code == 0, told.output
    motion = read_motion(tmp_path / "out" / "motion.npz")
    turn = np.arccos(np.clip((np.einsum("fij,fij->f", motion.Ts_world_root[:, :3, :3], R) - 1) / 2, -1, 1))
    assert np.linalg.norm(motion.Ts_world_root[:, :3, 3] - t, axis=1).max() < 0.05
    assert np.degrees(turn).max() < 10.0 and np.degrees(np.median(turn)) < 6.0  # the truth is good to some degrees here
    assert motion.quality.min() > 0.4
    assert list((tmp_path / "out" / "overlays").glob("*.mp4"))


@pytest.mark.slow
def test_a_real_person_is_followed_by_colours_after_the_first_frame(tmp_path, data_dir):
    """Two cameras, keypoints of the first frame alone, no masks."""
    folder = data_dir("video_balancing_4cam")
    text = "[take]\nheight = 1.75\nframes = [0, 4]\n"
    text += f'[calibration]\nfile = "{folder}/Calib_refined_static.toml"\nunit = "m"\n'
    for camera in ("cam03", "cam04"):
        text += (
            f'[[camera]]\nname = "{camera}"\nvideo = "{folder}/videos/{camera}.mp4"\n[[region]]\ncamera = "{camera}"\n'
            f'[[keypoints]]\ncamera = "{camera}"\nfile = "{folder}/openpose_json/{camera}"\nset = "BODY_25B"\n'
            'frames = [0, 1]\n'
        )
    (tmp_path / "take.toml").write_text(text)
    told = CliRunner().invoke(
        main, ["track", str(tmp_path / "take.toml"), "-o", str(tmp_path / "out"), "--formats", "motion", "--no-report",
               "--no-overlays"],
    )  # fmt: skip
    assert told.exit_code == 0, told.output
    motion = read_motion(tmp_path / "out" / "motion.npz")
    assert motion.quality.min() > 0.6
    mesh, shares = body_mesh(motion.body), []
    for camera in read_calibration(folder / "Calib_refined_static.toml", unit="m"):
        if camera.name not in ("cam03", "cam04"):
            continue
        small = scaled(camera, 0.25)
        state = BodyState(motion.Ts_world_root[3], motion.angles[3])
        seen = render_body(motion.body, state, small, mesh=mesh).seen
        mask = cv2.imread(str(folder / "person_masks" / camera.name / "003.png"), cv2.IMREAD_GRAYSCALE)
        mask = cv2.resize(mask, small.size, interpolation=cv2.INTER_AREA) > 127
        shares.append((seen & mask).sum() / (seen | mask).sum())
    assert min(shares) > 0.8
