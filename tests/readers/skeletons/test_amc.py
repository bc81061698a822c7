import numpy as np
import pytest
from benchmarks.robustness.fuzz import fuzz_seeds
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from kinefit.errors import FileError
from kinefit.readers.skeletons.acclaim import read_amc, read_asf
from kinefit.readers.skeletons.bvh import read_bvh

ASF = f"# comment\n{fuzz_seeds.ASF}"
AMC = """#!OML:ASF
:FULLY-SPECIFIED
:DEGREES
1
root 0 0 0 0 0 0
arm 0 0
2
root 1 2 3 0 0 90
arm 90 0
"""
UNIT = 0.0254 / 0.5

REAL = {  # skeleton, frames
    "02_01": ("02", 343),
    "02_03": ("02", 173),
    "02_04": ("02", 483),
    "02_06": ("02", 2235),
    "02_10": ("02", 2645),
    "03_01": ("03", 432),
    "13_30": ("02", 2465),
    "14_20": ("02", 4644),
}


@pytest.fixture
def read(tmp_path):
    def read_texts(asf=ASF, amc=AMC, **options):
        (tmp_path / "a.asf").write_text(asf)
        (tmp_path / "a.amc").write_text(amc)
        return read_amc(tmp_path / "a.asf", tmp_path / "a.amc", **options)

    return read_texts


def test_known_positions(read):
    motion = read()
    assert motion.names == ("root", "arm", "hand", "hand_end")
    assert motion.parents.tolist() == [-1, 0, 1, 2]
    assert (motion.rate, motion.up, len(motion)) == (120.0, "y", 2)
    np.testing.assert_allclose(motion.positions[0] / UNIT, [[0, 1, 0], [0, 1, 0], [3, 1, 0], [3, 2, 0]], atol=1e-12)
    # The arm's rx turns about its own x, the world's y at rest: x to -z. Then the root's Rz(90°): y to -x.
    np.testing.assert_allclose(motion.positions[1] / UNIT, [[1, 3, 3], [1, 3, 3], [1, 3, 0], [0, 3, 0]], atol=1e-12)
    np.testing.assert_allclose(motion.offsets / UNIT, [[0, 1, 0], [0, 0, 0], [3, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(read(unit=1.0).positions, motion.positions / UNIT, atol=1e-12)
    np.testing.assert_allclose(read(unit="cm").positions, 0.01 * motion.positions / UNIT, atol=1e-12)
    assert read(up="z").up == "z"


def test_skeleton(tmp_path):
    (tmp_path / "a.asf").write_text(ASF)
    skeleton = read_asf(tmp_path / "a.asf")
    arm = skeleton.bones[1]
    assert (arm.name, arm.parent, arm.dofs) == ("arm", 0, ("rx", "rz"))
    np.testing.assert_allclose(arm.vector, [3 * UNIT, 0, 0])
    np.testing.assert_allclose(arm.limits, [[-np.pi / 2, np.pi / 2], [0, np.inf]])
    np.testing.assert_allclose(arm.R_world_axes, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)


@given(
    dofs=st.permutations(["rx", "ry", "rz"]),
    order=st.permutations(["x", "y", "z"]),
    axis=st.lists(st.floats(-180, 180), min_size=3, max_size=3),
    angles=st.lists(st.floats(-180, 180), min_size=3, max_size=3),
)
def test_orders_match_scipy(tmp_path_factory, dofs, order, axis, angles):
    """Listed first, acts first: extrinsic rotations (scipy's lower case)."""
    folder = tmp_path_factory.mktemp("amc")
    asf = ASF.replace("axis 0 0 90 XYZ", f"axis {' '.join(map(repr, axis))} {''.join(order).upper()}")
    asf = asf.replace("dof rx rz", f"dof {' '.join(dofs)}").replace("(0 inf)", "(0 inf) (0 1)")
    (folder / "a.asf").write_text(asf)
    (folder / "a.amc").write_text(f"1\nroot 0 0 0 0 0 0\narm {' '.join(map(repr, angles))}\n")
    C = Rotation.from_euler("".join(order), axis, degrees=True)
    M = Rotation.from_euler("".join(dof[1] for dof in dofs), angles, degrees=True)
    motion = read_amc(folder / "a.asf", folder / "a.amc")
    np.testing.assert_allclose(motion.Ts_world_joint[0, 1, :3, :3], (C * M * C.inv()).as_matrix(), atol=1e-12)


def test_radians_and_rate(read):
    motion = read(amc=AMC.replace("DEGREES", "RADIANS").replace("90", repr(np.pi / 2)), rate=60.0)
    np.testing.assert_allclose(motion.positions, read().positions, atol=1e-12)
    assert motion.rate == 60.0


def test_translating_bone(read):
    motion = read(ASF.replace("dof rx rz", "dof rx tx"), AMC.replace("arm 0 0", "arm 0 2"))
    np.testing.assert_allclose(motion.positions[0, 1] / UNIT, [0, 3, 0], atol=1e-12)  # along its own x


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (":bonedata", ":bones", "no section :bonedata"),
        ("length 0.5", "length 0", "unit 0.0 is not a length"),
        ("direction 2 0 0", "direction 2 0", "line 16: 2 numbers instead of 3"),
        ("direction 2 0 0", "direction 0 0 0", "bone 'arm' has no direction"),
        ("direction 2 0 0", "direction nan 0 0", "line 16: holds a value that is not finite"),
        ("length 3\n", "\n", "line 22: the bone lacks length"),
        ("90 XYZ", "90 XYX", "line 18: the order of axes 'xyx'"),
        ("dof rx rz", "dof rx l", "line 19: no degree of freedom 'l'; there are: rx"),
        ("dof rx rz", "dof rx rx", "line 19: a degree of freedom is listed twice"),
        ("dof rx rz", "dof rx", "bone 'arm' has 4 limits for 1"),
        ("name hand", "name arm", "two bones are named 'arm'"),
        ("arm hand", "arm foot", "line 33: no bone 'foot'; there are: root, arm, hand"),
        ("arm hand", "hand arm", "line 33: bone 'arm' has two parents"),
        ("root arm", "hand arm", "no path from the root to arm, hand"),
        ("  end\n  begin\n     id 2", "  begin\n     id 2", "begin and end do not match"),
    ],
)
def test_bad_skeletons(read, old, new, message):
    assert old in ASF
    with pytest.raises(FileError, match=message) as caught:
        read(asf=ASF.replace(old, new, 1))
    assert caught.value.file.name == "a.asf"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("arm 90 0\n", "", "line 9: frame 2 lacks or repeats arm"),
        ("arm 90 0", "arm 90", "line 9: 1 values for the 2 degrees of freedom of 'arm'"),
        ("arm 90 0", "arm 90 nan", "line 9: holds a value that is not finite"),
        ("arm 90 0", "arm 90 x", "line 9: 'x' is not a number"),
        ("arm 90 0", "leg 90 0", "line 9: no bone 'leg'; there are: root, arm, hand.*skeleton"),
        ("arm 90 0", "arm 90 0\narm 90 0", "frame 2 lacks or repeats arm"),
        ("\n2\n", "\n3\n", "line 7: frame 3 follows frame 1"),
        ("1\n", "", "'root' comes before the first frame"),
        (AMC[AMC.index("1\n") :], "", "holds no frames"),
    ],
)
def test_bad_motions(read, old, new, message):
    assert old in AMC
    with pytest.raises(FileError, match=message) as caught:
        read(amc=AMC.replace(old, new, 1))
    assert caught.value.file.name == "a.amc" and caught.value.remedy


def test_missing_files_and_bad_rate(read, tmp_path):
    read()
    with pytest.raises(FileError, match="cannot read the"):
        read_amc(tmp_path / "a.asf", tmp_path / "none.amc")
    with pytest.raises(FileError, match="rate 0 is not positive"):
        read(rate=0)


@pytest.mark.parametrize("name", REAL)
def test_real_files(data_dir, name):
    folder = data_dir("motion_cmu_amc")
    asf, frames = REAL[name]
    motion = read_amc(folder / f"{asf}.asf", folder / f"{name}.amc")
    skeleton = read_asf(folder / f"{asf}.asf")
    assert (len(motion), len(motion.names), len(skeleton.bones)) == (frames, 38, 31)
    assert skeleton.unit == pytest.approx(0.0254 / 0.45)
    assert np.isfinite(motion.Ts_world_joint).all()
    starts = motion.positions
    for i, bone in enumerate(skeleton.bones):
        for j in np.flatnonzero(motion.parents == i) if i else []:
            length = np.linalg.norm(starts[:, j] - starts[:, i], axis=1)
            np.testing.assert_allclose(length, np.linalg.norm(bone.vector), rtol=1e-9)
    assert -0.05 < starts[..., 1].min() < 0.1  # stands on the floor
    assert 1.4 < np.median(np.ptp(starts[..., 1], axis=1)) < 1.8


# AMC bone with the next one along the limb, and the joints of the BVH's figure that stand for their starts
LIMBS = {
    "left leg": (("lfemur", "ltibia", "lfoot"), ("L_Thigh", "L_Calf", "L_Foot")),
    "right leg": (("rfemur", "rtibia", "rfoot"), ("R_Thigh", "R_Calf", "R_Foot")),
    "left arm": (("lhumerus", "lradius", "lwrist"), ("L_Upperarm", "L_Forearm", "L_Hand")),
    "right arm": (("rhumerus", "rradius", "rwrist"), ("R_Upperarm", "R_Forearm", "R_Hand")),
}


def _bones(motion, names):
    joints = [motion.names.index(name) for name in names]
    return np.diff(motion.positions[:, joints], axis=1)


@pytest.mark.parametrize("limb", LIMBS)
def test_same_walk_in_amc_and_bvh(data_dir, limb):
    """The BVH holds every second frame, from the second, on a figure of other bone lengths.

    Its bones point as the AMC's do, and so the end of a limb of the AMC's lengths lies where the AMC has it.
    """
    folder = data_dir("motion_cmu_amc")
    amc = read_amc(folder / "02.asf", folder / "02_01.amc")
    bvh = read_bvh(data_dir("motion_cmu_bvh") / "002_01.bvh")
    bones = _bones(amc, LIMBS[limb][0])[1::2]
    figure = _bones(bvh, [f"CC_Base_{name}" for name in LIMBS[limb][1]])
    assert len(bones) == len(figure)
    lengths = np.linalg.norm(bones, axis=-1, keepdims=True)
    figure = figure * lengths / np.linalg.norm(figure, axis=-1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((bones * figure).sum(-1) / lengths[..., 0] ** 2, -1, 1)))
    apart = np.linalg.norm((bones - figure).sum(axis=1), axis=-1)
    assert np.median(angle) < 2.0 and angle.max() < 4.0
    assert np.median(apart) < 0.020 and apart.max() < 0.040
