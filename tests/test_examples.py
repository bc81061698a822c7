"""Every example runs, on small inputs, and shows what it promises."""

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[1] / "examples"


def example(name):
    spec = importlib.util.spec_from_file_location(f"example_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_each_example_has_a_test():
    here = Path(__file__).read_text(encoding="utf-8")
    assert all(f'example("{path.stem}")' in here for path in FOLDER.glob("*.py"))


def test_examples_import_from_doors_alone():
    allowed = re.compile(r"^(import kinefit$|from kinefit(\.[a-z]+)? import )")
    lines = [line for path in FOLDER.glob("*.py") for line in path.read_text("utf-8").splitlines()]
    assert [line for line in lines if re.match("(from|import) kinefit", line) and not allowed.match(line)] == []


def test_track_a_take(data_dir, tmp_path, capsys):
    recording = data_dir("video_balancing_4cam")
    parts = ['[take]\nname = "short"\nrate = 60.0\nframes = [0, 12]\n']
    parts += [f'[calibration]\nfile = "{(recording / "Calib_refined_static.toml").as_posix()}"\n']
    for name in ("cam01", "cam02", "cam03", "cam04"):
        folder = (recording / "openpose_json" / name).as_posix()
        parts += [f'[[camera]]\nname = "{name}"\n[[keypoints]]\ncamera = "{name}"\nfile = "{folder}"\n']
    (tmp_path / "take.toml").write_text("\n".join(parts))
    motion = example("00_demo_track").main(tmp_path / "take.toml", tmp_path / "out")
    told = capsys.readouterr().out
    assert len(motion) == 12
    assert told.count(" s  hip_flexion_r") == 5
    assert (tmp_path / "out" / "motion.bvh").is_file()
    assert (tmp_path / "out" / "tables" / "angles.csv").is_file()


def test_a_body_of_ones_own():
    found, std, truth = example("01_own_body").main()
    assert np.all(np.abs(found - truth) < 3 * std)
    assert np.all(std < 3.0)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_rows_of_ones_own(seed):
    errors = example("02_own_rows").main(seed=seed)
    (alone, alone_std), (roped, roped_std) = errors["camera alone"], errors["camera and rope"]
    assert roped_std < alone_std
    assert roped < 3 * roped_std
    assert alone < 3 * alone_std


def test_the_rows_of_ones_own_are_the_derivative_of_the_distance():
    module = example("02_own_rows")
    arm = module.kinefit.load_body("arm")
    state = arm.rest_state()
    points, centre = arm.landmarks, np.array([0.4, -0.2, 0.3])
    rows = module.sphere_rows(arm, state, points, centre, 0.5)
    step = 1e-6 * np.array([1.0, 2.0, -1.0])
    shift = np.eye(4)
    shift[:3, 3] = step
    shifted = module.kinefit.BodyState(shift @ state.T_world_root, state.angles)
    moved = module.sphere_rows(arm, shifted, points, centre, 0.5)
    assert np.allclose(rows.residual - moved.residual, rows.direction @ step, rtol=1e-4)


def test_a_known_motion(data_dir):
    joints, angles = example("03_known_motion").main(data_dir("motion_cmu_bvh") / "cmu_12_01_walk.bvh")
    assert joints.shape[0] == 60
    assert joints.mean() < 15
    assert np.median(angles) < 5


def test_a_known_motion_without_a_file():
    joints, angles = example("03_known_motion").main(frames=10)
    assert joints.mean() < 12
    assert np.median(angles) < 4


def test_a_live_source(capsys):
    error, tracker = example("04_live_fusion").main(frames=8)
    assert error < 0.015
    assert tracker.dropped == tracker.late == 0
    assert capsys.readouterr().out.count("quality") == 8


def test_markers_without_names(tmp_path, capsys):
    module = example("05_markers")
    labelled, points = module.simulated()
    found, motion = module.main(out=tmp_path)
    truth = labelled.positions[: len(points), [labelled.names.index(n) for n in found.labels]]
    off = np.linalg.norm(found.positions - truth, axis=-1)
    measured = found.column >= 0
    assert measured.mean() > 0.97
    assert off[measured].max() < 1e-9
    assert len(motion) == len(points)
    assert np.nanmedian(motion.residuals["markers"].norms) < 0.004
    assert "look at" not in capsys.readouterr().out
    assert {"labelled.c3d", "body.osim", "motion.mot"} <= {path.name for path in tmp_path.iterdir()}


def test_a_morph_of_ones_own(tmp_path):
    errors = example("06_own_morph").main(tmp_path / "arm.png")
    assert errors["morphing"] < 0.6
    assert errors["rigid"] > 3 * errors["morphing"]
    assert (tmp_path / "arm.png").stat().st_size > 1000


@pytest.mark.parametrize("seed", [0, 1])
def test_a_sensor_of_ones_own(seed, capsys):
    subject, errors, taut = example("07_own_sensor").main(seed=seed)
    length, std = subject.value("rope length")
    assert abs(length - 0.8) < 0.005
    assert abs(length - 0.8) < 3 * std < 0.015
    assert 20 < taut.sum() < 50
    assert np.median(errors["one camera and the rope"]) < 0.9 * np.median(errors["one camera"])
    assert np.median(errors["one camera and the rope"][taut]) < 0.5 * np.median(errors["one camera"][taut])
    assert "m is the truth" in capsys.readouterr().out


def test_a_network_of_ones_own(tmp_path, capsys):
    off, confidence = example("08_own_network").main(tmp_path / "discs.colours")
    assert off.max() < 2.0 and confidence.min() > 0.8 and "LWrist" in capsys.readouterr().out
