"""Recorded motions on the humanoid."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.readers.skeletons.bvh_variants import along, any_frames, turned, write_variant

from kinefit.bodies import load_body
from kinefit.bodies.motion import Residuals, rotation_between_up
from kinefit.bodies.toml.joint_names import recorded_joints
from kinefit.errors import BodyError, ObservationError
from kinefit.findings import of_provenance
from kinefit.geometry import se3
from kinefit.observations import SkeletonMotion
from kinefit.readers.skeletons.acclaim import read_amc
from kinefit.readers.skeletons.bvh import read_bvh
from kinefit.simulation import cut, resampled, retarget, squat_and_wave
from kinefit.simulation.skeletons import bone_directions

Z_UP, Y_DOWN = (Rotation.from_euler("x", angle, degrees=True).as_matrix() for angle in (90, 180))
BONES = {"thigh": "shank", "shank": "foot", "foot": "toes", "upperarm": "forearm", "forearm": "hand"}
RECORDINGS = [  # file, family, frames, largest median and 95th percentile of the error [deg]
    ("motion_cmu_bvh/cmu_12_01_walk.bvh", "MotionBuilder (CMU)", 262, 1.0, 3.0),
    ("motion_animateddrawings_bvh/jumping_jacks.bvh", "hip and knee (CMU)", 125, 1.0, 3.0),
    ("motion_animateddrawings_bvh/wave_hello.bvh", "AnimatedDrawings", 420, 1.0, 3.0),
    ("motion_cmu_bvh/002_01.bvh", "iClone", 171, 1.0, 3.0),
    ("motion_cmu_amc/02_01.amc", "Acclaim (CMU)", 172, 1.0, 3.0),
]


def read(data_dir, name):
    folder, file = name.split("/")
    path = data_dir(folder) / file
    return read_amc(path.with_name("02.asf"), path) if path.suffix == ".amc" else read_bvh(path)


def directions(motion):
    joints, tree = motion.segment_poses()[..., :3, 3], motion.body.tree
    out = {}
    for parent, child in BONES.items():
        for side in "lr":
            d = joints[:, tree.segment(f"{child}_{side}")] - joints[:, tree.segment(f"{parent}_{side}")]
            out[f"{parent}_{side}"] = d / np.linalg.norm(d, axis=1, keepdims=True)
    return out


@pytest.mark.parametrize(("name", "family", "frames", "median", "p95"), RECORDINGS)
def test_bones_point_where_the_recorded_ones_do(data_dir, name, family, frames, median, p95):
    skeleton = read(data_dir, name)
    rate = min(60.0, skeleton.rate)
    motion = retarget(skeleton, rate=rate)
    assert (recorded_joints(skeleton.names).family, len(motion), motion.rate, motion.up) == (family, frames, rate, "y")
    source = bone_directions(skeleton)
    source = source if rate == skeleton.rate else source.resampled(rate)
    errors = np.concatenate([
        np.degrees(np.arccos(np.clip(np.sum(d * source.bones[bone], axis=1), -1, 1)))
        for bone, d in directions(motion).items()
    ])
    assert np.median(errors) < median and np.percentile(errors, 95) < p95
    tree = motion.body.tree
    assert np.all((motion.angles >= tree.lower) & (motion.angles <= tree.upper))
    poses = motion.segment_poses()[1:, :, :3, :3]  # the first frame may be a T-pose
    turn = np.linalg.norm(poses[1:] - poses[:-1], axis=(-2, -1)) / np.sqrt(2)  # 2 sin(θ/2)
    assert np.percentile(turn[:, : tree.segment("clavicle_r")], 99) < 0.2  # [rad] a frame, trunk and head
    height = motion.positions(motion.body.landmarks.select(("skull_vertex", "r_heel", "l_heel")))[..., 1]
    assert np.median(height[:, 0] - height[:, 1:].min(axis=1)) > 1.3  # [m] upright


def test_walking_angles_are_those_of_walking(data_dir):
    motion = cut(retarget(read(data_dir, "motion_cmu_amc/02_01.amc"), rate=60.0), 1)
    span = {name: np.degrees(np.ptp(motion.angles[:, motion.body.tree.coordinate(name)]))
            for name in ("hip_flexion_r", "knee_angle_r", "ankle_angle_r", "lumbar_bending")}
    assert 25 < span["hip_flexion_r"] < 60 and 45 < span["knee_angle_r"] < 80 and 15 < span["ankle_angle_r"] < 55
    assert span["lumbar_bending"] < 25
    way = np.ptp(motion.Ts_world_root[:, :3, 3], axis=0)
    assert way[1] < 0.1 < 1.5 < np.hypot(way[0], way[2])


def as_skeleton(motion, up="y"):
    """The motion of a humanoid told as an Acclaim skeleton."""
    places = {
        "root": "sacroiliac", "upperback": "abdomen", "lowerneck": "head", "head": "head", "head_end": "skull_vertex",
        **{f"{s}{new}": f"{old}_{s}" for s in "lr" for new, old in {
            "femur": "thigh", "tibia": "shank", "foot": "foot", "toes": "toes", "humerus": "upperarm",
            "radius": "forearm", "wrist": "hand", "hand": "hand"}.items()},
        **{f"{s}fingers": f"{s}_metacarpal_phalanx_3" for s in "lr"}, **{f"{s}toes_end": f"{s}_digit_2" for s in "lr"},
    }
    body, poses = motion.body, motion.segment_poses()
    Ts = np.tile(np.eye(4), (len(motion), len(places), 1, 1))
    rest = np.zeros((len(places), 3))
    for j, (name, place) in enumerate(places.items()):
        place = "thorax" if name == "upperback" else place
        segment = body.tree.segments.index(place) if place in body.tree.segments else None
        if segment is None:
            k = body.landmarks.index(place)
            segment, point = body.landmarks.segments[k], body.landmarks.points[k]
        else:
            point = np.zeros(3)
        Ts[:, j] = poses[:, segment]
        Ts[:, j, :3, 3] += poses[:, segment, :3, :3] @ point
        if name in ("lhand", "rhand"):  # whose rest pose has the thumbs in front, not outside
            turn = np.array([0.0, np.pi / 2 if name == "lhand" else -np.pi / 2, 0.0])
            Ts[:, j, :3, :3] = Ts[:, j, :3, :3] @ se3.exp_so3(turn)
        rest[j] = body.tree.rest[segment] + point
    R = rotation_between_up("y", up)
    T = np.eye(4)
    T[:3, :3] = R
    Ts = T @ Ts
    Ts[..., :3, :3] = Ts[..., :3, :3] @ R.T
    parents = np.array([-1] + [0] * (len(places) - 1))
    offsets = rest @ R.T
    offsets[1:] -= offsets[0]
    return SkeletonMotion(tuple(places), parents, offsets, motion.rate, Ts, up=up)


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_motion_of_the_humanoid_itself_comes_back(up):
    truth = squat_and_wave(up="y")
    found = retarget(as_skeleton(truth, up))
    a, b = directions(truth), directions(found)
    for bone in a:
        np.testing.assert_allclose(b[bone], a[bone], atol=np.radians(1.0), err_msg=bone)
    shift = found.Ts_world_root[:, :3, 3] - truth.Ts_world_root[:, :3, 3]
    assert np.abs(shift).max() < 0.02
    errors = np.degrees(np.abs(found.angles - truth.angles))
    assert errors.mean() < 1.0 and errors.max() < 10.0


def test_the_legs_scale_the_way():
    truth = squat_and_wave(up="y")
    skeleton = as_skeleton(truth)
    Ts = np.array(skeleton.Ts_world_joint)
    Ts[..., :3, 3] *= 1.2
    found = retarget(replace(skeleton, Ts_world_joint=Ts, offsets=1.2 * skeleton.offsets))
    assert np.abs(found.Ts_world_root[:, :3, 3] - truth.Ts_world_root[:, :3, 3]).max() < 0.02


def test_unknown_skeletons_and_bodies_are_told():
    skeleton = as_skeleton(squat_and_wave(up="y"))
    names = tuple("knie" if name == "ltibia" else name for name in skeleton.names)
    with pytest.raises(ObservationError, match=r"for 'Acclaim \(CMU\)' it lacks: ltibia"):
        retarget(replace(skeleton, names=names))
    with pytest.raises(BodyError, match="humanoid"):
        retarget(skeleton, load_body("arm"))
    with pytest.raises(ObservationError, match="rate"):
        retarget(skeleton, rate=0.0)
    Ts = np.array(skeleton.Ts_world_joint)
    Ts[3, names.index("lfoot"), :3, 3] = Ts[3, names.index("knie"), :3, 3]
    with pytest.raises(ObservationError, match="'shank_l' has no length"):
        retarget(replace(skeleton, Ts_world_joint=Ts))


def test_cut_keeps_the_residuals_of_its_frames():
    motion = squat_and_wave()
    per_segment, segments = np.arange(len(motion) * 2.0).reshape(-1, 2), np.array([0, 1])
    residuals = Residuals(
        ("pelvis", "abdomen"), segments, per_segment[..., None], per_segment, "m", per_segment[..., None],
        np.zeros(len(motion), bool), rms=per_segment, count=per_segment,
    )
    kept = cut(replace(motion, residuals={"depth": residuals}), 3, 5).residuals["depth"]
    assert len(kept.norms) == 2 and not kept.of_points
    np.testing.assert_array_equal(kept.rms, per_segment[3:5])
    np.testing.assert_array_equal(kept.count, per_segment[3:5])


def test_cut_and_resampled():
    motion = squat_and_wave(rate=30.0)
    part = cut(motion, 10, 20)
    assert len(part) == 10 and part.times[0] == 0 and np.array_equal(part.angles, motion.angles[10:20])
    twice = resampled(motion, 60.0)
    assert len(twice) == 2 * len(motion) - 1
    np.testing.assert_allclose(twice.Ts_world_root[::2], motion.Ts_world_root, atol=1e-12)
    np.testing.assert_allclose(resampled(twice, 30.0).angles, motion.angles, atol=1e-12)
    fine = squat_and_wave(rate=60.0)
    assert np.abs(twice.Ts_world_root - fine.Ts_world_root[: len(twice)]).max() < 0.01
    with pytest.raises(ObservationError, match="rate"):
        resampled(motion, float("nan"))
    with pytest.raises(ObservationError, match="frames"):
        cut(motion, 60)


def some_frames(skeleton, count=6):
    """The first frame, often a T-pose, and some others."""
    rows = np.linspace(0, len(skeleton) - 1, count).astype(int)
    return replace(skeleton, Ts_world_joint=skeleton.Ts_world_joint[rows], rate=10.0)


@pytest.fixture(scope="module")
def walk(data_dir):
    """Six frames of a walk with a T-pose first, and their motion."""
    skeleton = some_frames(read(data_dir, "motion_cmu_bvh/cmu_12_01_walk.bvh"))
    return skeleton, retarget(skeleton)


def turn(motion, other):
    """[deg] largest difference of angles, of the neck's and of all others."""
    degrees = np.degrees(np.abs(motion.angles - other.angles)).max(axis=0)
    neck = np.array([name.startswith("neck") for name in motion.body.tree.coordinates])
    return degrees[neck].max(), degrees[~neck].max()


@pytest.mark.parametrize("degrees", [(90, 0, 0), (-90, 0, 0), (180, 0, 0), (0, 0, 90), (0, 70, 0), (30, 40, 20)])
def test_a_rest_pose_may_lie_in_any_way(walk, tmp_path, degrees):
    skeleton, motion = walk
    found = retarget(read_bvh(write_variant(skeleton, tmp_path / "a.bvh", turned(skeleton, *degrees))))
    assert max(turn(found, motion)) < 0.1 and not of_provenance(found.provenance)


@pytest.mark.parametrize(
    ("frames", "offsets"), [(any_frames, True), (any_frames, False), (along, True), (lambda s: along(s, 2), True)]
)
def test_joint_frames_and_the_rest_pose_do_not_matter(walk, tmp_path, frames, offsets):
    skeleton, motion = walk
    found = retarget(read_bvh(write_variant(skeleton, tmp_path / "a.bvh", frames(skeleton), offsets=offsets)))
    neck, others = turn(found, motion)
    assert others < 0.1 and neck < 2.0  # the head of the first frame is 1.7 degrees off that of the rest pose
    assert not of_provenance(found.provenance)


@pytest.mark.parametrize(
    ("name", "frames", "options"),
    [
        ("motion_cmu_bvh/cmu_12_01_walk.bvh", lambda s: along(s, 2), {"world": Z_UP}),
        ("motion_cmu_bvh/cmu_12_01_walk.bvh", lambda s: turned(s, 0, 0, 90), {"world": Y_DOWN}),
        ("motion_animateddrawings_bvh/wave_hello.bvh", lambda s: turned(s, 30, 40, 20), {"world": Z_UP}),
        ("motion_cmu_bvh/007_04.bvh", any_frames, {}),  # with eyes and fingers
    ],
)
def test_worlds_and_skeletons_do_not_matter(data_dir, tmp_path, name, frames, options):
    skeleton = some_frames(read(data_dir, name))
    right, other = (tmp_path / f"{name}.bvh" for name in ("right", "other"))
    motion = retarget(read_bvh(write_variant(skeleton, right, turned(skeleton, 0, 0, 0))))
    found = retarget(read_bvh(write_variant(skeleton, other, frames(skeleton), **options)))
    neck, others = turn(found, motion)
    assert others < 1.0 and neck < 2.0


def test_an_asf_may_lie_on_its_back(data_dir, tmp_path):
    """Axes and directions of the skeleton and the root's angles of the motion, all turned by the same."""
    place, back = data_dir("motion_cmu_amc"), Rotation.from_euler("x", 90, degrees=True)

    def of_axes(found):
        R = back * Rotation.from_euler("xyz", np.array(found[1].split(), float), degrees=True)
        return "axis " + " ".join(f"{v:.8f}" for v in R.as_euler("xyz", degrees=True)) + " XYZ"

    def of_root(found):
        values = np.array(found[1].split(), float)
        R = Rotation.from_euler("xyz", values[3:], degrees=True) * back.inv()
        return "root " + " ".join(f"{v:.8f}" for v in (*values[:3], *R.as_euler("xyz", degrees=True)))

    amc, asf = (place / "02_01.amc").read_text().partition("\n2\n")[0], (place / "02.asf").read_text()
    lying = re.sub(r"direction +(\S+ +\S+ +\S+)", lambda found: "direction " + " ".join(
        f"{v:.8f}" for v in back.apply(np.array(found[1].split(), float))), asf)  # fmt: skip
    motions = []
    for name, skeleton, frames in (
        ("right", asf, amc), ("lying", re.sub(r"axis +(\S+ +\S+ +\S+) +XYZ", of_axes, lying),
                              re.sub(r"root +(.*)", of_root, amc)),
    ):  # fmt: skip
        (tmp_path / f"{name}.asf").write_text(skeleton)
        (tmp_path / f"{name}.amc").write_text(frames + "\n")
        motions.append(read_amc(tmp_path / f"{name}.asf", tmp_path / f"{name}.amc"))
    np.testing.assert_allclose(motions[0].positions, motions[1].positions, atol=1e-5)
    assert max(turn(*map(retarget, motions))) < 1.0


def test_offsets_of_zero(walk, tmp_path):
    skeleton, motion = walk
    found = retarget(read_bvh(write_variant(skeleton, tmp_path / "a.bvh", turned(skeleton, 0, 0, 0), offsets=False)))
    assert max(turn(found, motion)) < 0.1


@pytest.mark.parametrize("case", ["bvh-rest-lying", "bvh-any-joint-frames", "bvh-bones-along-x", "bvh-zero-offsets"])
def test_one_walk_in_four_files(data_dir, case):
    cases = data_dir("cases_of_users")
    motion = retarget(read_bvh(cases / "bvh-rest-lying" / "walk_upright_rest.bvh"), rate=2.0)
    neck, others = turn(retarget(read_bvh(cases / case / "walk.bvh"), rate=2.0), motion)
    assert others < 0.1 and neck < 2.0


def test_a_zero_that_no_pose_gives_is_refused(data_dir, tmp_path):
    jacks = some_frames(read(data_dir, "motion_animateddrawings_bvh/jumping_jacks.bvh"))
    path = write_variant(jacks, tmp_path / "a.bvh", any_frames(jacks))
    with pytest.raises(ObservationError, match=r"the rest pose is no upright person.*T-pose"):
        retarget(read_bvh(path))
    path = write_variant(jacks, tmp_path / "b.bvh", turned(jacks, 0, 0, 0), rotations=False)
    with pytest.raises(ObservationError, match="does not rotate with its bone: the file has positions alone"):
        retarget(read_bvh(path))


@pytest.mark.parametrize("is_rest", [True, False])
def test_a_zero_from_a_person_who_stands_is_doubtful(data_dir, tmp_path, is_rest):
    wave = read(data_dir, "motion_animateddrawings_bvh/wave_hello.bvh")
    stance = replace(wave, Ts_world_joint=wave.Ts_world_joint[[0, 388]])
    frames = np.swapaxes(stance.Ts_world_joint[1, :, :3, :3], 1, 2) if is_rest else any_frames(stance)
    motion = retarget(read_bvh(write_variant(stance, tmp_path / "a.bvh", frames)))
    (found,) = of_provenance(motion.provenance)
    assert found.severity == "doubt" and ("rest pose. A person" if is_rest else "frame 2") in found.text
