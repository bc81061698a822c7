"""Girths from silhouettes and size from depth, by the sensors as they are and the solver that knows neither."""

from dataclasses import replace

import numpy as np
import pytest
from tests.sensors.scenes import posture, ring

from kinefit.bodies import load_body
from kinefit.bodies.rendering import render_body
from kinefit.bodies.surfaces import TaperedCylinder
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.errors import BodyError
from kinefit.fitting.subject.fit import fit_subject
from kinefit.fitting.subject.parameters import SegmentScales, World
from kinefit.fitting.subject.surfaces import GIRTH_STD, CylinderShape, Girths
from kinefit.observations import SilhouetteFrame
from kinefit.sensors.regions.silhouette import SilhouetteSensor
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings

BODY = load_body("humanoid")
SHAPE = CylinderShape(BODY)


def shaped(**values):
    """Parameters of `SHAPE` by name, "_" for a blank."""
    out = np.zeros(len(SHAPE.names))
    for name, value in values.items():
        out[SHAPE.names.index(name.replace("_", " "))] = value
    return out


def test_cylinders_start_from_the_body_and_keep_both_sides_alike():
    world = World(BODY, ring())
    same = SHAPE.apply(world, np.zeros(len(SHAPE.names))).body
    for a, b in zip(same.surfaces, BODY.surfaces, strict=True):
        assert np.allclose(a.radii, b.radii)
        assert np.allclose(a.start, b.start)
    wide = SHAPE.apply(world, shaped(forearm_start_a=np.log(2.0), thigh_end_offset=0.01)).body
    for s, old in zip(wide.surfaces, BODY.surfaces, strict=True):
        name = BODY.tree.segments[s.segment]
        double = 2.0 if name.startswith("forearm") else 1.0
        assert s.radii[0][0] == pytest.approx(double * old.radii[0][0])
        assert s.radii[1] == pytest.approx(old.radii[1])
        shift = np.linalg.norm(np.subtract(s.end, old.end))
        assert shift == pytest.approx(0.01 if name.startswith("thigh") else 0.0, abs=1e-12)
    assert all(isinstance(s, TaperedCylinder) for s in wide.surfaces)
    with pytest.raises(BodyError, match="no cylinders"):
        CylinderShape(replace(BODY, surfaces=()))


def test_girths_go_with_the_lengths_that_they_are_of():
    girths = Girths(BODY)
    values = np.log([{"girth thigh a": 1.2, "girth thigh b": 0.8}.get(name, 1.0) for name in girths.names])
    wide = girths.apply(World(BODY, ring()), values).body
    for s, old in zip(wide.surfaces, BODY.surfaces, strict=True):
        thigh = BODY.scale_groups[BODY.segment_scale[s.segment]] == "thigh"
        assert np.allclose(s.radii, np.array(old.radii) * ((1.2, 0.8) if thigh else (1.0, 1.0)))
        assert np.allclose(s.end, old.end)
        touched = girths.touches[girths.names.index("girth thigh a")]
        assert (s.segment in touched) == thigh
    covariance = np.linalg.inv(girths.information)
    assert np.allclose(np.diag(covariance), GIRTH_STD**2)
    assert covariance[0, 1] == pytest.approx(0.5 * GIRTH_STD**2)
    with pytest.raises(BodyError, match="no cylinders"):
        Girths(replace(BODY, surfaces=()))


@pytest.mark.slow
def test_girths_come_from_silhouettes():
    rig = ring()
    values = shaped(thigh_start_a=0.2, thigh_start_b=0.2, thorax_end_b=0.15)
    real = SHAPE.apply(World(BODY, rig), values).body
    mesh = body_mesh(real)
    states = [posture(BODY, i) for i in (0, 8, 16)]
    steps = []
    for k, state in enumerate(states):
        scene = Scene(BODY, state, rig)
        frames = [SilhouetteFrame(c.name, k / 10, render_body(real, state, c, mesh=mesh).seen) for c in rig]
        steps.append([SilhouetteSensor(c, 1.0, TrackSettings()).prepare(f, scene) for c, f in zip(rig, frames)])
    subject = fit_subject(BODY, rig, steps, states, [SHAPE], rounds=3)
    k = [SHAPE.names.index(n) for n in ("thigh start a", "thigh start b", "thorax end b")]
    assert np.abs(subject.mean[k] - values[k]).max() < 0.07
    assert np.all(np.abs(subject.mean[k] - values[k]) < 3 * subject.std[k])
    assert np.all(subject.std[k] < 0.15)
    assert np.all(subject.std <= 1.0 / np.sqrt(np.diag(subject.prior.information)) + 1e-9)
    for one, state in zip(subject.states, states, strict=True):
        away = BODY.positions(one, BODY.landmarks) - BODY.positions(state, BODY.landmarks)
        assert np.median(np.linalg.norm(away, axis=1)) < 0.015


def test_a_size_comes_from_silhouettes():
    rig = ring()
    scales = SegmentScales(BODY)
    truth = np.full(len(scales.names), 0.06)
    real = scales.apply(World(BODY, rig), truth).body
    mesh = body_mesh(real)
    states = [posture(BODY, i) for i in (0, 16)]
    steps = []
    for k, state in enumerate(states):
        scene = Scene(BODY, state, rig)
        frames = [SilhouetteFrame(c.name, k / 10, render_body(real, state, c, mesh=mesh).seen) for c in rig]
        steps.append([SilhouetteSensor(c, 1.0, TrackSettings()).prepare(f, scene) for c, f in zip(rig, frames)])
    subject = fit_subject(BODY, rig, steps, states, [scales], rounds=4)
    assert subject.body.stature == pytest.approx(real.stature, rel=0.01)
    assert subject.body.stature > 1.045 * BODY.stature
