"""What a tracker has learnt is kept by a checkpoint, of every kind of sensor; so is what every kind measures."""

import ast
import inspect
import textwrap
from dataclasses import replace

import numpy as np
import pytest
from tests.fitting.tracking.checkpoints.test_checkpoint import Killed, assert_same
from tests.fitting.tracking.movements import BODY, RATE, STILL, a_motion, a_rig, cloud_frame
from tests.fitting.tracking.test_contract import MIXES, SEEN, SIGMA
from tests.sensors import region_arm
from tests.sensors.surfaces import test_surface_points

from kinefit import Recording, track
from kinefit.fitting.frame.prediction import Prediction
from kinefit.fitting.smoothing.spool import CODEC
from kinefit.fitting.tracking import run as running
from kinefit.fitting.tracking.checkpoints.checkpoint import Checkpoint
from kinefit.fitting.tracking.recovery import Recovery
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.geometry.camera import Rig
from kinefit.observations import KeypointFrame
from kinefit.sensors.base import Matched, Measurement, Sensor
from kinefit.sensors.regions.regions import RegionSensor
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces.depth_view import Background
from kinefit.sensors.surfaces.surface_points import SurfacePointSensor


def subclasses(kind):
    """All classes of kinefit that derive from one and have no abstract method."""
    found = {c for one in kind.__subclasses__() for c in {one, *subclasses(one)}}
    return sorted((c for c in found if c.__module__.startswith("kinefit.")), key=str)


def arm_recording():
    """An arm in colours that is searched for, so that random numbers are drawn."""
    turns = np.sin(0.5 * np.arange(10))
    steps = [[region_arm.frame(region_arm.state(0.1 * t, 0.3, -0.8 + t), k / RATE, k)] for k, t in enumerate(turns)]
    start = (0, region_arm.state(0.0, 0.3, -0.8))
    return Recording.of_frames(steps, region_arm.RIG, rate=RATE, start=start), region_arm.arm(), TrackSettings()


def skin_recording():
    """Tracked points of a surface, which are anchored one limb after the other."""
    body, state = test_surface_points.BODY, test_surface_points.posture(test_surface_points.BODY, 0)
    rng = np.random.default_rng(0)
    steps = [[test_surface_points.frame(state, k / RATE, rng, sigma=1e-4 * (1 + k % 3))] for k in range(10)]
    sensors = (SurfacePointSensor("skin", slide=0.01),)
    return Recording.of_frames(steps, Rig(()), rate=RATE, sensors=sensors, start=(0, state)), body, STILL


def mixed_recording():
    """All other kinds; a frame is dropped, and another comes between two."""
    names = [name for name in MIXES["everything"] if name != "rope"]
    times = np.array([0, 1, 2, 3, 5, 5.5, 6, 7, 8, 9]) / RATE
    steps = [[*(SEEN[name](i) for name in names), cloud_frame(i)] for i in range(10)]
    steps = [[replace(frame, time=t) for frame in seen] for t, seen in zip(times, steps)]
    sigma = {n: SIGMA[n] for n in names if n in SIGMA}
    start = (0, a_motion().state(0))
    return Recording.of_frames(steps, a_rig(), rate=RATE, sigma=sigma, up="y", start=start), BODY, STILL


def colour_recording():
    """Keypoints of a network, and a face and a hand by their colour in one of the cameras."""
    given, body, settings = mixed_recording()

    def steps(i):
        points = body.landmarks.select(("nose_tip", "r_wrist"))
        uv = given.rig["left"].project(body.positions(a_motion().state(i), points))
        seen = KeypointFrame("left", float(given.times[i]), points.names, uv, np.full(2, 0.8))
        return [*given.steps(i), seen]

    return replace(given, steps=steps), body, settings


@pytest.mark.parametrize("make", [mixed_recording, arm_recording, skin_recording, colour_recording])
def test_what_every_sensor_has_learnt_is_kept(make, tmp_path, monkeypatch):
    monkeypatch.setattr(running, "_EVERY", 4)
    given, body, settings = make()
    settings = replace(settings, smooth_rounds=1)
    free = track(given, body, size=False, settings=settings)

    def tracked(stop):
        def progress(what, done, total):
            if what == "frames" and done == stop:
                raise Killed

        with Checkpoint(tmp_path / "unfinished", "key") as checkpoint:
            return track(given, body, size=False, settings=settings, checkpoint=checkpoint, progress=progress)

    for stop in (6, 9):
        with pytest.raises(Killed):
            tracked(stop)
    assert_same(tracked(None), free)


#: Attributes that belong to one step, to what a tracker is made of, or to a live session.
OF_A_STEP = {
    Tracker: {"body", "_fit", "_scene", "_recovery", "_prediction", "others", "_last"},
    Prediction: {"_halted", "_ahead", "_information"}, RegionSensor: {"_parts", "_starts"},
}  # fmt: skip


@pytest.mark.parametrize(
    "kind", [Tracker, Prediction, Recovery, Background, *subclasses(Sensor)]
)
def test_whatever_changes_while_a_tracker_tracks_is_part_of_its_state(kind):
    source = ast.parse(textwrap.dedent(inspect.getsource(kind)))
    methods = [f for f in ast.walk(source) if isinstance(f, ast.FunctionDef) and f.name != "__init__"]
    stored = [
        node for method in methods for node in ast.walk(method)
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)
    ]  # fmt: skip
    changed = {node.attr for node in stored if getattr(node.value, "id", "") == "self"}
    assert changed - OF_A_STEP.get(kind, set()) <= set(kind.state_attributes)


def test_what_every_sensor_measures_is_written():
    """What is not stays in memory, and a checkpoint refuses it."""
    of_a_fit = {"RowsOf", "_Contour", "_Receding"}  # a function; of a fit of one image
    kinds = {c for c in [*subclasses(Measurement), *subclasses(Matched)] if c.__name__ not in of_a_fit}
    assert kinds <= set(CODEC.classes)
