"""The person's own size from a few depth images."""

from dataclasses import replace

import numpy as np
import pytest
from tests.tracking.depth_oracle import ARMS, BODY, camera, depth_of, facing

from kinefit.bodies.surfaces import TaperedCylinder, nearest
from kinefit.errors import BodyError, ObservationError
from kinefit.sensors.depth_view import view_of
from kinefit.subject.depth import GIRTH, _pose_columns, fit_surfaces

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


def test_pose_columns_are_differences():
    state, rng = POSES[0], np.random.default_rng(0)
    x = seen(BODY)[0].cloud[::25]
    found = nearest(BODY, state, x, max_distance=0.1, exact=True)
    use = found.segment >= 0
    x, segment = x[use], found.segment[use]
    A = _pose_columns(BODY, state, found.point[use], found.normal[use], segment)
    step = 1e-5
    for _ in range(4):
        delta = rng.normal(size=BODY.tree.n_dofs)
        ahead, back = (
            nearest(BODY, state.retract(sign * step * delta), x, max_distance=0.2, only=segment, exact=True).distance
            for sign in (1, -1)
        )
        error = np.abs((ahead - back) / (2 * step) + A @ delta)
        assert np.median(error) < 1e-3 and np.quantile(error, 0.9) < 0.05  # but where the closest point jumps an edge


@pytest.mark.parametrize(("size", "girth"), [(1.1, 1.15), (0.92, 0.9)])
def test_size_and_girth_come_out(size, girth):
    groups = len(BODY.scale_groups)
    person = thick(BODY.scaled(np.full(groups, size)), girth)
    views = seen(person)
    fit = fit_surfaces(BODY, [v.cloud for v in views], off(1), views=views)
    assert fit.residual < fit.before and fit.residual < 0.006
    length = np.abs(np.log(fit.factors[:groups] / size))
    assert np.mean(length) < 0.02 and length.max() < 0.04
    trunk = fit.factors[fit.names.index("trunk girth b")] * fit.factors[fit.names.index("trunk")]
    assert abs(np.log(trunk / (size * girth))) < 0.06
    assert np.isclose(fit.body.stature, BODY.stature * size, rtol=0.03)


def test_the_right_body_stays_and_what_is_unseen_keeps_its_prior():
    half = [np.where(np.arange(240)[:, None] < 135, depth_of(BODY, s, CAMERA, seed=3), 0.0) for s in POSES]
    clouds = [view_of(d, d > 0, CAMERA).cloud for d in half]
    fit = fit_surfaces(BODY, clouds, POSES)
    seen_groups = [fit.names.index(n) for n in ("trunk", "upperarm", "forearm")]
    assert np.abs(np.log(fit.factors[seen_groups])).max() < 0.04
    shank, upper = fit.names.index("shank girth b"), fit.names.index("upperarm girth b")
    assert 0.7 * GIRTH < fit.std[shank] < 1.05 * GIRTH and fit.std[upper] < fit.std[shank]
    assert fit.residual <= fit.before + 1e-4


def test_it_does_not_run_away_on_rubbish():
    rng = np.random.default_rng(0)
    clouds = [rng.uniform(-0.6, 0.6, (400, 3)) + (0.1, 1.0, -0.2) for _ in POSES]
    fit = fit_surfaces(BODY, clouds, POSES, camera=CAMERA)
    assert np.all(fit.factors > 0.4) and np.all(fit.factors < 2.5) and np.isfinite(fit.std).all()


def test_bad_input_is_told():
    cloud = seen(BODY)[0].cloud
    with pytest.raises(ObservationError, match="2 clouds with 1"):
        fit_surfaces(BODY, [cloud, cloud], POSES[:1])
    with pytest.raises(ObservationError, match="without points"):
        fit_surfaces(BODY, [np.full((5, 3), np.nan)], POSES[:1])
    with pytest.raises(BodyError, match="surfaces"):
        fit_surfaces(replace(BODY, surfaces=()), [cloud], POSES[:1])
