"""The protocol of a sensor carries what nobody has built yet: seven fakes, and what bad ones are told."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fitting.tracking.movements import BODY, RATE, STILL, a_motion, a_rig, is_finite, marker_frame, turned
from tests.sensors.fakes import (
    AWAY,
    DELAY,
    FAKES,
    HELD,
    LENGTH,
    OFFSET,
    POST,
    ROPE,
    Beacons,
    Clock,
    Level,
    Seen,
    Strut,
    Told,
    one,
    other_wrist,
    steps,
    truth,
    value,
)

from kinefit.errors import ObservationError
from kinefit.fitting.subject.fit import fit_subject
from kinefit.fitting.subject.parameters import SegmentScales
from kinefit.fitting.subject.subject import OwnUnknowns
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.fitting.tracking.video import track
from kinefit.sensors.base import RowsOf, Sensor
from kinefit.sensors.settings import TrackSettings
from kinefit.solving.correspondences import point_rows
from kinefit.solving.rows import PairRows, Rows

SIGMA = {"mocap": 0.004}
KNOWN = {"strut": {"length": LENGTH}, "rope": {"length": ROPE}, "clock": {"delay": DELAY}}
FOUND = {"strut": ("length", LENGTH, 0.004), "rope": ("length", ROPE, 0.006), "clock": ("delay", DELAY, 0.004)}
COUNT = {"pixel": 4}  # steps of a take with depth, which takes long
WRIST = {"strut": "l_wrist", "pixel": "l_wrist"}


def a_tracker(*sensors, values=None, start=None):
    values = {s.name: KNOWN[s.name] for s in sensors if s.name in KNOWN} if values is None else values
    tracker = Tracker(BODY, a_rig(), rate=RATE, settings=STILL, sigma=SIGMA, sensors=sensors, values=values, up="y")
    tracker.start_at(a_motion().state(0) if start is None else start)
    return tracker


def off(state, i, name):
    return float(np.linalg.norm(BODY.positions(state, one(name))[0] - truth(i, name)))


def followed(name, own=True, count=24):
    """Errors [m] of the wrist that a fake tells of, where markers do not."""
    tracker = a_tracker(*([FAKES[name]()] if own else []))
    results = [tracker.update([f for f in several if own or f.sensor != name]) for several in steps(name)[:count]]
    assert all(is_finite(r) for r in results)
    wrist = WRIST.get(name, "r_wrist")
    return tracker, results, np.array([off(r.state, i, wrist) for i, r in enumerate(results)])


# In the tracker


@pytest.mark.parametrize("name", ["rope", "clock", "beacons", "unnamed"])
def test_a_fake_tells_where_a_hand_is_that_no_marker_shows(name):
    (_, results, error), (_, _, without) = followed(name), followed(name, own=False)
    assert error[12:].mean() < (0.8 if name == "rope" else 0.2) * without[12:].mean()  # a rope holds one direction
    assert any(m.sensor == name for m in results[-1].matched)


def test_a_closure_holds_two_points_of_the_body_together():
    wrong = turned(a_motion().state(0), arm_add_l=-15, elbow_flex_l=10)
    apart = lambda state: np.linalg.norm(np.subtract(*BODY.positions(state, BODY.landmarks.select(Strut.ends))))
    few = marker_frame(0, tuple(n for n in HELD if n != "l_elbow"))
    held = a_tracker(Strut(), start=wrong).update([few, Seen("strut", 0.0)])
    alone = a_tracker(start=wrong).update([few])
    assert abs(apart(alone.state) - LENGTH) > 0.03 and abs(apart(held.state) - LENGTH) < 0.003
    forearm = BODY.tree.segment("forearm_l")
    assert alone.hidden[forearm] and not held.hidden[forearm] and held.segment_quality[forearm] == 1.0


@pytest.mark.parametrize("slack, same", [(0.1, True), (-0.1, False)])
def test_a_rope_pulls_and_never_pushes(slack, same):
    markers = marker_frame(0, HELD)
    paid = float(np.linalg.norm(POST - truth(0, "r_wrist"))) - ROPE + slack, False
    held = a_tracker(FAKES["rope"]()).update([markers, Seen("rope", 0.0, paid)])
    alone = a_tracker().update([markers])
    gone = BODY.positions(held.state, one("r_wrist"))[0] - BODY.positions(alone.state, one("r_wrist"))[0]
    assert np.linalg.norm(gone) < 1e-6 if same else gone @ (POST - truth(0, "r_wrist")) > 0.05


def test_a_clock_is_judged_where_the_body_was_then():
    """At 3 m/s a hand is 6 cm on after 20 ms."""
    _, results, _ = followed("clock")
    for r in results[3:]:
        scene = a_tracker().scene_of(r.state, r.time)
        (own,) = [m for m in r.matched if m.sensor == "clock"]
        assert len(own.leftovers(scene)) == 1
    assert np.mean([r.segment_quality[BODY.tree.segment("forearm_r")] for r in results[3:]]) > 0.9


def test_a_measurement_of_another_time_is_compared_with_the_body_then():
    late = 0.6 / RATE

    errors = []
    for told in (late, 0.0):
        tracker = a_tracker(Clock(), values={"clock": {"delay": 0.0}})
        for i in range(20):
            x = truth(max(i - 0.6, 0), "r_wrist")[None]
            frames = [marker_frame(i, HELD if i > 8 else (*HELD, "r_wrist")), Seen("clock", i / RATE - told, x)]
            result = tracker.update(frames, time=i / RATE)
        errors.append(off(result.state, 19, "r_wrist"))
    assert errors[0] < 0.5 * errors[1]


def test_another_body_keeps_its_own():
    """The second person's hand is nearer to where the first one's is thought to be, and is known to be another's."""
    state = turned(a_motion().state(0), arm_flex_r=0)
    x = np.array([truth(0, "r_wrist") + [0.2, 0, 0], truth(0, "r_wrist") + [0.05, 0, 0]])
    T = np.array(state.T_world_root)
    T[:3, 3] += [0.05, 0, 0]
    found = []
    for others in (False, True):
        tracker = a_tracker(Beacons(), start=state)
        second = [tracker.scene_of(replace(state, T_world_root=T))] if others else []
        result = tracker.update([marker_frame(0, HELD), Seen("beacons", 0.0, x)], others=second)
        found.append(len(result.matched[1].rows(tracker.scene_of(result.state))))
    assert found == [1, 0] or found[1] == 0 < found[0]


def test_two_people_each_keep_their_own_hand():
    first, second = a_tracker(Beacons()), a_tracker(Beacons())
    T = np.array(a_motion().state(0).T_world_root)
    T[:3, 3] += AWAY
    second.start_at(replace(a_motion().state(0), T_world_root=T))
    scenes = [t.scene_of(t.state) for t in (first, second)]
    for i in range(20):
        seen = Seen("beacons", i / RATE, value("beacons", i))
        here, there = marker_frame(i, HELD), marker_frame(max(i - 5, 0), HELD)
        there = replace(there, time=i / RATE, positions=there.positions + AWAY)
        results = [
            first.update([here, seen], others=[scenes[1]]),
            second.update([there, seen], others=[scenes[0]]),
        ]
        scenes = [t.scene_of(t.state, i / RATE) for t in (first, second)]
    assert off(results[0].state, 19, "r_wrist") < 0.03
    mine = BODY.positions(results[1].state, one("r_wrist"))[0]
    assert np.linalg.norm(mine - other_wrist(19)) < 0.03


def test_a_hand_behind_something_is_left_out_as_depth_tells():
    seen = steps("pixel")[0]
    with_depth = a_tracker(FAKES["pixel"]()).update(seen)
    (own,) = [m for m in with_depth.matched if m.sensor == "pixel"]
    assert len(own.rows(a_tracker().scene_of(with_depth.state))) == 0
    bare = a_tracker(FAKES["pixel"]()).update(seen[:2])
    (own,) = [m for m in bare.matched if m.sensor == "pixel"]
    assert len(own.rows(a_tracker().scene_of(bare.state))[0]) == 2


# What is learnt


def test_what_is_learnt_comes_of_accepted_steps():
    tracker, _, _ = followed("level", count=12)
    sensor = tracker.sensors.of("level")
    assert sensor.offset == pytest.approx(OFFSET, abs=0.02)
    assert sensor.learnt == [i / RATE for i in range(12)]


def test_a_step_that_fails_leaves_nothing_behind():
    """Whichever sensor fails, and whenever: the next step is as if it had never been."""

    class Bad(Level):
        name = "bad"

        def learn(self, measurement, scene, sure):
            raise ObservationError("the level is broken")

    for bad, extra in ((Bad(), Seen("bad", 0.1, 1.0)), (None, marker_frame(3, ("neck",), sensor="mocap"))):
        level = Level()
        tracker = a_tracker(level, *([bad] if bad else []))
        for several in steps("level")[:3]:
            tracker.update(several)
        before = tracker.state, level.offset, list(level.learnt), tracker.dropped
        extra = extra if bad else replace(extra, marker_set="no such set")
        with pytest.raises(Exception, match="broken|no such set"):
            tracker.update([*steps("level")[3], extra])
        np.testing.assert_array_equal(tracker.state.angles, before[0].angles)
        assert (level.offset, level.learnt, tracker.dropped) == before[1:]
        assert tracker.update(steps("level")[3]).time == 3 / RATE


# In whole takes


@pytest.fixture(scope="module")
def motions():
    """Each fake's take, smoothed and not, made when it is first asked for."""
    made = {}

    def of(name, smooth):
        if (name, smooth) not in made:
            sensor = FAKES[name]()
            recording = Recording.of_frames(
                steps(name)[: COUNT.get(name, 24)], a_rig(), rate=RATE, sigma=SIGMA, sensors=(sensor,), up="y",
                start=(0, a_motion().state(0)),
            )  # fmt: skip
            settings, size = TrackSettings(search=False, smooth_rounds=1), name != "pixel"
            made[name, smooth] = sensor, track(recording, BODY, smooth=smooth, settings=settings, size=size)
        return made[name, smooth]

    return of


@pytest.mark.parametrize("smooth", [True, False])
@pytest.mark.parametrize("name", FAKES)
def test_a_take_of_any_fake(name, smooth, motions):
    _, motion = motions(name, smooth)
    count = COUNT.get(name, 24)
    assert len(motion) == count and motion.provenance["estimate"] == ("smoothed" if smooth else "filtered")
    assert {name, "mocap"} <= set(motion.residuals)
    for values in (motion.dof_std, motion.joint_std):
        assert not np.isnan(values).any() and (values >= 0).all()
    wrist = WRIST.get(name, "r_wrist")
    at = [motion.body.positions(motion.state(i), motion.body.landmarks.select((wrist,)))[0] for i in range(count)]
    error = np.linalg.norm(np.array(at) - [truth(i, wrist) for i in range(count)], axis=1)
    assert error[:12].mean() < 0.02
    if name in ("clock", "beacons", "unnamed"):
        assert error[12:].mean() < 0.03
    own = motion.residuals[name]
    assert own.values.shape[0] == count and np.isfinite(own.values).any() == (name != "pixel")


@pytest.mark.parametrize("name", FOUND)
def test_a_take_finds_what_a_fake_does_not_know(name, motions):
    _, motion = motions(name, True)
    what, true, within = FOUND[name]
    mean, std = motion.provenance["shape"][f"{name} {what}"]
    assert mean == pytest.approx(true, abs=within) and 0.0 < std < 0.3 * FAKES[name]().unknowns[what].std


def test_a_take_leaves_its_sensors_as_they_were(motions):
    """Twice tracked, twice the same: what is learnt belongs to the run."""
    for smooth in (True, False):
        sensor, _ = motions("level", smooth)
        assert sensor.offset == 0.0 and sensor.learnt == []


@pytest.mark.parametrize("name", FAKES)
def test_a_subject_fit_takes_any_fake(name):
    sensor, count = FAKES[name](), 12
    tracker = a_tracker(sensor)
    results = [tracker.update(several) for several in steps(name)[:count]]
    used = range(3, 11)
    unknown = [OwnUnknowns.of([sensor]) if sensor.unknowns else SegmentScales(BODY)]
    speed = [RATE / 2 * results[i - 1].state.difference(results[i + 1].state) for i in used]
    measured = [[m.compact() for m in results[i].measurements] for i in used]
    states, times = [results[i].state for i in used], [results[i].time for i in used]
    found = fit_subject(BODY, a_rig(), measured, states, unknown, velocities=speed, times=times)
    assert len(found.states) == len(used) and np.isfinite(found.cost) and set(found.excess) >= {"mocap"}
    if name in FOUND:
        what, true, within = FOUND[name]
        assert found.value(f"{name} {what}")[0] == pytest.approx(true, abs=within)


# What bad sensors are told


def bad(make, prepare=None):
    """A sensor named "mine" whose match gives rows that a function of the scene makes."""

    class Mine(Sensor):
        name = "mine"

        def prepare(self, frame, scene):
            return Told("mine", frame.time, None, make) if prepare is None else prepare(frame)

    return Mine()


def rows(scene, residual=0.0, segment=0, count=1):
    n = np.tile([1.0, 0.0, 0.0], (count, 1))
    return Rows.of(np.full(count, segment), np.zeros((count, 3)), n, np.full(count, residual), np.ones(count))


NAN = np.full((1, 3), np.nan)
BAD = {
    "NaN rows": (lambda m, s, r: RowsOf(lambda scene: rows(scene, np.nan)), "not finite"),
    "a segment that is not there": (lambda m, s, r: RowsOf(lambda scene: rows(scene, segment=99)), "segment 99"),
    "a negative segment": (lambda m, s, r: RowsOf(lambda scene: rows(scene, segment=-1)), "segment -1"),
    "points of two numbers": (
        lambda m, s, r: RowsOf(
            lambda scene: Rows.of(np.zeros(1, int), np.zeros((1, 2)), np.zeros((1, 3)), np.zeros(1), np.ones(1))
        ),
        "shape",
    ),
    "fewer residuals than rows": (
        lambda m, s, r: RowsOf(
            lambda scene: Rows.of(np.zeros(3, int), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(2), np.ones(3))
        ),
        "shape",
    ),
    "data of seven lines": (
        lambda m, s, r: RowsOf(lambda scene: Rows(np.zeros((7, 1)), np.zeros(1, np.int64), np.zeros(1, np.int64))),
        "shape",
    ),
    "a group too few": (
        lambda m, s, r: RowsOf(lambda scene: Rows(np.zeros((8, 2)), np.zeros(2, np.int64), np.zeros(1, np.int64))),
        "shape",
    ),
    "a pair with NaN": (
        lambda m, s, r: RowsOf(
            lambda scene: PairRows(np.zeros((1, 2), int), NAN, NAN, NAN, np.zeros(1), np.ones(1))
        ),
        "not finite",
    ),
    "negative weights": (
        lambda m, s, r: RowsOf(
            lambda scene: Rows.of(np.zeros(1, int), np.zeros((1, 3)), np.eye(3)[:1], np.zeros(1), -np.ones(1))
        ),
        "negative",
    ),
    "a match that is no match": (lambda m, s, r: {"a": 1}, "is a dict"),
    "rows that are no rows": (lambda m, s, r: RowsOf(lambda scene: np.zeros(3)), "ndarray"),
    "nothing": (lambda m, s, r: RowsOf(lambda scene: None), "NoneType"),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_a_bad_sensor_is_told_by_name(what):
    match, problem = BAD[what]
    tracker = a_tracker(bad(match))
    with pytest.raises(ObservationError, match=f"'mine'.*{problem}|{problem}.*'mine'"):
        tracker.update([marker_frame(0, HELD), Seen("mine", 0.0)])
    assert tracker.update([marker_frame(0, HELD)]) is not None


@pytest.mark.parametrize("what", ["NaN rows", "a segment that is not there", "data of seven lines"])
def test_a_bad_sensor_is_told_by_name_in_a_subject_fit(what):
    m = Told("mine", 0.0, None, BAD[what][0])
    with pytest.raises(ObservationError, match="'mine'"):
        fit_subject(BODY, a_rig(), [[m]], [a_motion().state(0)], [OwnUnknowns.of([Strut()])])


@pytest.mark.parametrize("value", [None, 3, Seen("mine", 0.0), Told(None, 0.0, None, None), Told("mine", np.nan, 0, 0)])
def test_what_is_no_measurement_is_told(value):
    tracker = a_tracker(bad(None, lambda frame: value))
    with pytest.raises(ObservationError, match="mine|prepare"):
        tracker.update([marker_frame(0, HELD), Seen("mine", 0.0)])


def several(count, channels):
    """A match of so many points that agree with the body, its channels named."""
    points = BODY.landmarks.select(HELD[:count])
    return RowsOf(lambda s: s.along(points, (0.0, 1.0, 0.0), np.zeros(count), 0.01), channels=channels)


CHANNELS = {
    "numbers that change": (lambda i: several(1 + i % 2, None), "their number changes"),
    "other numbers": (
        lambda i: RowsOf(lambda s: s.along(one("neck"), (0.0, 1.0, 0.0), [0.0], 0.01, group=np.array([i]))),
        "their number changes",
    ),
    "a name too few": (lambda i: several(2, ["a"]), "names 1 channels, .* id 1"),
    "one name twice": (lambda i: several(2, ["a", "a"]), "two channels 'a'"),
    "numbers as names": (lambda i: several(2, [1, 2]), "are not text"),
    "a text as names": (lambda i: several(2, "ab"), "are not text"),
    "names at some times": (lambda i: several(2, ["a", "b"] if i % 2 else None), "in some measurements"),
    "new names at every time": (lambda i: several(2, [f"a{i}", f"b{i}"]), "new channel names at every time: a9, b9"),
}


@pytest.mark.parametrize("what", CHANNELS)
def test_a_sensor_that_does_not_keep_to_its_channels_is_told(what):
    match, problem = CHANNELS[what]
    tracker = a_tracker(bad(lambda m, scene, reach: match(round(m.time * RATE))))
    with pytest.raises(ObservationError, match=f"'mine'.*{problem}|{problem}.*'mine'"):
        for i in range(11):
            tracker.update([marker_frame(i, HELD), Seen("mine", i / RATE)])
    assert tracker.update([marker_frame(11, HELD)]) is not None


def test_channels_that_come_and_go_need_names():
    tracker = a_tracker(bad(lambda m, s, r: several(2 - round(m.time * RATE) % 3 % 2, ["neck", "hip"])))
    nothing = a_tracker(bad(lambda m, s, r: several(1, None) if m.time > 0.1 else RowsOf(lambda scene: [])))
    for i in range(12):
        for each in (tracker, nothing):
            assert each.update([marker_frame(i, HELD), Seen("mine", i / RATE)]) is not None


def test_two_measurements_of_one_name_and_time_are_told():
    frames = [marker_frame(0, HELD), *(Told("mine", 0.0, None, lambda m, s, r: several(1, None)) for _ in range(2))]
    with pytest.raises(ObservationError, match="two measurements of sensor 'mine' at 0 s"):
        a_tracker().update(frames)
    named = Told("mocap", 0.0, None, lambda m, s, r: several(1, ["neck"]))
    with pytest.raises(ObservationError, match="'mocap' at 0 s have a channel 'neck'.*its own"):
        a_tracker().update([marker_frame(0, HELD), named])
    numbered = Told("mocap", 0.0, None, lambda m, s, r: several(1, None))
    with pytest.raises(ObservationError, match="'mocap' names its channels in some measurements"):
        a_tracker().update([marker_frame(0, HELD), numbered])


def test_two_sensors_of_one_name_are_told():
    with pytest.raises(ObservationError, match="two sensors are named 'level'"):
        a_tracker(Level(), Level())


@pytest.mark.parametrize("name", [None, "", 3])
def test_a_sensor_without_a_name_is_told(name):
    sensor = Level()
    sensor.name = name
    with pytest.raises(ObservationError, match="Level"):
        a_tracker(sensor)


def test_values_of_no_sensor_are_told():
    with pytest.raises(ObservationError, match="rop"):
        a_tracker(Strut(), values={"rop": {"length": 1.0}})


def test_what_the_fakes_stand_on():
    """Rows of points are those that the tracker makes of its own markers."""
    assert len(point_rows(BODY, a_motion().state(0), one("neck"), np.zeros((1, 3)), sigma=0.01)) == 3
