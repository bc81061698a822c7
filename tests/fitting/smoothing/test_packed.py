"""Packed points of a take are the points of its frames."""

from dataclasses import replace

import numpy as np
from tests.fitting.tracking.movements import BODY, a_motion, a_rig, marker_frame

from kinefit.fitting.smoothing.packed import PackedMarkers
from kinefit.geometry.losses import SQUARED, geman_mcclure
from kinefit.sensors.base import leftovers_at, matched_by
from kinefit.sensors.points.markers import MarkerSensor
from kinefit.sensors.scene import Scene

LOSS = geman_mcclure()
SENSOR = MarkerSensor("mocap", 0.005, LOSS, 0.03, {"neck": 0.02})
SHOWN = [("l_wrist", "l_elbow", "neck"), ("neck", "r_hip"), (), ("l_wrist", "r_hip", "l_elbow")]
MOTION = a_motion()


def measurements():
    scene = Scene(BODY, MOTION.state(0), a_rig())
    return [[SENSOR.prepare(marker_frame(i, names), scene)] if names else [] for i, names in enumerate(SHOWN)]


def times():
    return np.array([m[0].time if m else 0.0 for m in measurements()])


def test_every_frame_has_its_markers_again():
    packed = PackedMarkers.of(BODY, measurements(), times(), LOSS)
    assert packed.points.names == ("l_wrist", "l_elbow", "neck", "r_hip") and packed.sensors == ("mocap",)
    for f, several in enumerate(measurements()):
        again = packed.measurements(f)
        assert len(again) == len(several)
        for a, b in zip(again, several, strict=True):
            order = [b.names.index(name) for name in a.names]
            assert set(a.names) == set(b.names) and a.time == b.time and a.of is SENSOR
            np.testing.assert_array_equal(a.x_world, b.x_world[order])
            np.testing.assert_allclose(a.weight, b.weight[order])
    part = packed.part(slice(1, 2))
    assert part.measurements(0)[0].names == ("neck", "r_hip")


def test_solvers_get_places_and_sigma_of_what_was_measured():
    packed = PackedMarkers.of(BODY, measurements(), times(), LOSS)
    x, sigma = packed.measured
    np.testing.assert_array_equal(np.isfinite(x).all(axis=2), packed.stated > 0.0)
    np.testing.assert_allclose(sigma, [0.005, 0.005, 0.02, 0.005])
    np.testing.assert_array_equal(packed.part(slice(2, 3)).measured[1], 1.0)  # nothing seen: any finite one


def test_residuals_factors_and_evidence_are_those_of_each_match():
    packed = PackedMarkers.of(BODY, measurements(), times(), LOSS)
    roots, angles = MOTION.Ts_world_root[:4], MOTION.angles[:4] + 0.05
    residuals = packed.residuals(BODY, roots, angles)["mocap"]
    evidence = packed.evidence(BODY, packed.gaps(BODY, roots, angles))
    for f in range(4):
        scene = Scene(BODY, MOTION.state(0), a_rig()).at(type(MOTION.state(0))(roots[f], angles[f]))
        seen = np.isfinite(residuals.values[f]).all(axis=1)
        assert seen.sum() == len(SHOWN[f])
        np.testing.assert_array_equal(residuals.weights[f][~seen], 0.0)
        for m in packed.matched(f, (), scene):
            (left,) = leftovers_at(m, scene)
            own = [residuals.names.index(name) for name in left.names]
            np.testing.assert_allclose(residuals.values[f, own], left.values, atol=1e-12)
            np.testing.assert_allclose(residuals.weights[f, own], left.weights, atol=1e-12)
            np.testing.assert_allclose(evidence.agreeing[f], m.evidence(scene).agreeing)
            np.testing.assert_allclose(evidence.contrary[f], m.evidence(scene).contrary)


def test_an_estimated_factor_weakens_the_markers_and_not_their_stated_weights():
    packed = PackedMarkers.of(BODY, measurements(), times(), LOSS)
    weaker = replace(packed, scale={"mocap": 2.0})
    np.testing.assert_allclose(weaker.weight, packed.weight / 4.0)
    np.testing.assert_array_equal(weaker.stated, packed.stated)


def test_markers_between_the_frames_or_with_another_loss_stay_rows():
    for none in (PackedMarkers.of(BODY, measurements(), times() + 0.004, LOSS),
                 PackedMarkers.of(BODY, measurements(), times(), SQUARED)):  # fmt: skip
        assert none.sensors == () and none.values.shape == (4, 0, 3) and none.measurements(0) == ()
    other = MarkerSensor("other", 0.005, LOSS, 0.03)
    scene = Scene(BODY, MOTION.state(0), a_rig())
    late = replace(marker_frame(0, ("r_hip",)), sensor="other", time=0.01)
    both = [[*measurements()[0], other.prepare(late, scene)], *measurements()[1:]]
    assert PackedMarkers.of(BODY, both, times(), LOSS).sensors == ("mocap",)
    assert matched_by(both[0][1], scene, 0.03).sensor == "other"
