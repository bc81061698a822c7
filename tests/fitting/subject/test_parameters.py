"""Parameters apply as they say; lasting errors are told from fresh ones."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from tests.fitting.subject import measured
from tests.fitting.subject.measured import ARM, HUMANOID, RIG

from kinefit.bodies import BodyState, PointSet
from kinefit.errors import BodyError, CalibrationError, ObservationError
from kinefit.fitting.subject.fit import MatchedFrames, Worlds
from kinefit.fitting.subject.parameters import (
    KNOWN_SIZE_STD,
    UNKNOWN_SIZE_STD,
    PointOffsets,
    SegmentScales,
    World,
    excess,
    place_spread,
    stacked,
)
from kinefit.fitting.subject.subject import CameraExtrinsics, OwnUnknowns
from kinefit.geometry import se3
from kinefit.geometry.losses import geman_mcclure
from kinefit.sensors.base import RowsOf, Unknown
from kinefit.sensors.points.markers import MarkerMeasurement, MarkerSensor
from kinefit.solving.bundle.border_frames import differences
from kinefit.solving.correspondences import pixel_rows
from kinefit.solving.rows import ParameterRows, Rows


def test_lengths_follow_the_size():
    loose, known = SegmentScales(HUMANOID), SegmentScales(HUMANOID, size=1.1)
    covariance = np.linalg.inv(loose.information)
    assert np.allclose(np.diag(covariance), 0.05**2 + UNKNOWN_SIZE_STD**2)
    assert np.allclose(covariance[0, 1:], UNKNOWN_SIZE_STD**2)
    assert np.allclose(known.mean, np.log(1.1))
    assert np.linalg.inv(known.information)[0, 1] == pytest.approx(KNOWN_SIZE_STD**2)
    longer = known.apply(World(HUMANOID, RIG), known.mean).body
    assert np.allclose(longer.tree.offsets, 1.1 * HUMANOID.tree.offsets)
    with pytest.raises(BodyError, match="size"):
        SegmentScales(HUMANOID, size=-1.0)


def test_a_length_moves_the_segments_that_it_says():
    lengths, state, random = SegmentScales(HUMANOID), HUMANOID.default_state(np.eye(4)), np.random.default_rng(0)
    segments = np.arange(len(HUMANOID.tree.segments))
    points = PointSet(HUMANOID.tree.segments, segments, random.normal(scale=0.1, size=(len(segments), 3)))
    for k, touched in enumerate(lengths.touches):
        body = lengths.apply(World(HUMANOID, RIG), 0.1 * (np.arange(len(lengths.names)) == k)).body
        own = replace(points, points=points.points * np.where(body.segment_scale == k, np.exp(0.1), 1.0)[:, None])
        moved = np.linalg.norm(body.positions(state, own) - HUMANOID.positions(state, points), axis=1)
        assert set(np.flatnonzero(moved > 1e-9)) == touched


def test_derivatives_of_markers_are_those_of_their_rows():
    """How points move tells the same as rows of other worlds."""
    body, states = ARM.scaled(np.full(len(ARM.scale_groups), 1.05)), measured.arms(3)
    sensor, names = MarkerSensor("worn", 0.002, geman_mcclure(), 0.03), ARM.markers("worn").names
    steps = []
    for k, state in enumerate(states):
        seen = names[k:]
        x = body.positions(state, body.markers("worn").select(seen))
        steps.append([MarkerMeasurement(sensor, seen, x, "worn", 0.0)])
    parameters = [SegmentScales(ARM), PointOffsets(ARM, "worn")]
    _, theta, _, step = stacked(parameters)
    frames = MatchedFrames(Worlds(World(ARM, RIG), parameters), steps, None, None, theta, states, 0.03)
    quick = differences(frames, theta, step, states)
    assert not any(np.isnan(D).any() for D in frames.columns(theta, step, states))
    frames.columns = None
    for a, b in zip(quick, differences(frames, theta, step, states), strict=True):
        assert np.abs(b).max() > 1.0
        assert np.allclose(a, b, rtol=1e-6, atol=1e-6 * np.abs(b).max())


def test_keypoints_shift_alike_left_and_right_and_hardly_to_the_side_in_the_middle():
    offsets = PointOffsets(HUMANOID, "BODY_25B")
    values = np.random.default_rng(0).normal(size=len(offsets.names))
    moved = offsets.apply(World(HUMANOID, RIG), values).body.keypoints("BODY_25B")
    shift = moved.points - HUMANOID.keypoints("BODY_25B").points
    right, left = (shift[moved.index(name)] for name in ("RKnee", "LKnee"))
    assert np.allclose(right, left * (1.0, 1.0, -1.0))
    assert np.abs(right).min() > 0.0
    std = dict(zip(offsets.names, np.diag(offsets.information) ** -0.5, strict=True))
    assert std["BODY_25B Nose z"] == pytest.approx(0.002)
    assert std["BODY_25B Nose x"] == pytest.approx(0.01)
    single = PointOffsets(HUMANOID, "BODY_25B", mirror=False)
    assert len(single.names) == 3 * 25 > len(offsets.names)


def test_markers_shift_one_by_one():
    count = len(ARM.markers("worn"))
    offsets = PointOffsets(ARM, "worn", np.linspace(0.005, 0.03, count))
    values = np.arange(3.0 * count)
    body = offsets.apply(World(ARM, RIG), values).body
    assert np.allclose(body.markers("worn").points - ARM.markers("worn").points, values.reshape(-1, 3))
    assert np.array_equal(body.landmarks.points, ARM.landmarks.points)
    assert np.diag(offsets.information)[[0, -1]] == pytest.approx([0.005**-2, 0.03**-2])
    with pytest.raises(BodyError, match="no point set .* 'foot'; there are: .*worn"):
        PointOffsets(ARM, "foot")
    with pytest.raises(BodyError, match="does not fit the"):
        PointOffsets(ARM, "worn", np.ones(3))


def test_cameras_move_but_the_one_that_is_held():
    free = CameraExtrinsics(RIG, RIG.names[1])
    assert len(free.names) == 6 * (len(RIG) - 1)
    values = np.zeros(len(free.names))
    values[6:12] = (0.1, 0.0, 0.0, 0.0, 0.0, 0.2)  # of the second that is free: the rig's third
    rig = free.apply(World(ARM, RIG), values).rig
    for k in (0, 1, 3):
        assert np.allclose(rig.cameras[k].T_camera_world, RIG.cameras[k].T_camera_world)
    expected = se3.exp(values[6:12]) @ RIG.cameras[2].T_camera_world
    assert np.allclose(rig.cameras[2].T_camera_world, expected)
    with pytest.raises(CalibrationError, match="no camera 'roof'"):
        CameraExtrinsics(RIG, "roof")


def test_a_common_motion_of_cameras_is_held_where_the_world_is_their_own():
    of = partial(CameraExtrinsics, RIG, None, (0.02, 0.01))
    single, own = of().information, of(own_world=True).information
    common = np.concatenate([se3.adjoint(camera.T_camera_world) for camera in RIG])
    for motion in common.T:
        assert motion @ own @ motion > 1e3 * motion @ single @ motion
    others = np.random.default_rng(0).normal(size=(len(single), 5))
    others -= common @ np.linalg.lstsq(np.sqrt(single) @ common, np.sqrt(single) @ others, rcond=None)[0]
    np.testing.assert_allclose(own @ others, single @ others, atol=1e-5 * np.abs(single).max())


def test_points_move_with_the_cameras_that_see_them_as_differences_say():
    cameras = CameraExtrinsics(RIG, None, cameras=RIG.names[1:3])
    assert cameras.free == RIG.names[1:3]
    state = BodyState(np.eye(4), ARM.tree.usual)
    points, camera = ARM.markers("worn"), np.arange(len(ARM.markers("worn"))) % len(RIG)
    uv = np.zeros((len(points), 2))

    def rows(values):
        return pixel_rows(ARM, state, points, cameras.apply(World(ARM, RIG), values).rig, camera, uv, sigma=2.0)

    here = rows(cameras.mean)
    told = cameras.columns(here, RIG, camera[here.group])
    for k in range(12):
        step = 1e-5 * np.eye(12)[k]
        ends = [np.sqrt(r.weight) * r.residual for r in (rows(step), rows(-step))]
        np.testing.assert_allclose(told[:, k], (ends[1] - ends[0]) / 2e-5, rtol=1e-3, atol=1e-3 * np.abs(told).max())
    twist = np.linspace(-0.01, 0.02, 12)
    np.testing.assert_allclose(cameras.values_of(cameras.apply(World(ARM, RIG), twist).rig), twist, atol=1e-12)
    assert not cameras.columns(here, RIG, np.zeros(0, int)).any()


def test_what_a_sensor_does_not_know_of_itself_goes_into_the_world_beside_what_it_does():
    own = OwnUnknowns({"rope": {"length": Unknown(1.0, 0.3)}, "watch": {"delay": Unknown(0.0, 0.01)}})
    world = own.apply(World(ARM, RIG, {"rope": {"stiffness": 5.0}}), np.array([1.2, 0.004]))
    assert world.values == {"rope": {"stiffness": 5.0, "length": 1.2}, "watch": {"delay": 0.004}}
    assert own.names == ("rope length", "watch delay")
    assert np.allclose(own.step, [3e-4, 1e-5])
    with pytest.raises(ObservationError, match="'length' of sensor 'rope'"):
        OwnUnknowns({"rope": {"length": Unknown(1.0, 0.0)}})


def test_kinds_of_parameters_stand_beside_each_other():
    kinds = [SegmentScales(ARM), OwnUnknowns({"rope": {"length": Unknown(1.0, 0.5)}})]
    names, mean, information, step = stacked(kinds)
    assert names[-1] == "rope length"
    assert mean.tolist() == [0.0, 0.0, 0.0, 1.0]
    assert np.array_equal(information[:3, :3], kinds[0].information)
    assert information[3].tolist() == [0.0, 0.0, 0.0, 4.0]
    assert step[3] == 5e-4


def rows(residual, segment=None, group=None):
    count = len(residual)
    segment = np.zeros(count, np.int64) if segment is None else segment
    return Rows.of(segment, np.zeros((count, 3)), np.tile([1.0, 0, 0], (count, 1)), residual, np.ones(count), group)


def seen(sensor, parts, surface=False, channels=None):
    matched = RowsOf(None, channels=channels)
    object.__setattr__(matched, "sensor", sensor)
    object.__setattr__(matched, "of_points", not surface)
    return matched, parts


def test_errors_that_last_are_told_from_fresh_ones():
    random = np.random.default_rng(0)
    fresh = [[seen("a", [rows(random.normal(size=200))])] for _ in range(25)]
    assert excess(fresh, 0.0)["a"] < 1.3
    bias = random.normal(size=200)
    half = [[seen("a", [rows(0.7 * bias + 0.7 * random.normal(size=200))])] for _ in range(25)]
    assert excess(half, 0.0)["a"] == pytest.approx(0.5 * 25, rel=0.2)
    assert excess(half, 100.0)["a"] == pytest.approx(2.0 * excess(half, 0.0)["a"], rel=0.05)  # half of them followed
    assert excess([[seen("a", [rows(3.0 * random.normal(size=200))])] for _ in range(25)], 0.0)["a"] > 7.0


def test_markers_that_come_and_go_are_known_by_their_names():
    random, names = np.random.default_rng(1), np.array([f"m{k}" for k in range(60)])
    bias, frames = random.normal(size=60), []
    for _ in range(20):
        on = np.flatnonzero(random.random(60) < 0.5)
        frames.append([seen("mocap", [rows(bias[on])], channels=names[on].tolist())])
    assert excess(frames, 0.0)["mocap"] == pytest.approx(10.0, rel=0.4)
    with pytest.raises(ObservationError, match="'mocap' have no names.*RowsOf"):
        excess([[seen("mocap", one[0][1])] for one in frames], 0.0)


def test_errors_of_a_surface_last_over_a_segment():
    random, segment = np.random.default_rng(2), np.repeat(np.arange(10), 30)
    bias = random.normal(size=10)[segment]
    frames = [[seen("depth", [rows(0.5 * bias + 0.8 * random.normal(size=300),
                                   segment, random.permutation(100000)[:300])], surface=True)]
              for _ in range(10)]  # fmt: skip
    assert excess(frames, 0.0)["depth"] > 30.0
    names = [str(g) for g in range(100000)]
    points = [[seen("depth", one[0][1], channels=names)] for one in frames]
    assert excess(points, 0.0)["depth"] < 2.0


def test_each_segment_of_a_surface_counts_with_its_own_bias():
    """A trunk of many rows that fits well does not have the bias of small parts that do not."""
    random, count = np.random.default_rng(4), np.array([300] + 9 * [10])
    segment, bias = np.repeat(np.arange(10), count), np.array([0.15] + 9 * [0.5])
    frames = [[seen("depth", [rows(bias[segment] + 0.4 * random.normal(size=len(segment)), segment)], surface=True)]
              for _ in range(10)]  # fmt: skip
    expected = 0.4**2 + 10.0 * (bias**2 * count**2).sum() / count.sum()
    assert excess(frames, 0.0)["depth"] == pytest.approx(expected, rel=0.3)
    frames[3] = [seen("depth", [rows(np.where(segment == 0, 8.0, bias[segment]), segment)], surface=True)]
    assert excess(frames, 0.0)["depth"] == pytest.approx(expected, rel=0.3)  # once behind something else


def test_a_few_rows_tell_nothing_of_their_errors():
    frames = [[seen("rope", [ParameterRows(np.zeros(1, int), np.full(1, 5.0), np.ones(1))])] for _ in range(5)]
    assert excess(frames, 0.0) == {}


@pytest.mark.parametrize("true", [0.003, 0.008, 0.03])
def test_the_spread_of_places_is_that_of_the_truth(true):
    random, noise, spread = np.random.default_rng(4), 0.002, 0.01
    measured_at = random.normal(0.0, true, 400) + random.normal(0.0, noise, 400)
    for _ in range(50):
        share = spread**2 / (spread**2 + noise**2)
        spread = place_spread(share * measured_at, np.full(400, share * noise**2), spread, 0.01)
    assert spread == pytest.approx(true, rel=0.2)


def test_places_that_nothing_measures_spread_as_is_believed():
    assert place_spread(np.zeros(9), np.full(9, 0.02**2), 0.02, 0.01) == pytest.approx(0.01)
