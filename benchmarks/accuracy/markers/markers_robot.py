"""A robot's markers named: a six-axis arm, a tree and a marker set of one's own, through the commands (P5, section 1).

The body file, the marker set and every recording are written here; places of the markers on the links are drawn once.
The model is learnt from one labelled frame (`kinefit markers learn --frame`). Random poses are named one by one, a
tenth of the markers missing, five extra points; a motion of smooth random angles, its columns shuffled and broken, is
named by `kinefit markers identify`, and tracked by `kinefit track` with `model` in `[[markers]]`. Noise is 0.5 mm.
Where the base stands is not given, nor that it stands; it is tracked once more with a base that does not move.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.commands import printed
from benchmarks.figures import amount, figure
from benchmarks.scenes.marker_takes import counts
from kinefit.bodies import Body, BodyState, load_body
from kinefit.exporters import write_markers
from kinefit.markers.frame.identify import identify
from kinefit.markers.model.model import load_model
from kinefit.observations import Markers
from kinefit.readers.markers import read_markers
from kinefit.readers.motion import read_motion

RATE, NOISE = 60.0, 0.0005  # [Hz], [m]
MISSING, EXTRA = 0.1, 5
BIND = 0.002  # [m] within which a named point is the marker
GIVE = 0.001  # [m] of a marker on a rigid link
LINKS = (  # name, joint in the parent's frame [m], its axis, far end [m], radius [m] at which markers are, how many
    ("base", (0.0, 0.0, 0.0), "", (0.0, 0.09, 0.0), 0.09, 4),
    ("shoulder", (0.0, 0.09, 0.0), "y", (0.0, 0.05, 0.12), 0.08, 4),
    ("upper_link", (0.0, 0.05, 0.13), "z", (0.0, 0.425, 0.0), 0.07, 5),
    ("fore_link", (0.0, 0.425, -0.12), "z", (0.0, 0.39, 0.0), 0.06, 5),
    ("wrist_1", (0.0, 0.39, 0.0), "z", (0.0, 0.0, 0.11), 0.05, 4),
    ("wrist_2", (0.0, 0.0, 0.11), "y", (0.0, 0.095, 0.0), 0.05, 4),
    ("tool", (0.0, 0.095, 0.0), "z", (0.0, 0.0, 0.15), 0.05, 4),
)
RANGES = {"shoulder": 170, "upper_link": 90, "fore_link": 140, "wrist_1": 120, "wrist_2": 120, "tool": 170}  # [deg]


@dataclass(frozen=True, eq=False)
class Robot:
    """Files of a robot: its body, its marker set; and the body read."""

    body_file: Path
    set_file: Path
    body: Body

    @property
    def labels(self) -> tuple[str, ...]:
        """Of the markers."""
        return self.body.markers("ROBOT").names


def make_robot(folder: Path) -> Robot:
    """Body file and marker set of a six-axis arm with 30 markers."""
    rng, body, rows, places = np.random.default_rng(0), ['[body]\nname = "six_axis"'], [], {}
    placed, at_rest = [], np.zeros(3)
    for k, (name, joint, axis, end, radius, count) in enumerate(LINKS):
        at_rest = at_rest + joint
        hang = 'name = "ground", type = "free"'
        if axis:
            hang = (f'name = "axis_{k}", type = "revolute", at = {list(joint)}, axes = ["{axis}"], '
                    f'coordinates = ["q{k}"], range = [[{-RANGES[name]}, {RANGES[name]}]]')  # fmt: skip
        parent = f'parent = "{LINKS[k - 1][0]}"\n' if k else ""
        body.append(f'[[segment]]\nname = "{name}"\n{parent}scale = "fixed"\njoint = {{ {hang} }}\n'
                    f"surface = {{ end = {list(end)}, radii = [{0.8 * radius}, {0.7 * radius}] }}")  # fmt: skip
        own = []
        for n in range(count):
            out = np.cross(rng.normal(size=3), end)
            at = (n + 0.5) / count * np.array(end) + radius * rng.uniform(0.7, 1.3) * out / np.linalg.norm(out)
            label = f"{name}_{n + 1}"
            placed.append(f'{label} = {{ segment = "{name}", at = {at.round(4).tolist()} }}')
            places[label] = (at_rest + at).round(4).tolist()
            own.append(label)
        meets = f'parent = "{LINKS[k - 1][0]}"\njoint = {at_rest.round(4).tolist()}\nrange = 175\n' if k else ""
        rows.append(f'[[segment]]\nname = "{name}"\n{meets}give = {GIVE}\nmarkers = {own}'.replace("'", '"'))
    (folder / "robot.toml").write_text("\n".join([*body, "[markers.ROBOT.placed]", *placed]) + "\n")
    head = ['name = "ROBOT"', "[places]", *(f"{label} = {at}" for label, at in places.items())]
    (folder / "robot-set.toml").write_text("\n".join([*head, *rows]) + "\n")
    return Robot(folder / "robot.toml", folder / "robot-set.toml", load_body(folder / "robot.toml"))


def smooth_angles(robot: Robot, frames: int, rng: np.random.Generator) -> NDArray:
    """(F, 6) [rad] sums of slow sines over most of each axis' range."""
    t, tree = np.arange(frames) / RATE, robot.body.tree
    out = np.zeros((frames, len(tree.coordinates)))
    for _ in range(3):
        speed, phase = rng.uniform(0.1, 0.5, out.shape[1]), rng.uniform(0, 2 * np.pi, out.shape[1])
        out += np.sin(2 * np.pi * t[:, None] * speed + phase) / 3
    return out * 0.8 * tree.upper


def positions(robot: Robot, angles: NDArray, rng: np.random.Generator) -> NDArray:
    """(F, M, 3) [m] of the markers, noisy."""
    points = robot.body.markers("ROBOT")
    x = np.stack([robot.body.positions(BodyState(np.eye(4), q), points) for q in angles])
    return np.asarray(x + NOISE * rng.normal(size=x.shape))


def learn(robot: Robot, folder: Path, seed: int) -> Path:
    """The model of one labelled frame, by the command."""
    rng = np.random.default_rng([seed, 1])
    angles = smooth_angles(robot, 3, rng)
    write_markers(Markers(robot.labels, RATE, positions(robot, angles, rng), up="y"), folder / "labelled.c3d")
    printed("markers", "learn", folder / "labelled.c3d", "--frame", 0, "--set", robot.set_file, "--name", "robot",
            "-o", folder / "robot.json")  # fmt: skip
    return folder / "robot.json"


def single_frames(robot: Robot, model_file: Path, poses: int, seed: int) -> tuple[float, float, float]:
    """Shares [%] of seen markers that get their own name, of names that are wrong, and of poses without a mistake."""
    model, rng = load_model(model_file), np.random.default_rng([seed, 2])
    tree, counted, whole = robot.body.tree, np.zeros(3, int), 0
    order = [model.labels.index(label) for label in robot.labels]
    for _ in range(poses):
        x = positions(robot, rng.uniform(tree.lower, tree.upper)[None], rng)[0]
        there = rng.random(len(x)) >= MISSING
        points = np.concatenate([x[there], rng.uniform(x.min(0) - 0.2, x.max(0) + 0.2, (EXTRA, 3))])
        shuffled = rng.permutation(len(points))
        truth = np.full(len(x), -1)
        truth[there] = np.argsort(shuffled)[: there.sum()]
        found = identify(model, points[shuffled]).assignment[order]
        counted += counts(found, truth)
        whole += bool((found == truth).all())
    right, wrong, seen = counted.tolist()
    return 100 * right / seen, 100 * wrong / max(right + wrong, 1), 100 * whole / poses


def broken_take(robot: Robot, folder: Path, frames: int, seed: int) -> tuple[NDArray, NDArray, NDArray]:
    """Write points.c3d; true angles (F, 6), noisy positions (F, M, 3) and which are seen (F, M)."""
    rng = np.random.default_rng([seed, 3])
    angles = smooth_angles(robot, frames, rng)
    x = positions(robot, angles, rng)
    seen, columns = np.ones(x.shape[:2], bool), []
    for m in range(x.shape[1]):  # a tenth is hidden, in pieces of a quarter of a second; each stretch is a new column
        for start in rng.integers(0, frames, round(MISSING * frames / (RATE / 4))):
            seen[start : start + int(RATE / 4), m] = False
        edges = np.flatnonzero(np.diff(np.concatenate([[0], seen[:, m].astype(int), [0]])))
        for a, b in edges.reshape(-1, 2):
            column = np.full((frames, 3), np.nan)
            column[a:b] = x[a:b, m]
            columns.append(column)
    for _ in range(EXTRA):
        walk = 0.1 * np.cumsum(rng.normal(size=(frames, 3)), axis=0) / RATE
        columns.append(rng.uniform(x.min((0, 1)), x.max((0, 1)), 3) + walk)
    order = rng.permutation(len(columns))
    names = tuple(f"*{i + 1}" for i in range(len(columns)))
    write_markers(Markers(names, RATE, np.stack([columns[i] for i in order], axis=1), up="y"), folder / "points.c3d")
    return angles, x, seen


def whole_take(robot: Robot, model: Path, folder: Path, frames: int, seed: int) -> dict[str, float]:
    """Shares [%] named and wrong of a take by `identify`; by `track`, errors of angles [deg] and of the tool [mm]."""
    angles, x, seen = broken_take(robot, folder, frames, seed)
    printed("markers", "identify", folder / "points.c3d", model, "--no-fill")
    named = read_markers(folder / "points-named.c3d")
    found = named.positions[:, [named.names.index(label) for label in robot.labels]]
    there = np.isfinite(found).all(axis=2)
    right = there & (np.linalg.norm(found - x, axis=2) < BIND)
    (folder / "take.toml").write_text(
        '[take]\nbody = "robot.toml"\nup = "y"\nsize = false\n[[markers]]\nfile = "points.c3d"\nset = "ROBOT"\n'
        'model = "robot.json"\nsigma = 0.001\n'
    )
    printed("track", folder / "take.toml", "-o", folder / "result", "--formats", "motion")
    motion = read_motion(folder / "result" / "motion.npz")
    off = np.degrees(motion.angles - angles[: len(motion)])
    tool = robot.body.tree.segment("tool")
    true = robot.body.tree.segment_poses(np.tile(np.eye(4), (len(motion), 1, 1)), angles[: len(motion)])[:, tool, :3, 3]
    far = 1e3 * np.linalg.norm(motion.segment_poses()[:, tool, :3, 3] - true, axis=1)
    return {
        "named": 100 * float((right & seen).sum() / seen.sum()),
        "wrong": 100 * float((there & ~right).sum() / there.sum()),
        "angles": float(np.sqrt(np.mean(off**2))), "tool": float(np.sqrt(np.mean(far**2))),
    }  # fmt: skip


def run() -> None:
    """Print the figures."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        robot = make_robot(folder)
        model = learn(robot, folder, 1)
        right, wrong, whole = single_frames(robot, model, amount(200, 10), 1)
        print(f"# {len(robot.labels)} markers on {len(LINKS)} links; poses without a mistake {whole:.1f} %")
        figure("markers_robot_right", right, "% of the markers seen", ">= 95")
        figure("markers_robot_wrong", wrong, "% of the names", "<= 0.5")
        found = whole_take(robot, model, folder, amount(600, 90), 1)
        robot.body_file.write_text(robot.body_file.read_text().replace('type = "free"', 'type = "fixed"'))
        fixed = whole_take(robot, model, folder, amount(600, 90), 1)
    figure("markers_robot_take_named", found["named"], "% of the markers seen", ">= 99")
    figure("markers_robot_take_wrong", found["wrong"], "% of the names", "<= 0.1")
    figure("markers_robot_take_angles", found["angles"], "deg RMS", "<= 0.5")
    figure("markers_robot_take_tool", found["tool"], "mm RMS", "<= 1")
    figure("markers_robot_fixed_angles", fixed["angles"], "deg RMS", "<= 0.5")
