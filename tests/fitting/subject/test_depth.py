"""The person's own size from a few depth images."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fitting.tracking.depth_oracle import ARMS, BODY, camera, depth_of, facing

from kinefit.bodies.surfaces import TaperedCylinder
from kinefit.bodies.surfaces.places import nearest
from kinefit.errors import BodyError, ObservationError
from kinefit.fitting.subject.surfaces import GIRTH_STD, fit_surfaces
from kinefit.sensors.surfaces.depth_view import view_of

CAMERA = camera()
POSES = (facing(**ARMS), facing(yaw=-0.4, arm_add_l=-80, elbow_flex_l=30, arm_flex_r=40, hip_flexion_r=20))


def thick(body, girth):
    def grown(s):
        assert isinstance(s, TaperedCylinder)
        return replace(s, radii=tuple((girth * a, girth * b) for a, b in s.radii))

    return replace(body, surfaces=tuple(grown(s) for s in body.surfaces))


def seen(body):
    depths = [depth_of(body, state, CAMERA, seed=k) for k, state in enumerate(POSES)]
    return [view_of(d, d > 0, CAMERA) for d in depths]


def off(seed):
    rng, sigma = np.random.default_rng(seed), np.repeat((0.02, 0.04, 0.05), (3, 3, len(BODY.tree.coordinates)))
    return [s.retract(sigma * rng.normal(size=len(sigma))) for s in POSES]


def away(body, clouds, states):
    """[m] median distance of the points from the surface."""
    found = [nearest(body, state, cloud, max_distance=0.15).distance for cloud, state in zip(clouds, states)]
    return np.median(np.abs(np.concatenate(found)))


def factor(fit, name):
    return np.exp(fit.value(name)[0])


@pytest.mark.parametrize(("size", "girth"), [(1.1, 1.15), (0.92, 0.9)])
def test_size_and_girth_come_out(size, girth):
    groups = len(BODY.scale_groups)
    person = thick(BODY.scaled(np.full(groups, size)), girth)
    views = seen(person)
    clouds = [v.cloud for v in views]
    fit = fit_surfaces(BODY, clouds, off(1), views=views)
    assert away(fit.body, clouds, fit.states) < 0.006
    length = np.abs(fit.mean[:groups] - np.log(size))
    assert np.mean(length) < 0.02
    assert length.max() < 0.04
    trunk = factor(fit, "girth trunk b") * factor(fit, "length trunk")
    assert abs(np.log(trunk / (size * girth))) < 0.06
    assert np.isclose(fit.body.stature, BODY.stature * size, rtol=0.03)


def test_the_right_body_stays_and_what_is_unseen_keeps_its_prior():
    half = [np.where(np.arange(240)[:, None] < 135, depth_of(BODY, s, CAMERA, seed=3), 0.0) for s in POSES]
    clouds = [view_of(d, d > 0, CAMERA).cloud for d in half]
    fit = fit_surfaces(BODY, clouds, POSES)
    assert max(abs(fit.value(f"length {name}")[0]) for name in ("trunk", "upperarm", "forearm")) < 0.04
    shank, upper = (fit.value(f"girth {name} b")[1] for name in ("shank", "upperarm"))
    assert 0.7 * GIRTH_STD < shank < 1.05 * GIRTH_STD
    assert upper < shank
    assert away(fit.body, clouds, fit.states) <= away(BODY, clouds, POSES) + 1e-4


def test_it_does_not_run_away_on_rubbish():
    rng = np.random.default_rng(0)
    clouds = [rng.uniform(-0.6, 0.6, (400, 3)) + (0.1, 1.0, -0.2) for _ in POSES]
    fit = fit_surfaces(BODY, clouds, POSES, camera=CAMERA)
    assert np.abs(fit.mean).max() < 0.9
    assert np.isfinite(fit.std).all()


def test_bad_input_is_told():
    cloud = seen(BODY)[0].cloud
    with pytest.raises(ObservationError, match="2 clouds but 1"):
        fit_surfaces(BODY, [cloud, cloud], POSES[:1])
    with pytest.raises(ObservationError, match="has no points"):
        fit_surfaces(BODY, [np.full((5, 3), np.nan)], POSES[:1])
    with pytest.raises(BodyError, match="surfaces"):
        fit_surfaces(replace(BODY, surfaces=()), [cloud], POSES[:1])
