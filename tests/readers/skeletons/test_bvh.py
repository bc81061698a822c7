import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from kinefit.errors import FileError
from kinefit.readers.skeletons.bvh import read_bvh
from kinefit.readers.skeletons.common import euler_rotations

SMALL = """HIERARCHY
ROOT hips
{
\tOFFSET 0 0 0
\tCHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
\tJOINT left knee
\t{
\t\tOFFSET 0 -40 0
\t\tCHANNELS 1 Xrotation
\t\tEnd Site
\t\t{
\t\t\tOFFSET 0 -50 0
\t\t}
\t}
}
MOTION
Frames: 2
Frame Time: 0.008333
1 2 3 0 0 0 0
1 2 3 90 0 0 90
"""

# frames, rate [Hz], joints with end sites, vertical axis, metres per unit
REAL = {
    "motion_cmu_bvh/002_01.bvh": (171, 60.0, 142, "y", 0.01),
    "motion_cmu_bvh/002_04.bvh": (241, 60.0, 141, "y", 0.01),
    "motion_cmu_bvh/005_06.bvh": (443, 60.0, 141, "y", 0.01),
    "motion_cmu_bvh/007_04.bvh": (225, 60.0, 141, "y", 0.01),
    "motion_cmu_bvh/007_12.bvh": (132, 60.0, 141, "y", 0.01),
    "motion_cmu_bvh/131_03.bvh": (1102, 120.0, 38, "y", 0.0254 / 0.45),
    "motion_cmu_bvh/cmu_12_01_walk.bvh": (524, 120.0, 38, "y", 0.0254 / 0.45),
    "motion_animateddrawings_bvh/wave_hello.bvh": (839, 120 / 1.001, 34, "z", 0.0254),
    "motion_animateddrawings_bvh/jumping.bvh": (654, 120 / 1.001, 34, "z", 0.0254),
    "motion_animateddrawings_bvh/zombie.bvh": (779, 30.0, 34, "z", 0.0254),
    "motion_animateddrawings_bvh/jumping_jacks.bvh": (125, 30.0, 38, "y", 0.0254 / 0.45),
}


@pytest.fixture
def write(tmp_path):
    def write_file(text, name="a.bvh"):
        path = tmp_path / name
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    return write_file


def test_known_positions(write):
    motion = read_bvh(write(SMALL), unit=0.01)
    assert motion.names == ("hips", "left knee", "left knee_end")
    assert motion.parents.tolist() == [-1, 0, 1]
    assert motion.rate == 120.0
    np.testing.assert_allclose(motion.positions[0], [[0.01, 0.02, 0.03], [0.01, -0.38, 0.03], [0.01, -0.88, 0.03]])
    # Rz(90°): -y becomes x; the knee's Rx(90°) turns its -y to -z first.
    np.testing.assert_allclose(motion.positions[1], [[0.01, 0.02, 0.03], [0.41, 0.02, 0.03], [0.41, 0.02, -0.47]])


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t.replace("\n", "\r\n"),
        lambda t: t.replace("\t", "  "),
        str.upper,
        lambda t: "\ufeff" + t + "\n\n",
        lambda t: t.replace("\n{", " {"),
    ],
)
def test_writing_styles_read_alike(write, change):
    plain, styled = read_bvh(write(SMALL), unit=1.0), read_bvh(write(change(SMALL), "b.bvh"), unit=1.0)
    np.testing.assert_array_equal(plain.Ts_world_joint, styled.Ts_world_joint)


@given(
    order=st.sampled_from(["".join(p) for n in (1, 2, 3) for p in itertools.permutations("xyz", n)]),
    degrees=st.lists(st.floats(-360, 360), min_size=3, max_size=3),
)
def test_euler_orders_match_scipy(order, degrees):
    angles = np.radians(degrees[: len(order)])
    expected = Rotation.from_euler(order.upper(), angles if len(order) > 1 else angles[0]).as_matrix()
    np.testing.assert_allclose(euler_rotations(angles, order), expected, atol=1e-12)


@given(
    channels=st.permutations([a + kind for a in "XYZ" for kind in ("position", "rotation")]),
    values=st.lists(st.floats(-180, 180), min_size=6, max_size=6),
)
def test_channels_in_any_order(tmp_path_factory, channels, values):
    text = SMALL.replace(
        "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation", "CHANNELS 6 " + " ".join(channels)
    )
    text = text[: text.index("1 2 3")].replace("Frames: 2", "Frames: 1") + " ".join(map(repr, [*values, 0.0]))
    path = tmp_path_factory.mktemp("bvh") / "a.bvh"
    path.write_text(text)
    order = "".join(c[0] for c in channels if c.endswith("rotation"))
    turn = Rotation.from_euler(order, [v for c, v in zip(channels, values) if c.endswith("rotation")], degrees=True)
    place = np.array([values[channels.index(a + "position")] for a in "XYZ"])
    motion = read_bvh(path, unit=1.0)
    np.testing.assert_allclose(motion.positions[0, 2], place + turn.apply([0, -90, 0]), atol=1e-9)


@pytest.mark.parametrize(("knee", "expected"), [("0.5 -41 0", [0.5, -41, 0]), ("0.5 -1 0", [0.5, -41, 0])])
def test_position_channels_of_a_joint(write, knee, expected):
    """Near the OFFSET they replace it, near zero they are added to it."""
    text = SMALL.replace("CHANNELS 1 X", "CHANNELS 4 Xposition Yposition Zposition X")
    text = text[: text.index("1 2 3")].replace("Frames: 2", "Frames: 1") + f"0 0 0 0 0 0 {knee} 0\n"
    np.testing.assert_allclose(read_bvh(write(text), unit=1.0).positions[0, 1], expected)


def test_positions_in_the_channels_give_the_lengths_of_bones(write):
    """Where OFFSETs are zero, and where a bone is opposite to its OFFSET."""
    text = SMALL.replace("CHANNELS 1 X", "CHANNELS 4 Xposition Yposition Zposition X").replace("0 -40 0", "{}")
    text = text[: text.index("1 2 3")].replace("Frames: 2", "Frames: 1") + "0 0 0 0 0 0 1 41 0 0\n"
    for offset in ("0 0 0", "0 -40 0"):
        motion = read_bvh(write(text.replace("{}", offset)), unit="cm")
        np.testing.assert_allclose(motion.offsets[1], [0.01, 0.41, 0.0])
        np.testing.assert_allclose(motion.positions[0, 1], [0.01, 0.41, 0.0])


def test_a_world_whose_vertical_axis_points_down(write):
    text = SMALL.replace("left knee", "left foot").replace("hips", "head").replace("90 0 0 90", "0 0 0 0")
    assert read_bvh(write(text)).up == "y"
    text = text.replace("0 -40 0", "0 40 0").replace("0 -50 0", "0 50 0")
    assert read_bvh(write(text), unit=0.01).up == "-y"


@pytest.mark.parametrize(("root", "height"), [("300 92 -400", 92.0), ("300 -3 -400", 92.0)])
def test_position_channels_of_the_root(write, root, height):
    text = SMALL.replace("OFFSET 0 0 0", "OFFSET 0 95 0", 1)
    text = text[: text.index("1 2 3")].replace("Frames: 2", "Frames: 1") + f"{root} 0 0 0 0\n"
    np.testing.assert_allclose(read_bvh(write(text), unit=1.0).positions[0, 0], [300, height, -400])


def test_several_end_sites_have_names_of_their_own(write):
    end = "\t\tEnd Site\n\t\t{\n\t\t\tOFFSET 0 -50 0\n\t\t}\n"
    motion = read_bvh(write(SMALL.replace(end, end + end)), unit=1.0)
    assert motion.names == ("hips", "left knee", "left knee_end", "left knee_end2")


@pytest.mark.parametrize(
    ("frame_time", "rate"),
    [
        ("0.0333667", 30 / 1.001),
        (".0083333", 120.0),
        ("0.016667", 60.0),
        ("0.04", 25.0),
        ("0.0123456789", 81.000000737),
        ("1e-2", 100.0),
    ],
)
def test_rates_are_exact(write, frame_time, rate):
    motion = read_bvh(write(SMALL.replace("0.008333", frame_time)), unit=1.0)
    assert motion.rate == pytest.approx(rate, rel=1e-12 if frame_time != "0.0123456789" else 1e-9)


@pytest.mark.parametrize(
    ("height", "unit"),
    [(90, None), (170, 0.01), (67, 0.0254), (30, 0.0254 / 0.45), (1800, 0.001), (1.75, 1.0), (8, None)],
)
def test_unit_is_the_most_human(write, height, unit):
    text = SMALL.replace("0 -40 0", f"0 {-height / 3} 0").replace("0 -50 0", f"0 {-2 * height / 3} 0")
    if unit is None:
        with pytest.raises(FileError, match="no known unit"):
            read_bvh(write(text))
    else:
        motion = read_bvh(write(text))
        np.testing.assert_allclose(-motion.offsets[:, 1].sum(), height * unit)
        assert motion.source.endswith(f"a.bvh (unit {unit:.6g} m)")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("1 2 3 90 0 0 90\n", "", "line 19: 1 frames, but the file announces 2.*Frames: 1"),
        ("1 2 3 90 0 0 90", "1 2 3 90", "line 20: 4 values for 7 channels"),
        ("1 2 3 90 0 0 90", "1 2 3 nan 0 0 90", "line 20: holds a value that is not finite"),
        ("1 2 3 90 0 0 90", "1 2 3 1,5 0 0 90", "line 20: '1,5' is not a number"),
        ("0.008333", "0", "line 18: the frame time is not positive"),
        ("0.008333", "fast", "line 18: 'fast' is not a number"),
        ("Frames: 2", "Frames: two", "line 17: the line 'Frames:"),
        ("Frame Time: 0.008333\n", "", "line 18: the line 'Frame Time:"),
        ("OFFSET 0 -40 0", "OFFSET 0 -40 inf", "line 8: holds a value that is not finite"),
        ("OFFSET 0 -40 0", "OFFSET 0 -40", "line 8: 'CHANNELS' is not a number"),
        ("CHANNELS 1 Xrotation", "CHANNELS 2 Xrotation", "line 9: CHANNELS 2 xrotation end"),
        ("CHANNELS 1 Xrotation", "CHANNELS 1 Wrotation", "line 9: CHANNELS 1 wrotation"),
        ("left knee", "hips", "line 6: the joint name 'hips' is missing or already used"),
        ("JOINT left", "ROOT left", "line 6: ROOT left knee is not allowed here"),
        ("MOTION", "", "unexpected|MOTION"),
        ("HIERARCHY", "<html>", "line 1: does not begin with HIERARCHY"),
    ],
)
def test_bad_files(write, old, new, message):
    assert old in SMALL
    with pytest.raises(FileError, match=message) as caught:
        read_bvh(write(SMALL.replace(old, new, 1)))
    assert caught.value.file is not None and caught.value.remedy


@given(length=st.integers(0, len(SMALL.rstrip()) - 14))
def test_a_file_cut_anywhere_is_refused(tmp_path_factory, length):
    path = tmp_path_factory.mktemp("bvh") / "cut.bvh"
    path.write_text(SMALL[:length])
    with pytest.raises(FileError):
        read_bvh(path, unit=1.0)


def test_missing_and_binary_files(tmp_path, write):
    with pytest.raises(FileError, match="cannot read the"):
        read_bvh(tmp_path / "none.bvh")
    with pytest.raises(FileError, match="binary"):
        read_bvh(write(b"HIERARCHY\0\0"))
    with pytest.raises(FileError, match="not a length"):
        read_bvh(write(SMALL), unit=-1.0)
    with pytest.raises(FileError, match="no vertical axis 'w'"):
        read_bvh(write(SMALL), unit=1.0, up="w")


@pytest.mark.parametrize("name", REAL)
def test_real_files(data_dir, name):
    folder, file = name.split("/")
    motion = read_bvh(data_dir(folder) / file)
    frames, rate, joints, up, unit = REAL[name]
    assert (len(motion), len(motion.names), motion.up) == (frames, joints, up)
    assert motion.rate == pytest.approx(rate, rel=1e-12)
    assert motion.source.endswith(f"(unit {unit:.6g} m)")
    assert np.isfinite(motion.Ts_world_joint).all()
    child = np.flatnonzero(motion.parents >= 0)
    bones = np.linalg.norm(motion.positions[:, child] - motion.positions[:, motion.parents[child]], axis=-1)
    np.testing.assert_allclose(
        bones, np.broadcast_to(np.linalg.norm(motion.offsets[child], axis=1), bones.shape), atol=1e-9
    )
    R = motion.Ts_world_joint[..., :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
    height = motion.positions[..., "xyz".index(up)]
    assert -0.05 < height.min() < 0.1  # stands on the floor
    assert 0.9 < np.median(np.ptp(height, axis=1)) < 1.9
