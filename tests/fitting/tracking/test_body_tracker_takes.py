"""`[[tracker]]` of a take: trackers on the body from a table, alone and beside depth, and what is refused."""

import re

import numpy as np
import pytest
from tests.fitting.tracking.movements import BODY, RATE, a_motion
from tests.sensors.points.test_body_trackers import MOUNTS, POINTS, SIGMA, frame

from kinefit.cli import main
from kinefit.errors import FileError, KinefitError, ObservationError
from kinefit.geometry import se3
from kinefit.readers.motion import read_motion
from kinefit.readers.take.file import read_take
from kinefit.sensors.kinds.poses import read_body_trackers
from kinefit.sensors.points.body_trackers import BodyTrackerSensor
from kinefit.simulation.retarget import known_motion
from kinefit.takes.check import check_take
from kinefit.takes.track import track_take

HEADER = "time_s,tracker,x,y,z,qw,qx,qy,qz\n"
COUNT = 20


@pytest.fixture
def taken(tmp_path):
    """A take of ten trackers whose table has axes of its own; one has no orientation, one is missing for a while."""
    rng, rows = np.random.default_rng(0), []
    T_file_world = se3.inverse(se3.transform(se3.exp_so3(np.radians([0.0, 0.0, 30.0])), np.array([0.2, 0.0, 1.0])))
    for i in range(COUNT):
        seen = frame(a_motion().state(i), i / RATE, rng)
        x, Q = se3.apply(T_file_world, seen.x_world), se3.quaternion(T_file_world[:3, :3] @ seen.Rs_world_tracker)
        for name, p, q in zip(seen.names, x, Q):
            if name == "ankle_l" and 5 <= i < 9:
                continue
            told = "," * 3 if name == "skull" else ",".join(f"{v:.7f}" for v in q)
            rows.append(f"{i / RATE:.6f},{name},{p[0]:.6f},{p[1]:.6f},{p[2]:.6f},{told}")
    (tmp_path / "trackers.csv").write_text(HEADER + "\n".join(rows) + "\n")
    points = ", ".join(f'{k} = "{v}"' for k, v in POINTS.items())
    mounts = ", ".join(f"{k} = {np.degrees(v).round(4).tolist()}" for k, v in MOUNTS.items())
    (tmp_path / "take.toml").write_text(
        f'[take]\nrate = {RATE}\nup = "y"\nbody = "humanoid10"\nsize = false\n[[tracker]]\nfile = "trackers.csv"\n'
        f"points = {{ {points} }}\nmounts = {{ {mounts} }}\nsigma = {SIGMA}\nrotation_sigma = 0.6\n"
        "shift = [0.2, 0.0, 1.0]\nturn = [0, 0, 30]\n"
    )
    return tmp_path / "take.toml"


def test_the_command_tracks_the_body(taken, tmp_path):
    with pytest.raises(SystemExit) as done:
        main(["track", str(taken), "-o", str(tmp_path / "out")])
    assert done.value.code == 0
    found = read_motion(tmp_path / "out" / "motion.npz")
    off = found.angles - a_motion().angles[:COUNT]
    assert np.degrees(np.sqrt(np.mean(off**2))) < 1.0 and list(found.residuals) == ["trackers"]
    open_turns = ~np.isfinite(found.dof_std).all(axis=0)  # of the head, whose tracker measures no orientation
    assert {BODY.tree.coordinates[k - 6] for k in np.flatnonzero(open_turns)} <= {"neck_extension", "neck_rotation"}
    z = off / found.dof_std[:, 6:]
    assert 0.4 < np.sqrt(np.mean(z**2)) < 1.6


def test_lengths_follow_from_the_places_of_trackers(taken, tmp_path):
    """A person 8 % smaller than the catalogue's body, of whom ten places are measured and nothing else is known."""
    small = BODY.scaled(np.full(len(BODY.scale_groups), 0.92))
    places = BodyTrackerSensor("trackers", POINTS).places(small, tuple(POINTS))
    rng, rows = np.random.default_rng(1), []
    for i in range(COUNT):
        x = small.positions(a_motion().state(i), places) + 0.002 * rng.normal(size=(len(POINTS), 3))
        rows += [f"{i / RATE:.6f},{name},{p[0]:.6f},{p[1]:.6f},{p[2]:.6f},,,," for name, p in zip(POINTS, x)]
    (tmp_path / "trackers.csv").write_text(HEADER + "\n".join(rows) + "\n")
    text = taken.read_text().replace("size = false\n", "").partition("shift =")[0]
    taken.write_text(text)
    found, moved = track_take(taken)[0], a_motion()
    truth = known_motion(small, RATE, moved.Ts_world_root[:COUNT], moved.angles[:COUNT], up="y")
    limbs = [BODY.tree.segment(name) for name in ("shank_r", "shank_l", "forearm_r", "forearm_l")]
    long, short = (np.linalg.norm(body.tree.offsets[limbs], axis=1) for body in (BODY, found.body))
    assert np.abs(short / long - 0.92).max() < 0.04
    assert np.linalg.norm(found.joint_centres - truth.joint_centres, axis=2).mean() < 0.03


def test_places_and_orientations_of_a_table(taken):
    names = ("skull", "wrist_r", "ankle_l")
    video = read_body_trackers(taken.parent / "trackers.csv", names, time_offset=1.0)
    assert video.names == names and len(video) == COUNT and np.isclose(video.rate, RATE, rtol=1e-3)
    assert np.isclose(video.times[0], 1.0)
    seen = np.isfinite(video.x_world).all(axis=2)
    assert seen[:, :2].all() and np.array_equal(np.flatnonzero(~seen[:, 2]), np.arange(5, 9))
    turned = np.isfinite(video.Rs_world_tracker).all(axis=(2, 3))
    assert not turned[:, 0].any() and turned[:, 1].all() and video.frame(-1).names == names
    assert np.allclose(np.linalg.det(video.Rs_world_tracker[:, 1]), 1.0)


@pytest.mark.parametrize(
    ("text", "error", "said"),
    [
        ("time_s,x,y,z\n0,1,2,3\n", FileError, "no column tracker"),
        (HEADER + "0,a,1,2,x,,,,\n", FileError, "line 2"),
        (HEADER + "0,a,1,2,3,,,,\n1,a,1,nan,3,,,,\n", FileError, "line 3"),
        (HEADER + "0,a,1,2,3,1,0,0,\n1,a,1,2,3,,,,\n", FileError, "line 2.*quaternion|quaternion"),
        (HEADER + "0,a,1,2,3,1,0,0,0\n1,a,1,2,3,0,0,0,0\n", FileError, "quaternion"),
        (HEADER + "0,a,1,2,3,,,,\n0,a,1,2,3,,,,\n", FileError, "a at 0 s has two rows"),
        (HEADER + "0,a,1,2,3,,,,\n", ObservationError, "1 times"),
        (HEADER + "0,b,1,2,3,,,,\n1,b,1,2,3,,,,\n", ObservationError, "no tracker 'a'"),
    ],
)
def test_tables_that_are_none(tmp_path, text, error, said):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(error, match=said) as raised:
        read_body_trackers(tmp_path / "t.csv", ("a",))
    assert raised.value.file and raised.value.remedy


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("sigma = 0.003\n", "sigma = 3.0\n", "sigma = 3.0. Give metres"),
        ("rotation_sigma = 0.6", "rotation_sigma = 0.0", r"\[\[tracker\]\] 1.*0.0 rad"),
        ("rotation_sigma = 0.6", "mount_sigma = -1.0", "mount_sigma -0.01"),
        ("mounts = {", "mounts = { elbow = [0, 0, 1],", "no tracker 'elbow'"),
        ("points = {", 'points = { elbow = "r_elbow",', "no tracker 'elbow'"),
        ('"r_wrist"', '"r_wrst"', r"\[\[tracker\]\] 1.*r_wrst"),
        ("shift = [0.2", "shift = [nan", "shift"),
        ("trackers.csv", "nothing.csv", "no such file"),
        ("turn = [0, 0, 30]", "twist = 3", "no key 'twist'"),
        ("turn = [0, 0, 30]", "time_offset = 50.0", "steps"),
    ],
)
def test_takes_that_are_refused(taken, old, new, said):
    text = taken.read_text()
    assert old in text
    text = text.replace(old, new)
    if "time_offset" in new:
        text = text.replace("up =", "frames = [0, 20]\nup =")
    taken.write_text(text)
    with pytest.raises(KinefitError, match=said) as raised:
        track_take(read_take(taken))
    assert raised.value.remedy or "there are" in raised.value.problem


def test_the_check_makes_the_sensor(taken):
    found = check_take(taken).findings
    assert [finding.severity for finding in found] == ["note"] and "checked by itself" in found[0].text
    taken.write_text(re.sub(r'skull = "\w+"', 'skull = "no_such_point"', taken.read_text()))
    faults = [finding for finding in check_take(taken).findings if finding.severity == "fault"]
    said = "[[tracker]] 1: tracker 'skull': no landmark or segment 'no_such_point'"
    assert len(faults) == 1 and said in faults[0].text


def test_a_take_of_two_tables(taken):
    text = taken.read_text()
    text += '[[tracker]]\nfile = "trackers.csv"\npoints = { skull = "nose_tip" }\nsigma = 0.5\nturn = [0, 0, 30]\n'
    taken.write_text(text)
    found, seen = track_take(read_take(taken))
    assert [video.sensor for video in seen.of_kind("tracker")] == ["trackers 1", "trackers 2"]
    assert set(found.residuals) == {"trackers 1", "trackers 2"} and len(found.body.landmarks) == len(BODY.landmarks)
