"""Closed chains in the tracker, smoothed, a lag behind, with unknown gear: a leg on a pedal, seen by markers."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.sensors.fakes import Told
from tests.solving.test_closed import LEG

from kinefit.bodies import BodyState, load_body, parse_body
from kinefit.bodies.parts import with_dimensions
from kinefit.errors import BodyError
from kinefit.fitting.frame.fit import FrameFit
from kinefit.fitting.tracking.checkpoints.checkpoint import Checkpoint
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.fitting.tracking.video import track
from kinefit.geometry.camera import Rig
from kinefit.observations import MarkerFrame
from kinefit.sensors.base import RowsOf
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.solving.closed import onto
from kinefit.solving.correspondences import point_rows
from kinefit.solving.correspondences.closures import closed_at, closure_values, hard_equations, looped

RATE, NOISE = 50.0, 0.003
STILL = TrackSettings(search=False)
LENGTH = """
[[dimension]]
name = "crank length"
value = {value}
drawn = 0.15
mean = 0.15
std = 0.03
along = [0.0, 1.0, 0.0]
moves = ["pedal"]

[[closure]]
name = "rod"
kind = "line"
point = "joint"
at = {at}
axis = "z"
std = 1.0
"""


@cache
def body(mode="hard"):
    return parse_body(LEG if mode == "hard" else LEG.replace('mode = "hard"', "sigma = 0.001"))


@cache
def states(crank=0.15, count=60):
    """The pedal goes through its lowest point, a third of a turn."""
    leg = parse_body(LEG.replace("0.15", str(crank)))
    out, equations = [], hard_equations(leg)
    held = np.arange(9) == 8
    last = BodyState(np.eye(4), np.array([0.2, -1.5, 2.0]))
    for k in range(count):
        turned = BodyState(np.eye(4), [*last.angles[:2], 2.0 + 1.9 * k / count])
        last, off = onto(leg, turned, equations, locked=held)
        assert off < 1e-9
        out.append(last)
    return tuple(out)


def frames(hidden=range(0), crank=0.15, names=("joint", "foot", "pedal")):
    """Markers with noise; in hidden frames of the thigh's end alone."""
    leg = parse_body(LEG.replace("0.15", str(crank)))
    random = np.random.default_rng(3)
    out = []
    for k, state in enumerate(states(crank)):
        seen = ("joint",) if k in hidden else names
        x = leg.positions(state, leg.landmarks.select(seen)) + random.normal(scale=NOISE, size=(len(seen), 3))
        out.append([MarkerFrame("markers", k / RATE, seen, x, "")])
    return out


def tracker_of(leg):
    out = Tracker(leg, Rig(()), rate=RATE, sigma={"markers": NOISE}, settings=STILL, keep=True, up="y")
    out.start_at(states()[0])
    return out


def tracked(leg, hidden=range(0)):
    out = tracker_of(leg)
    return out, [out.update(seen) for seen in frames(hidden)]


def off(leg, motion):
    return max(float(np.abs(closure_values(leg, motion.state(f))).max()) for f in range(len(motion)))


def test_every_frame_is_closed_and_hidden_parts_follow():
    hidden = range(30, 40)
    told, results = tracked(body(), hidden)
    assert max(np.abs(closure_values(body(), r.state)).max() for r in results) < 1e-9
    open_leg = replace(body(), closures=())
    _, loose = tracked(open_leg, hidden)
    foot = body().landmarks.select(("foot",))
    true = np.array([body().positions(s, foot)[0] for s in states()])
    errors = [
        np.linalg.norm([body().positions(r.state, foot)[0] for r in found] - true, axis=1) for found in (results, loose)
    ]
    assert errors[0][list(hidden)].mean() < 0.03 < 0.5 * errors[1][list(hidden)].max()
    assert told.motion(smooth=False).dof_std.shape == (60, 9)


def test_error_bars_shrink():
    _, closed = tracked(body())
    _, loose = tracked(replace(body(), closures=()))
    bars = np.array([[r.dof_std[6:] for r in found] for found in (closed, loose)])
    told = np.isfinite(bars).all(axis=0) & (np.arange(60) >= 5)[:, None]
    shares = bars[0][told] / bars[1][told]
    assert told.mean() > 0.5 and shares.max() < 1.0 and shares.mean() < 0.75


@pytest.mark.parametrize("mode", ["hard", "soft"])
def test_smoothed_motions_are_closed(mode):
    told, _ = tracked(body(mode), range(30, 36))
    motion = told.motion()
    assert off(body(mode), motion) < (1e-9 if mode == "hard" else 3e-3)
    angles = np.array([s.angles for s in states()])
    assert np.abs(motion.angles - angles).max() < 0.08
    inside = np.abs(motion.angles - angles) < 3.0 * motion.dof_std[:, 6:]
    assert inside.mean() > 0.95


def test_what_comes_a_lag_later_is_closed():
    recording = Recording.of_frames(frames(), Rig(()), rate=RATE, sigma={"markers": NOISE}, start=(0, states()[0]))
    motion = track(recording, body(), size=False, settings=STILL, lag=0.1)
    assert off(body(), motion) < 1e-9 and motion.provenance["estimate"] == "fixed lag"


def test_a_run_with_checkpoints_keeps_chains_closed(tmp_path):
    recording = Recording.of_frames(frames(), Rig(()), rate=RATE, sigma={"markers": NOISE}, start=(0, states()[0]))
    with Checkpoint(tmp_path / "so-far", "key") as checkpoint:
        motion = track(recording, body(), size=False, settings=STILL, checkpoint=checkpoint)
    assert off(body(), motion) < 1e-9


def test_nearest_points_keep_chains_closed():
    points = body().landmarks.select(("joint", "foot"))
    x = body().positions(states()[9], points)
    rows = lambda scene: point_rows(scene.body, scene.state, points, x, sigma=NOISE)
    loose = Told("cloud", 0.0, None, lambda m, scene, reach: RowsOf(rows), settled=False)
    fit = FrameFit(body(), STILL).run(Scene(body(), states()[4], Rig(())), None, [loose])
    assert np.abs(closure_values(body(), fit.result.state)).max() < 1e-9
    np.testing.assert_allclose(fit.result.state.angles, states()[9].angles, atol=1e-3)


def test_gear_and_places_in_the_world_are_estimated():
    """The crank's length, and the rod through the knee, which is no rod but for what is estimated: it is soft."""
    text = LEG.replace('mode = "hard"', 'sigma = 0.002') + LENGTH.format(value='"estimate"', at="[0.0, 0.0, 0.0]")
    text = text.split('[[closure]]\nname = "rod"')[0]
    seen = frames(crank=0.165, names=("joint", "foot"))
    recording = Recording.of_frames(seen, Rig(()), rate=RATE, sigma={"markers": NOISE}, start=(0, states(0.165)[0]))
    motion = track(recording, parse_body(text), size=False, settings=STILL)
    value, std = motion.provenance["shape"]["gear crank length"]
    assert value == pytest.approx(0.165, abs=min(4.0 * std, 0.004)) and 1e-4 < std < 0.01
    assert motion.body.dimensions[0].value == pytest.approx(value, abs=1e-4) and motion.body.dimensions[0].std == 0.0


def test_a_place_in_the_world_is_estimated():
    """An axis through the hip that a file does not know."""
    text = LEG.replace('type = "fixed"', 'type = "free"') + (
        '[[closure]]\nname = "stand"\nkind = "rigid"\npoint = "hip"\nat = "estimate"\nmode = "hard"\n'
    )
    hip = '[landmarks]\nhip = { segment = "ground", at = [0.0, 0.0, 0.0] }\n'
    post = 'post = { segment = "ground", at = [0.0, 0.2, 0.3] }'
    standing = parse_body(text.replace("[landmarks]", hip + post))
    T = np.array([[0.0, 0.0, 1.0, 0.4], [0.0, 1.0, 0.0, 0.9], [-1.0, 0.0, 0.0, -0.3], [0.0, 0.0, 0.0, 1.0]])
    there = []
    for seen in frames():
        x = np.concatenate([seen[0].positions, [[0.0, 0.2, 0.3]]]) @ T[:3, :3].T + T[:3, 3]
        there.append([replace(seen[0], names=(*seen[0].names, "post"), positions=x)])
    start = BodyState(T, states()[0].angles)
    recording = Recording.of_frames(there, Rig(()), rate=RATE, sigma={"markers": NOISE}, start=(0, start))
    motion = track(recording, standing, size=False, settings=STILL)
    stand = motion.body.closures[1]
    np.testing.assert_allclose(stand.place, T[:3, 3], atol=0.02)
    assert np.abs(motion.Ts_world_root - motion.Ts_world_root[0]).max() < 1e-8 and off(motion.body, motion) < 1e-8


def test_unknown_gear_softens_what_waits_for_it():
    waiting = parse_body(LEG + LENGTH.format(value='"estimate"', at='"estimate"'))
    closed = closed_at(waiting, states()[0])
    assert closed.sigma[3:].min() > 0.99  # of the rod, whose place is anywhere
    assert 0.02 < closed.sigma[:3].max() < 0.04  # of the pedal, along the crank
    known = with_dimensions(body(), {})
    assert known is body() and closed_at(body(), states()[0]).hard.all()


def test_coordinates_of_a_closed_chain_are_known():
    assert looped(body()).all() and not looped(load_body("humanoid")).any()
    snowboarder = load_body("snowboarder")
    names = [n for n, on in zip(snowboarder.tree.coordinates, looped(snowboarder)) if on]
    assert {n.rsplit("_", 1)[0] for n in names} == {
        "hip_flexion", "hip_adduction", "hip_rotation", "knee_angle", "ankle_angle", "subtalar_angle"
    }  # fmt: skip


def test_contradictory_closures_are_told_before_tracking():
    with pytest.raises(BodyError, match="contradict each other.*'foot' by 700.0 mm"):
        Tracker(parse_body(LEG.replace("at = [0.0, 0.6, 0.0]", "at = [0.0, 1.6, 0.0]")), Rig(()), up="y")
