"""`[[pose]]` of a take: every format read, sides and size found, proposals of `kinefit init`, and what is refused."""

import json

import numpy as np
import pytest
from tests.fitting.tracking.movements import BODY, RATE, a_motion

from kinefit.bodies import load_body
from kinefit.cli import main
from kinefit.errors import FileError, KinefitError, ObservationError
from kinefit.exporters.motion_file import write_motion
from kinefit.exporters.opensim import write_trc
from kinefit.exporters.skeletons.bvh import write_bvh
from kinefit.findings import of_provenance
from kinefit.readers.guess.folder import guess_take
from kinefit.readers.motion import read_motion
from kinefit.readers.take.file import read_take
from kinefit.sensors.kinds.poses import places_of, read_poses
from kinefit.sensors.points.poses import HIPS
from kinefit.takes.check import check_take
from kinefit.takes.track import track_take

COUNT = 30
NAMES = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
PLACES = tuple(f"{side}_{name}" for side in "lr" for name in NAMES)


def joints(count=COUNT, size=1.0):
    points = BODY.landmarks.select(PLACES)
    return size * np.array([BODY.positions(a_motion("walk").state(i), points) for i in range(count)])


def names(pattern="{Side}{Name}"):
    sides = {"l": ("l", "L", "left"), "r": ("r", "R", "right")}
    return [pattern.format(s=sides[p[0]][0], Side=sides[p[0]][1], side=sides[p[0]][2], name=p[2:], Name=p[2:].title())
            for p in PLACES]  # fmt: skip


def written(folder, x=None, **more):
    path = folder / "joints.json"
    x = joints() if x is None else x
    path.write_text(json.dumps({"names": names(), "rate": RATE, "joints": x.tolist(), **more}))
    text = '[take]\nup = "y"\nbody = "humanoid10"\n[[pose]]\nfile = "joints.json"\n'
    (folder / "take.toml").write_text(text)
    return folder / "take.toml"


@pytest.mark.parametrize("pattern", ["{Side}{Name}", "{side}_{name}", "{Side}_{Name}", "{s}_{name}", "{name}_{side}"])
def test_joints_are_known_by_their_names(pattern):
    assert places_of(names(pattern), BODY) == dict(zip(names(pattern), PLACES))


@pytest.mark.parametrize("count", [22, 24, 45, 127])
def test_joints_of_smpl_need_no_names(tmp_path, count):
    x = np.random.default_rng(0).normal(size=(3, count, 3))
    np.savez(tmp_path / "smpl.npz", joints=x, rate=30.0)
    found = read_poses(tmp_path / "smpl.npz")
    known = places_of(found.names, load_body("humanoid"))
    assert known["L_Hip"] == "l_hip" and known["R_Wrist"] == "r_wrist" and known["L_Foot"] == "toes_l"
    assert np.array_equal(found.x, x[:, : len(found.names)]) and np.isclose(found.times[-1], 2.0 / 30.0)
    several = np.stack([x, x + 1.0], axis=1)
    np.savez(tmp_path / "two.npz", joints=several, rate=30.0)
    assert np.array_equal(read_poses(tmp_path / "two.npz", person=2).x, x[:, : len(found.names)] + 1.0)
    with pytest.raises(ObservationError, match="2 people, and none of them chosen"):
        read_poses(tmp_path / "two.npz")


def test_files_of_opencap(tmp_path):
    place, turn = [[0.0, 1.0, 0.0], [0.1, 1.0, 0.0]], [[0.0, 0.0, 0.0]] * 2
    bodies = {n: {"rotation": turn, "translation": place, "scaleFactors": [1, 1, 1]} for n in ("pelvis", "femur_r")}
    (tmp_path / "mono.json").write_text(json.dumps({"time": [0.0, 0.01], "bodies": bodies}))
    found = read_poses(tmp_path / "mono.json")
    assert found.names == ("pelvis", "femur_r") and found.up == "y" and np.array_equal(found.x[:, 1], place)
    assert found.points["pelvis"] == ("r_asis", "l_asis") and found.points["talus_l"] == "l_ankle"


def test_motions_of_other_programs(tmp_path):
    motion = a_motion("walk")
    write_trc(motion, tmp_path / "walk.trc")
    write_bvh(motion, tmp_path / "walk.bvh")
    write_motion(motion, tmp_path / "motion.npz")
    for name in ("walk.trc", "walk.bvh", "motion.npz"):
        found = read_poses(tmp_path / name)
        known = places_of(found.names, BODY)
        assert sum(place in HIPS for place in known.values()) == 2, name
        hip = next(n for n, place in known.items() if place in ("l_hip", "thigh_l"))
        truth = motion.joint_centres[:, BODY.tree.segment("thigh_l")]
        assert found.up in ("y", None), name
        assert np.allclose(found.x[:, found.names.index(hip)], truth, atol=2e-3), name


def test_the_command_makes_a_motion_of_it(tmp_path):
    """Joints of a person 8 % larger than the body, every bone of which is 3 mm longer or shorter in each frame."""
    x = joints(size=1.08)
    take = written(tmp_path, x + 0.003 * np.random.default_rng(0).normal(size=x.shape))
    with pytest.raises(SystemExit) as done:
        main(["track", str(take), "-o", str(tmp_path / "out"), "--pictures", "none", "--no-report"])
    found = read_motion(tmp_path / "out" / "motion.npz")
    assert done.value.code == 0 and len(found) == COUNT and list(found.residuals) == ["poses"]
    knees = found.joint_centres[:, [BODY.tree.segment(f"shank_{s}") for s in "lr"]]
    assert np.linalg.norm(knees - x[:, [PLACES.index("l_knee"), PLACES.index("r_knee")]], axis=2).mean() < 0.02
    assert 1.0 < found.body.stature / BODY.stature < 1.12


@pytest.mark.parametrize("what", ["mirrored-z", "exchanged"])
def test_wrong_sides_are_named_and_mended(tmp_path, what):
    x = joints(60)
    order = [PLACES.index(("r" if p[0] == "l" else "l") + p[1:]) for p in PLACES]
    take = written(tmp_path, x * (1.0, 1.0, -1.0) if what == "mirrored-z" else x[:, order])
    with pytest.raises(KinefitError, match="fits .* times better in a mirror") as raised:
        track_take(take)
    assert "[[pose]]" in raised.value.remedy
    assert any(f.kind == "sides" and f.severity == "fault" for f in check_take(take).findings)
    take.write_text(take.read_text() + f'sides = "{what}"\n')
    assert not any(f.kind == "sides" for f in check_take(take).findings)


def test_init_proposes_such_a_file(tmp_path):
    written(tmp_path).unlink()
    (tmp_path / "other.json").write_text('{"a": 1}')
    found = guess_take(tmp_path)
    assert found.text.count("[[pose]]") == 1 and 'file = "joints.json"' in found.text


@pytest.mark.parametrize(
    ("content", "error", "said"),
    [
        ("[1, 2]", FileError, "list without keys"),
        ("{", FileError, "cannot read the poses"),
        ('{"a": 1}', FileError, "no joints among a"),
        ('{"joints": [[[0, 0, 0]]], "rate": 30}', FileError, "1 joints without names"),
        ('{"joints": [[[0, 0, 0]]], "names": ["a", "b"]}', FileError, "shape .1, 1, 3. and 2 names"),
        ('{"joints": [[[0, 0, 0], [1, 1, 1]]], "names": ["a", "a"]}', FileError, "named 'a'"),
        ('{"joints": [[[0, 0, 0]], [[0, 0, 1]]], "names": ["a"], "times": [1, 1]}', FileError, "not increasing"),
        ('{"joints": [[["x", 0, 0]]], "names": ["a"]}', FileError, "cannot read the poses"),
        ('{"time": [0], "bodies": {"pelvis": 3}}', FileError, "cannot read the poses"),
    ],
)
def test_files_that_are_none(tmp_path, content, error, said):
    (tmp_path / "x.json").write_text(content)
    with pytest.raises(error, match=said) as raised:
        read_poses(tmp_path / "x.json")
    assert raised.value.file and raised.value.remedy


def test_other_suffixes_are_refused(tmp_path):
    (tmp_path / "smpl.pkl").write_bytes(b"\x80\x04")
    with pytest.raises(FileError, match="no format of poses") as raised:
        read_poses(tmp_path / "smpl.pkl")
    assert ".npz" in raised.value.remedy


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ('joints = { knee = "l_knee" }', "no joint 'knee'"),
        ('joints = { LHip = "l_hip", RHip = "r_hip" }', "2 are known places"),
        ('unit = "mile"', "unit 'mile'"),
        ('unit = "km"', "unit"),
        ('camera = "cam"', "cam"),
        ('camera = "cam"\nup = "z"', "a camera, and a place in the world"),
        ("sigma = 0.0", "sigma"),
        ("offset_sigma = -1.0", "offset_sigma"),
        ("twist = 3", "no key 'twist'"),
    ],
)
def test_takes_that_are_refused(tmp_path, more, said):
    take = written(tmp_path)
    take.write_text(take.read_text() + more + "\n")
    with pytest.raises(KinefitError, match=said):
        track_take(read_take(take))


@pytest.mark.parametrize("right", [True, False])
def test_joints_that_are_of_no_body_are_named(tmp_path, right):
    random = np.random.default_rng(1)
    x = joints() + 0.003 * random.normal(size=(COUNT, len(PLACES), 3))
    motion, _ = track_take(written(tmp_path, x if right else random.permuted(x, axis=1)))
    found = [f for f in of_provenance(motion.provenance) if f.kind == "pose"]
    assert not found if right else "joints.json fit neither one body" in found[0].text and found[0].severity == "fault"


def test_a_place_that_the_body_lacks_is_a_fault_of_the_check(tmp_path):
    take = written(tmp_path)
    places = {**dict(zip(names(), PLACES)), names()[1]: "no_such_point"}
    take.write_text(take.read_text() + "joints = {" + ", ".join(f'{n} = "{p}"' for n, p in places.items()) + "}\n")
    assert any("no_such_point" in f.text for f in check_take(take).findings if f.severity == "fault")
    with pytest.raises(KinefitError, match="no_such_point"):
        track_take(take)
