"""Ten movements: within the joints' ranges, smooth, feet on the floor; ten people."""

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.errors import ObservationError
from kinefit.simulation.movements import MOVEMENTS, movement, people

BODIES = {name: load_body(name) for name in ("humanoid10", "humanoid")}


@pytest.fixture(params=BODIES, scope="module")
def body(request):
    return BODIES[request.param]


@pytest.mark.parametrize("name", MOVEMENTS)
def test_a_movement_is_smooth_and_stays_on_the_floor(name, body):
    motion = movement(name, body, rate=50.0)
    assert len(motion) == 200 and motion.name == name
    assert np.all(motion.angles >= body.tree.lower) and np.all(motion.angles <= body.tree.upper)
    low, high = np.percentile(motion.angles, [0, 100], axis=0)
    at_limit = np.isclose(low, body.tree.lower, atol=1e-9) | np.isclose(high, body.tree.upper, atol=1e-9)
    assert not at_limit.any(), "clipped by a limit"
    speed = np.linalg.norm(np.diff(motion.positions(), axis=0), axis=-1) * motion.rate
    assert speed.max() < 6.0  # [m/s] a kicking foot
    change = np.linalg.norm(np.diff(motion.positions(), 2, axis=0), axis=-1) * motion.rate**2
    assert change.max() < 150.0  # [m/s²]
    ankles = motion.positions(body.landmarks.select(("l_ankle", "r_ankle")))
    assert -0.05 < ankles[..., 1].min() < 0.15
    assert np.abs(motion.Ts_world_root[:, :3, 3][0] - motion.Ts_world_root[:, :3, 3][-1])[1] < 0.02


@pytest.mark.parametrize("name", MOVEMENTS)
def test_a_standing_foot_does_not_slip(name):
    body = BODIES["humanoid10"]
    motion = movement(name, body, rate=100.0)
    ankles = motion.positions(body.landmarks.select(("l_ankle", "r_ankle")))
    lowest = np.argmin(ankles[..., 1], axis=1)
    higher = np.abs(ankles[:, 0, 1] - ankles[:, 1, 1]) > 0.08  # one foot is well off the floor
    step = np.linalg.norm(np.diff(ankles[..., [0, 2]], axis=0), axis=-1)
    standing = step[np.arange(len(step)), lowest[:-1]][higher[:-1]]
    assert standing.size == 0 or standing.max() * motion.rate < 0.35  # [m/s] the foot rolls about its ball


def test_what_is_special_about_each():
    body = BODIES["humanoid10"]
    at = {name: movement(name, body, rate=20.0) for name in MOVEMENTS}
    names = body.landmarks.names
    x = {name: dict(zip(names, m.positions().swapaxes(0, 1))) for name, m in at.items()}
    assert (x["arms_at_sensor"]["r_wrist"] - x["arms_at_sensor"]["r_shoulder"])[:, 0].max() > 0.5
    assert x["wave"]["r_wrist"][:, 1].max() > x["wave"]["r_shoulder"][:, 1].max() + 0.15
    assert np.linalg.norm(x["clap"]["r_wrist"] - x["clap"]["l_wrist"], axis=1).min() < 0.15
    assert np.ptp(x["walk"]["hip_centre"][:, 0]) > 0.8
    assert np.ptp(x["sit_down"]["hip_centre"][:, 1]) > 0.3 and np.ptp(x["squat"]["hip_centre"][:, 1]) > 0.2
    assert x["bow"]["skull_vertex"][:, 1].min() < 0.8 * x["bow"]["skull_vertex"][:, 1].max()
    assert np.ptp(x["kick"]["r_ankle"][:, 1]) > 0.3
    assert x["point"]["r_wrist"][:, 0].max() > 0.4 and x["shake_hands"]["r_wrist"][:, 0].max() > 0.35


def test_speed_makes_a_movement_shorter():
    assert [len(movement("bow", rate=10.0, speed=s)) for s in (0.5, 1.0, 1.6)] == [80, 40, 25]


def test_ten_people_are_different_and_come_again():
    crowd, again = people(), people()
    statures = np.array([p.body.stature for p in crowd])
    assert statures.min() < 1.56 and statures.max() > 1.92 and len(crowd) == 10
    assert sorted(np.round([p.speed for p in crowd], 3))[::9] == [0.6, 1.6]
    assert [p.body.stature for p in again] == statures.tolist()
    assert people(seed=1)[0].body.stature != statures[0]
    girth = [p.body.surfaces[0].radii[0][0] / p.body.stature for p in crowd]
    assert max(girth) / min(girth) > 1.2
    assert people(count=1)[0].speed == pytest.approx(1.1)


def test_bad_asks_are_told():
    with pytest.raises(ObservationError, match="movement"):
        movement("fly")
    for bad in ({"rate": 0.0}, {"speed": -1.0}, {"rate": np.nan}):
        with pytest.raises(ObservationError, match="positive"):
            movement("bow", **bad)
