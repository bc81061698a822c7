"""`[[surface_points]]` of a take: from drawn videos through both commands, from a table, and what is refused."""

import numpy as np
import pytest
from benchmarks.surface_body import errors, moving_arm

from kinefit.bodies.surfaces.places import sample
from kinefit.errors import FileError, KinefitError, ObservationError
from kinefit.fitting.tracking.checkpoints.checkpoint import Checkpoint, key_of
from kinefit.readers.take.file import read_take
from kinefit.sensors.kinds.surface_points import read_surface_points
from kinefit.takes.track import track_take

HEADER = "time_s,point,x,y,z,std_x,std_y,std_z,vx\n"


def test_drawn_videos_through_both_commands(tmp_path):
    off = errors(tmp_path, 10, frames=6, size=320)
    assert max(off["upperarm"], off["elbow_flex_r"], off["wrist_flex_r"]) < 1.0
    assert off["pro_sup_r"] < 10.0  # it begins 5 degrees off: a round forearm does not tell its turn in six frames


@pytest.fixture
def taken(tmp_path):
    """A take of points on the arm, with noise of 1 mm, and its motion."""
    motion, rng = moving_arm(3, 12), np.random.default_rng(0)
    points, _, segment = sample(motion.body, 250)
    rows = []
    for k in range(len(motion)):
        state = motion.state(k)
        f = motion.body.tree.forward(state.T_world_root, state.angles)[0][segment]
        x = np.einsum("nij,nj->ni", f[:, :9].reshape(-1, 3, 3), points) + f[:, 9:]
        x += 0.001 * rng.normal(size=x.shape)
        rows += [f"{k / 30:.6f},{i},{p[0]:.6f},{p[1]:.6f},{p[2]:.6f},0.001,0.001,0.001," for i, p in enumerate(x)]
    (tmp_path / "points.csv").write_text(HEADER + "\n".join(rows))
    start = dict(zip(motion.body.tree.coordinates, np.degrees(motion.angles[0])))
    told = ", ".join(f"{name} = {value:.3f}" for name, value in start.items())
    (tmp_path / "take.toml").write_text(
        '[take]\nrate = 30.0\nup = "y"\nbody = "arm"\nsize = false\n[start]\nat = [0, 0, 0]\nforward = [1, 0, 0]\n'
        f'angles = {{ {told} }}\n[[surface_points]]\nfile = "points.csv"\nsigma = 0.003\n'
    )
    return tmp_path / "take.toml", motion


def test_points_of_a_table_move_the_body(taken, tmp_path):
    path, truth = taken
    take = read_take(path)
    found, seen = track_take(take)
    names = list(truth.body.tree.coordinates)
    off = np.degrees(np.abs(found.angles - truth.angles)).max(axis=0)
    assert off[names.index("elbow_flex_r")] < 1.0 and off[names.index("pro_sup_r")] < 2.0
    assert list(found.residuals) == ["surface_points"] and len(seen.of_kind("surface_points")[0]) == 12
    with Checkpoint(tmp_path / "unfinished", key_of(take)) as unfinished:  # what the sensor learnt is kept
        again, _ = track_take(take, checkpoint=unfinished)
    assert np.array_equal(again.angles, found.angles)


@pytest.mark.parametrize(
    ("text", "error", "said"),
    [
        ("time_s,point,x\n", FileError, "no column y"),
        (HEADER + "0,1,2,3,4,1,1,x,\n", FileError, "line 2"),
        (HEADER + "0,1,2,3,4,1,1,1,\n0,2,2,3,4,0,1,1,\n", FileError, "line 3"),
        (HEADER + "0,1,nan,3,4,1,1,1,\n", FileError, "line 2"),
        (HEADER + "0,1,2,3,4,1,1,1,\n", ObservationError, "1 times"),
    ],
)
def test_tables_that_are_none(tmp_path, text, error, said):
    (tmp_path / "points.csv").write_text(text)
    with pytest.raises(error, match=said):
        read_surface_points(tmp_path / "points.csv")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("sigma = 0.003", "sigma = 3.0", "sigma = 3.0. Give metres"),
        ("sigma = 0.003", "slide = 0.003", "no key 'slide'"),
        ("sigma = 0.003", "time_offset = 50.0", "points"),
        ("points.csv", "nothing.csv", "no such file"),
        ("[start]\nat = [0, 0, 0]\nforward = [1, 0, 0]\nangles", "[session]\n#", "alone does not determine"),
    ],
)
def test_takes_that_are_refused(taken, old, new, said):
    path, _ = taken
    text = path.read_text().replace(old, new)
    if "time_offset" in new:
        text = text.replace("rate = 30.0", "rate = 30.0\nframes = [0, 12]")
        said = "steps"
    path.write_text(text)
    with pytest.raises(KinefitError, match=said):
        track_take(read_take(path))
