"""Motions: what they hold, and turning them to another vertical axis."""

import sys
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from tests.oracle import posture

from kinefit.bodies import load_body
from kinefit.bodies.masses import segment_masses
from kinefit.bodies.motion import UP_AXES, Motion, Residuals, rotation_between_up
from kinefit.errors import ExportError, ObservationError
from kinefit.exporters.tables import tables
from kinefit.geometry import se3

BODY = load_body("humanoid10")


def a_motion(frames=4, seed=0):
    random = np.random.default_rng(seed)
    states = [posture(BODY, k, 0.3) for k in range(frames)]
    segments, dofs = len(BODY.tree.segments), BODY.tree.n_dofs
    values = random.normal(size=(frames, 2, 3))
    markers = Residuals(
        ("a", "b"), np.array([0, 1]), values, np.ones((frames, 2)), "m", values + 1, np.zeros(frames, bool)
    )
    pixels = replace(markers, values=values[..., :2], measured=values[..., :2] + 1, unit="px")
    return Motion(
        BODY, 50.0, np.arange(frames) / 50,
        np.stack([s.T_world_root for s in states]), np.stack([s.angles for s in states]),
        random.uniform(0.01, 0.1, (frames, dofs)), random.uniform(0.01, 0.1, (frames, segments, 3)), np.ones(frames),
        np.ones((frames, segments)), {"lab": markers, "cam": pixels}, up="y",
    )  # fmt: skip


MOTION = a_motion()


@pytest.mark.parametrize("source", UP_AXES)
@pytest.mark.parametrize("target", UP_AXES)
def test_rotation_between_vertical_axes(source, target):
    R = rotation_between_up(source, target)
    np.testing.assert_array_equal(R @ UP_AXES[source], UP_AXES[target])
    np.testing.assert_array_equal(R @ R.T, np.eye(3))
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_array_equal(R, np.round(R))  # axes onto axes
    if source == target:
        np.testing.assert_array_equal(R, np.eye(3))


def test_an_unknown_axis_is_told():
    with pytest.raises(ObservationError, match=r"no vertical axis 'up'; there are: x, y, z, -x"):
        rotation_between_up("y", "up")


@pytest.mark.parametrize("up", UP_AXES)
def test_a_turned_motion_is_the_same_motion(up):
    turned, R = MOTION.turned(up), rotation_between_up("y", up)
    assert turned.up == up
    np.testing.assert_allclose(turned.positions(), MOTION.positions() @ R.T, atol=1e-12)
    np.testing.assert_array_equal(turned.angles, MOTION.angles)
    np.testing.assert_allclose(turned.residuals["lab"].values, MOTION.residuals["lab"].values @ R.T)
    np.testing.assert_allclose(turned.residuals["lab"].measured, MOTION.residuals["lab"].measured @ R.T)
    np.testing.assert_array_equal(turned.residuals["cam"].values, MOTION.residuals["cam"].values)
    np.testing.assert_allclose(turned.joint_std, MOTION.joint_std @ np.abs(R).T)
    for span in (slice(0, 3), slice(3, 6)):
        np.testing.assert_allclose(turned.dof_std[:, span], MOTION.dof_std[:, span] @ np.abs(R).T)
    np.testing.assert_array_equal(turned.dof_std[:, 6:], MOTION.dof_std[:, 6:])
    back = turned.turned("y")
    np.testing.assert_allclose(back.Ts_world_root, MOTION.Ts_world_root, atol=1e-12)


@pytest.mark.parametrize("up", ["z", "-y", "x"])
def test_what_is_unbounded_stays_unbounded_when_turned(up):
    """∞ stands for what nothing observes: turned it must not become NaN."""
    joint, dof = np.array(MOTION.joint_std), np.array(MOTION.dof_std)
    joint[1, 3], dof[1, :6] = np.inf, np.inf
    joint[2, 4, 1], dof[2, 2] = np.inf, np.inf  # along one axis alone
    turned, R = replace(MOTION, joint_std=joint, dof_std=dof).turned(up), rotation_between_up("y", up)
    assert not np.isnan(turned.joint_std).any() and not np.isnan(turned.dof_std).any()
    assert np.all(np.isinf(turned.joint_std[1, 3])) and np.all(np.isinf(turned.dof_std[1, :6]))
    np.testing.assert_array_equal(np.isinf(turned.joint_std[2, 4]), np.abs(R[:, 1]) > 0.5)
    np.testing.assert_array_equal(np.isinf(turned.dof_std[2, :3]), np.abs(R[:, 2]) > 0.5)
    np.testing.assert_allclose(turned.joint_std[0], MOTION.joint_std[0] @ np.abs(R).T)


def test_frames_and_positions():
    assert len(MOTION) == 4
    for f in range(4):
        state = MOTION.state(f)
        np.testing.assert_allclose(MOTION.positions()[f], BODY.positions(state, BODY.landmarks), atol=1e-12)
    poses = MOTION.segment_poses()
    np.testing.assert_allclose(poses[:, 0], MOTION.Ts_world_root, atol=1e-14)
    np.testing.assert_allclose(poses @ se3.inverse(poses), np.broadcast_to(np.eye(4), poses.shape), atol=1e-12)
    two = BODY.landmarks.select(BODY.landmarks.names[:2])
    assert MOTION.positions(two).shape == (4, 2, 3)


def test_residual_norms():
    r = MOTION.residuals["lab"]
    np.testing.assert_allclose(r.norms, np.sqrt((r.values**2).sum(axis=-1)))


@pytest.mark.parametrize("name", ["Ts_world_root", "angles"])
def test_a_motion_must_be_finite(name):
    values = np.array(getattr(MOTION, name))
    values[2].flat[0] = np.nan
    with pytest.raises(ObservationError, match="not finite"):
        replace(MOTION, **{name: values})


def test_arrays_are_read_only_copies():
    with pytest.raises(ValueError, match="read-only"):
        MOTION.angles[0, 0] = 1.0


def test_five_lines_tell_what_a_motion_is():
    lines = repr(replace(MOTION, name="a <walk>")).split("\n")
    assert len(lines) == 5 and lines[0] == "Motion a <walk>: 4 frames at 50 Hz (0.08 s), y up"
    assert lines[1].startswith(f"body humanoid10: {len(BODY.tree.segments)} segments")
    lab, cam = (np.median(MOTION.residuals[name].norms) for name in ("lab", "cam"))
    assert f"lab ({1000 * lab:.1f} mm), cam ({cam:.1f} px)" in lines[2]
    assert lines[3] == "quality: 1.00 of 1 on average, lowest 1.00 in frame 0"
    assert "angles (4, " in lines[4] and "to_dataframe()" in lines[4]
    assert len(repr(replace(MOTION, residuals=dict.fromkeys(map(str, range(50)), MOTION.residuals["cam"])))) < 700
    html = replace(MOTION, name="a <walk>")._repr_html_()
    assert "<b>Motion a &lt;walk&gt;: 4 frames" in html and html.count("<br>") == 4


def test_joint_centres_are_the_origins_of_the_segments():
    np.testing.assert_array_equal(MOTION.joint_centres, MOTION.segment_poses()[..., :3, 3])
    assert MOTION.joint_centres.shape == (4, len(BODY.joints), 3)


@pytest.mark.parametrize("up", ["y", "z"])
def test_the_centre_of_mass_moves_with_the_body(up):
    motion = MOTION.turned(up)
    T = se3.exp(np.array([0.3, -0.2, 0.5, 0.0, 0.0, 0.4] if up == "z" else [0.3, -0.2, 0.5, 0.0, 0.4, 0.0]))
    np.testing.assert_allclose(motion.moved(T).centre_of_mass, se3.apply(T, motion.centre_of_mass), atol=1e-9)
    found = segment_masses(BODY)
    for frame in range(len(motion)):
        Ts = motion.segment_poses()[frame]
        places = [se3.apply(Ts[s], found.centres[s]) for s in range(len(found.masses))]
        np.testing.assert_allclose(motion.centre_of_mass[frame], found.masses @ places / found.masses.sum(), atol=1e-9)


def test_the_error_of_the_centre_of_mass_is_between_those_of_joints():
    std = MOTION.centre_of_mass_std
    assert std.shape == (4, 3)
    assert np.all(std > MOTION.joint_std.min(axis=1)) and np.all(std < MOTION.joint_std.max(axis=1))
    table = tables(MOTION, unit="mm")["joints"]
    np.testing.assert_allclose(table["com z [mm]"], 1000.0 * MOTION.centre_of_mass[:, 2])
    np.testing.assert_allclose(table["com x std [mm]"], 1000.0 * std[:, 0])


def test_another_mass_is_of_the_same_motion():
    child = MOTION.with_mass(32.0)
    assert child.body.mass == 32.0 and MOTION.with_mass(None) is MOTION
    np.testing.assert_allclose(child.centre_of_mass, MOTION.centre_of_mass, atol=1e-9)


def test_a_data_frame_has_the_columns_of_the_tables(monkeypatch):
    pandas = ModuleType("pandas")
    pandas.DataFrame = lambda columns, index: (columns, index)
    pandas.RangeIndex = lambda count, name: (count, name)
    monkeypatch.setitem(sys.modules, "pandas", pandas)
    columns, index = MOTION.to_dataframe()
    known = tables(MOTION)
    assert index == (4, "frame")
    assert list(columns) == ["time [s]", *list(known["angles"])[2:], *list(known["joints"])[2:], "quality"]
    for name in columns:
        values = next(table[name] for table in known.values() if name in table)
        np.testing.assert_array_equal(columns[name], values)


def test_a_data_frame_without_pandas_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ExportError, match="pip install pandas"):
        MOTION.to_dataframe()


def test_a_data_frame_of_pandas():
    pytest.importorskip("pandas")
    frame = MOTION.to_dataframe()
    assert frame.shape[0] == 4 and frame["quality"].mean() == 1.0
