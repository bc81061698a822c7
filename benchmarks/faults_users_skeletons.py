"""Skeletons whose rest pose is not upright, and OpenSim models with fitted markers: inputs of users, and siblings.

Whether one walk in files with other rest poses, joint frames, channels and units gets the same angles by `kinefit
retarget`, or an error or finding that names the cause. OpenSim's inverse kinematics runs on what `kinefit markers fit`
writes for every marker set.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from click.testing import CliRunner
from scipy.spatial.transform import Rotation
from tests.readers.skeletons.bvh_variants import along, any_frames, turned, write_variant

from benchmarks.figures import LEFT_OUT, amount, data, figure, peers, quick
from benchmarks.peers.environments import run_peer
from kinefit import read_motion
from kinefit.bodies import PointSet
from kinefit.bodies.marker_sets import placed_set_names, placement
from kinefit.bodies.motion import Motion
from kinefit.cli import main
from kinefit.cli.markers._fit import fit_file
from kinefit.exporters import write_markers
from kinefit.observations import Markers, SkeletonMotion
from kinefit.readers.skeletons.acclaim import read_amc
from kinefit.readers.skeletons.bvh import read_bvh
from kinefit.simulation import squat_and_wave

_MAX_ANGLE_DEG = 1.0  # of all joints but the neck
_MAX_NECK_DEG = 2.0  # the T-pose in the recorded walk holds the head 1.7 degrees off that of the rest pose
_REFUSED = "is no upright person|positions alone"
_FRAMES = 12  # of each recording


def _by_command(path: Path, *options: str | Path) -> tuple[Motion | None, str]:
    """The motion that `kinefit retarget` writes, None after an error; and what it prints."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.npz"
        done = CliRunner().invoke(main, ["retarget", str(path), "-o", str(out), *map(str, options)])
        return (read_motion(out) if done.exit_code == 0 else None), done.output


def _is_same(path: Path, right: Path, *options: str | Path, refused: str = _REFUSED, of: tuple = ()) -> bool:
    """Whether the angles are those of the right file, or an error or a finding names the cause."""
    truth, _ = _by_command(right, *of)
    found, text = _by_command(path, *options)
    if truth is None or found is None or "doubt:" in text:
        return truth is not None and bool(re.search(refused, text) or "no pose set by a program" in text)
    off = np.degrees(np.abs(found.angles - truth.angles)).max(axis=0)
    neck = np.array([name.startswith("neck") for name in found.body.tree.coordinates])
    return bool(off[~neck].max() < _MAX_ANGLE_DEG and off[neck].max() < _MAX_NECK_DEG)


def _case(folder: Path) -> bool:
    return _is_same(folder / "walk.bvh", folder.parent / "bvh-rest-lying" / "walk_upright_rest.bvh", refused="upright")


CASES: dict[str, Callable[[Path], bool]] = dict.fromkeys(
    ("bvh-rest-lying", "bvh-any-joint-frames", "bvh-bones-along-x", "bvh-zero-offsets"), _case
)


def _recorded(name: str) -> SkeletonMotion:
    """Some frames of a recording, the first among them."""
    folder, _, file = name.partition("/")
    place = data(folder)
    if place is None:
        raise FileNotFoundError(f"the recording {folder} is absent")
    skeleton = read_bvh(place / file)
    rows = np.linspace(0, len(skeleton) - 1, _FRAMES).astype(int)
    return replace(skeleton, Ts_world_joint=skeleton.Ts_world_joint[rows], rate=10.0)


def _sibling(name: str, frames: Callable[[SkeletonMotion], np.ndarray], *words: str, **how) -> Callable[[Path], bool]:
    """A recording as it is against itself in another form; `words`: options of the command."""

    def is_right(folder: Path) -> bool:
        skeleton = _recorded(name)
        right = write_variant(skeleton, folder / "right.bvh", turned(skeleton, 0.0, 0.0, 0.0))
        return _is_same(write_variant(skeleton, folder / "other.bvh", frames(skeleton), **how), right, *words)

    return is_right


def _amc_lying(folder: Path) -> bool:
    """An ASF whose rest pose lies on its back, with its AMC: the same motion as the recorded one."""
    place = data("motion_cmu_amc")
    if place is None:
        raise FileNotFoundError("the recording motion_cmu_amc is absent")
    turn = Rotation.from_euler("x", 90, degrees=True)
    head, _, frames = (place / "02_01.amc").read_text().partition("\n1\n")
    frames = "1\n" + "\n".join(re.split(r"\n(?=\d+\n)", frames)[0].splitlines())

    def axis(match: re.Match) -> str:  # "axis 0 0 20 XYZ": turns about x, y, z of the world, x first
        R = turn * Rotation.from_euler("xyz", [float(v) for v in match[1].split()], degrees=True)
        return "axis " + " ".join(f"{v:.8f}" for v in R.as_euler("xyz", degrees=True)) + " XYZ"

    def direction(match: re.Match) -> str:
        return "direction " + " ".join(f"{v:.8f}" for v in turn.apply([float(v) for v in match[1].split()]))

    def root(match: re.Match) -> str:
        values = np.array(match[1].split(), float)
        R = Rotation.from_euler("xyz", values[3:], degrees=True) * turn.inv()
        return "root " + " ".join(f"{v:.8f}" for v in (*values[:3], *R.as_euler("xyz", degrees=True)))

    asf = (place / "02.asf").read_text()
    (folder / "right.asf").write_text(asf)
    asf = re.sub(r"direction +(\S+ +\S+ +\S+)", direction, asf)
    (folder / "lying.asf").write_text(re.sub(r"axis +(\S+ +\S+ +\S+) +XYZ", axis, asf))
    (folder / "right.amc").write_text(f"{head}\n{frames}\n")
    (folder / "lying.amc").write_text(f"{head}\n" + re.sub(r"root +(.*)", root, frames) + "\n")
    motions = [read_amc(folder / f"{name}.asf", folder / f"{name}.amc") for name in ("right", "lying")]
    assert np.abs(motions[0].positions - motions[1].positions).max() < 1e-5
    return _is_same(
        folder / "lying.amc", folder / "right.amc", "--asf", folder / "lying.asf", of=("--asf", folder / "right.asf")
    )


def _named(label: Callable[[str], str], labels: tuple[str, ...]) -> Callable[[Path], bool]:
    """Whether body.osim has the fitted markers under the labels of markers.trc, whatever these are."""

    def is_right(folder: Path) -> bool:
        write_take(folder / "take.trc", "STANFORD_47", label)
        fit_file(folder / "take.trc", folder / "fit", formats=("osim", "markers", "motion"))
        model = (folder / "fit" / "body.osim").read_text()
        header = (folder / "fit" / "markers.trc").read_text().splitlines()[3].split("\t")[2::3]
        motion = read_motion(folder / "fit" / "motion.npz")
        points = motion.body.marker_sets["STANFORD_47"]
        at = {
            name: np.array(place.split(), float)
            for name, place in re.findall(r'<Marker name="([^"]+)">.*?<location>([^<]+)</location>', model, flags=re.S)
        }
        return set(labels) <= set(header) <= set(at) and all(
            np.abs(at[own] - points.points[points.index(name)]).max() < 1e-6
            for own, name in zip(labels, ("r_knee", "r_ankle"), strict=True)
        )

    return is_right


_WALK, _JACKS = "motion_cmu_bvh/cmu_12_01_walk.bvh", "motion_animateddrawings_bvh/jumping_jacks.bvh"
_WAVE, _ICLONE = "motion_animateddrawings_bvh/wave_hello.bvh", "motion_cmu_bvh/007_04.bvh"
_Z_UP, _Y_DOWN = (Rotation.from_euler("x", angle, degrees=True).as_matrix() for angle in (90, 180))

SIBLINGS: dict[str, Callable[[Path], bool]] = {
    "rest: ASF/AMC on its back": _amc_lying,
    "rest: BVH upside down": _sibling(_JACKS, lambda s: turned(s, 180, 0, 0)),
    "rest: BVH turned about three axes, z up": _sibling(_WAVE, lambda s: turned(s, 30, 40, 20)),
    "rest: BVH on its side, in a world with y down": _sibling(_WALK, lambda s: turned(s, 0, 0, 90), world=_Y_DOWN),
    "frames: the rest pose is a frame of the walk": _sibling(
        _WALK, lambda s: np.swapaxes(s.Ts_world_joint[5, :, :3, :3], 1, 2)
    ),
    "frames: any, nobody stands": _sibling(_JACKS, any_frames),
    "frames: any, a person stands": _sibling(_WAVE, any_frames),
    "frames: any, eyes and fingers recorded": _sibling(_ICLONE, any_frames),
    "bones: along y": _sibling(_WALK, lambda s: along(s, 1)),
    "bones: along z, z up": _sibling(_WALK, lambda s: along(s, 2), world=_Z_UP),
    "offsets: zero, any frames": _sibling(_WALK, any_frames, offsets=False),
    "offsets: zero, upright frames": _sibling(_JACKS, lambda s: turned(s, 0, 0, 0), offsets=False),
    "offsets: positions alone": _sibling(_WAVE, lambda s: turned(s, 0, 0, 0), rotations=False),
    "offsets: zero, in feet": _sibling(
        _WALK, lambda s: turned(s, 0, 0, 0), "--unit", "ft", offsets=False, unit=0.3048
    ),
    "osim: labels in capitals": _named(str.upper, ("R_KNEE", "R_ANKLE")),
    "osim: labels with a subject": _named(lambda name: f"Anna:{name}", ("r_knee", "r_ankle")),
    "osim: labels with blanks": _named(lambda name: name.replace("_", " "), ("r_knee", "r_ankle")),
}


def write_take(path: Path, name: str, label: Callable[[str], str] = str) -> None:
    """A squat with a marker set, each marker 8 mm and 2 mm of noise off the set's place along each axis."""
    truth, rng = squat_and_wave(rate=float(amount(15, 5))), np.random.default_rng(0)
    points = placement(truth.body, name).points
    away = rng.normal(scale=0.008, size=(len(points), 3))
    x = truth.positions(PointSet(points.names, points.segments, points.points + away))
    x = x + rng.normal(scale=0.002, size=x.shape)
    write_markers(Markers(tuple(map(label, points.names)), truth.rate, x, up=truth.up), path)


def run() -> None:
    """Print how far OpenSim's marker error is from kinefit's, worst of all marker sets."""
    worst, reason = None, ""
    with tempfile.TemporaryDirectory() as place:
        folder, own = Path(place), {}
        for name in placed_set_names():
            write_take(folder / f"{name}.trc", name)
            formats = ("mot", "osim", "markers")
            ((motion, _),) = fit_file(folder / f"{name}.trc", folder / name, formats=formats).values()
            own[name] = 1e3 * float(np.sqrt(np.mean(motion.residuals["markers"].norms ** 2)))
        left_out = {"reason": LEFT_OUT if quick() else "--no-peers"}
        found = run_peer("opensim_sets", folder) if peers() else left_out
        reason = found.get("reason", "")
        if not reason:
            apart = {n: [abs(found[n][key] - own[n]) for key in ("rms_mm", "own_angles_mm")] for n in own}
            for name, (solved, same) in apart.items():
                print(f"# {name}: {own[name]:.2f} mm; OpenSim off by {solved:.2f}, at kinefit's angles {same:.4f}")
            worst = max(map(max, apart.values()))
    figure("faults_users_osim_rms", worst, "mm", "<= 0.5", reason)


if __name__ == "__main__":
    run()
