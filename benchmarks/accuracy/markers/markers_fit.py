"""Fitting of labelled markers beside references: Plug-in-Gait's model and OpenSim's.

Definitions differ, and no constant of ours is fitted to theirs. "As they are" compares plainly. "Aligned" takes out
what cannot be a matter of right and wrong: where in its segment a model puts a joint's centre (one constant vector a
joint), and how it lays the axes of its segments (one constant turn a segment) or, where only angles are given, where an
angle's zero is (one constant an angle).
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import json
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import LEFT_OUT, amount, each, figure, peers, quick, recording
from benchmarks.peers import read_mot
from benchmarks.peers.environments import run_peer
from benchmarks.timing import fastest, took
from kinefit import Markers, Motion, load_body, read_markers
from kinefit.cli.markers._fit import worn_body
from kinefit.exporters import write_markers, write_osim
from kinefit.fitting.markers.subject import MarkerSubject, columns, fit_marker_subject, sequence_both_ways
from kinefit.fitting.tracking.video import fit_markers
from kinefit.readers.c3d_file import read_c3d

CHILD = {"hip": "thigh", "knee": "shank", "ankle": "foot", "shoulder": "upperarm", "elbow": "forearm", "wrist": "hand"}
SAGITTAL = {"hip": "hip_flexion", "knee": "knee_angle", "ankle": "ankle_angle"}
OPENSIM = {
    "hip": "hip", "knee": "walker_knee", "ankle": "ankle", "shoulder": "acromial", "elbow": "elbow",
    "wrist": "radius_hand",
}  # fmt: skip
REPEATS = amount(3, 1)
PEOPLE = 6
"""Simulated: one person's markers may sit so that the figure is half or twice as large."""


def run() -> None:
    """Print every figure of marker fitting."""
    each(plug_in_gait, opensim, landmarks, known_person, long_take)


def fitted(trials: list[Markers]) -> tuple[MarkerSubject, Motion]:
    """Subject from all trials, and the motion of the last."""
    subject = fit_marker_subject(load_body("humanoid"), trials)
    return subject, fit_markers(subject, trials[-1])


def plug_in_gait() -> None:
    """The movement trial of pyCGM's sample, with the joint centres and angles that Vicon's model put in the file."""
    names = ("markers_pycgm_centres", "mm", "<= 15"), ("markers_pycgm_sagittal", "deg", "<= 4")
    folder = recording("markers_pycgm")
    path = folder / "Test_Files" / "Movement_trial.c3d"
    markers = read_markers(path)
    motion = fitted([markers])[1]
    reference = labelled_points(path)
    centres = {}
    for side in "RL":
        s, m = side.lower(), 1e-3
        centres |= {f"hip_{s}": m * reference[f"{side}FEP"], f"knee_{s}": m * reference[f"{side}FEO"]}
        centres |= {f"ankle_{s}": m * reference[f"{side}TIO"], f"shoulder_{s}": m * reference[f"{side}HUP"]}
        centres |= {f"elbow_{s}": m * reference[f"{side}HUO"], f"wrist_{s}": m * reference[f"{side}RAO"]}
    plain, aligned = compare_centres(motion, centres)
    print(f"# pycgm: joint centres {plain:.1f} mm as they are, {aligned:.1f} mm aligned")
    figure(*names[0][:1], aligned, *names[0][1:])
    raw, turned = {}, {}
    segments = {"hip": ("PEL", "FE"), "knee": ("FE", "TI"), "ankle": ("TI", "FO")}
    for joint, (upper, lower) in segments.items():
        for side in "RL":
            theirs = reference[f"{side}{joint.capitalize()}Angles"][:, 0]
            ours = coordinate(motion, f"{SAGITTAL[joint]}_{side.lower()}")
            off = ours - theirs
            key = f"{joint}_{side.lower()}"
            raw[key] = rms(off)
            frames = [axes(reference, n if n == "PEL" else side + n) for n in (upper, lower)]
            turned[key] = rms(rotation_difference(motion, CHILD[joint] + "_" + side.lower(), *frames))
    for what, values in (("as they are", raw), ("segments' axes aligned", turned)):
        print(f"# pycgm: sagittal angles, RMS difference [deg], {what}: {told(values)}")
    figure("markers_pycgm_sagittal_as_they_are", float(np.mean(list(raw.values()))), "deg", "<= 12")
    figure(*names[1][:1], float(np.mean(list(turned.values()))), *names[1][1:])


def opensim() -> None:
    """The running trial of BMClab: OpenSim's scaled model, its own angles, its inverse kinematics side by side."""
    figures = {
        "markers_bmc_centres": ("mm", "<= 15"), "markers_bmc_sagittal": ("deg", "<= 4"),
        "markers_bmc_rms_vs_opensim": ("x", "<= 1"), "markers_fit_vs_opensim": ("x faster", ">= 50"),
        "markers_fit_vs_opensim_own": ("x faster", ">= 50"),
    }  # fmt: skip
    folder = recording("markers_bmc_run")
    trials = [read_markers(folder / "run" / "ExpData" / f"{n}.trc") for n in ("static_run", "motion_capture_run")]
    subject, motion = fitted(trials)
    names, table = read_mot(folder / "run" / "IK" / "results" / "ik_output_run.mot")
    values: dict[str, float] = {}
    for joint, label in SAGITTAL.items():
        for side in "rl":
            off = coordinate(motion, f"{label}_{side}")[: len(table)] - table[:, names.index(f"{label}_{side}")]
            values[f"{joint}_{side}"] = rms(off - off.mean())
    print(f"# bmc run: sagittal angles, RMS difference [deg], each with its own zero: {told(values)}")
    joints = {f"{j}_{s}": f"{n}_{s}" for j, n in OPENSIM.items() for s in "rl"}
    x = columns(trials[1], subject.points.names)
    fit = partial(sequence_both_ways, subject.body, subject.points, x, subject.sigma)  # as OpenSim: no bars
    fit()  # compiled
    seconds = fastest(fit, REPEATS)[1]
    with tempfile.TemporaryDirectory() as name:
        own = Path(name)
        write_osim(worn_body(subject, trials[1].names), own / "body.osim")
        write_markers(replace(trials[1], up="y"), own / "markers.trc", unit="m")
        run = (folder / "run").resolve()
        take = {
            "model": str(run / "Scale" / "Rajagopal2015_scaled.osim"), "setup": str(run / "IK" / "IK_setup.xml"),
            "markers": str(run / "ExpData" / "motion_capture_run.trc"), "joints": joints, "own": str(own.resolve()),
            "reference": str(run / "IK" / "results" / "ik_output_run.mot"),
        }  # fmt: skip
        (own / "take.json").write_text(json.dumps(take), encoding="utf-8")
        left_out = {"reason": LEFT_OUT if quick() else "--no-peers"}
        peer = run_peer("opensim_takes", own) if peers() else left_out
        print(f"# {peer}", flush=True)
        reason = peer.get("reason", "")
        points = np.load(own / "centres.npz")["centres"] if not reason else None
    aligned = ratio = speed = own_speed = None
    ms = 1e3 * seconds / len(trials[1])
    if points is not None:
        reference = {key: points[:, i] for i, key in enumerate(joints)}
        as_they_are, aligned = compare_centres(motion, reference)
        print(f"# bmc run: joint centres {as_they_are:.1f} mm as they are, {aligned:.1f} mm aligned")
        followed = followed_markers(folder / "run" / "IK" / "IK_setup.xml")
        residuals = motion.residuals["markers"]
        mine = [i for i, n in enumerate(residuals.names) if n in followed]
        own_rms = 1e3 * rms(residuals.norms[:, mine])
        theirs, on_ours = peer["ms_per_frame"], peer["own_ms_per_frame"]
        print(f"# bmc run: RMS of OpenSim's {len(mine)} markers: {own_rms:.1f} mm, OpenSim {peer['rms_mm']:.1f} mm")
        print(f"# bmc run: {ms:.3f} ms a frame with error bars; OpenSim {theirs:.2f} ms on its own model,")
        print(f"#   {on_ours:.2f} ms on the model that kinefit wrote (RMS {peer['own_rms_mm']:.1f} mm)")
        ratio, speed, own_speed = own_rms / peer["rms_mm"], theirs / ms, on_ours / ms
    found = aligned, float(np.mean(list(values.values()))), ratio, speed, own_speed
    for (name, (unit, goal)), value in zip(figures.items(), found, strict=True):
        figure(name, value, unit, goal, reason)


def landmarks() -> None:
    """Knees and ankles against the middle of epicondyles and malleoli of static trials, whose medial markers the fit
    never saw."""
    folder = recording("markers")
    means = []
    for static, moving, ends in two_laboratories(folder):
        medial = {pair[1] for pair in ends.values()}
        kept = [i for i, n in enumerate(static.names) if n not in medial]
        bare = Markers(tuple(static.names[i] for i in kept), static.rate, static.positions[:, kept])
        subject = fit_marker_subject(load_body("humanoid"), [bare, moving])
        motion = fit_markers(subject, bare)
        reference = {
            key: np.mean([static.positions[:, static.names.index(n)] for n in pair], axis=0)
            for key, pair in ends.items()
        }
        plain, _ = compare_centres(motion, reference)
        means.append(plain)
    figure("markers_landmark_centres", float(np.mean(means)), "mm", "<= 15")


def two_laboratories(folder: Path) -> Iterator[tuple[Markers, Markers, dict[str, tuple[str, str]]]]:
    """Static and moving trial, and which markers a joint's centre lies between."""
    stem = folder / "nimblephysics" / "data__grf__Subject4__MarkerData__"
    ends: dict[str, tuple[str, str]] = {}
    for s, a in (("r", "r"), ("l", "L")):
        ends |= {f"knee_{s}": (f"{a}_knee", f"{a}_mknee"), f"ankle_{s}": (f"{a}_ankle", f"{a}_mankle")}
    yield *(read_markers(f"{stem}{n}.trc") for n in ("static1", "walking1")), ends
    stem, ends = folder / "opensim" / "Pipelines__Rajagopal__ExpData__", {}
    for s, a in (("r", "R"), ("l", "L")):
        ends |= {f"knee_{s}": (f"{a}.Knee", f"{a}.MKnee"), f"ankle_{s}": (f"{a}.Ankle", f"{a}.MAnkle")}
    trials = (read_markers(f"{stem}{n}.trc") for n in ("static_walk_1", "motion_capture_walk"))
    yield *trials, ends


def known_person() -> None:
    """Simulated people whose markers sit 1 to 6 cm off the set's places, by a static trial and a moving one."""
    from kinefit.bodies.marker_sets import placement
    from kinefit.simulation import squat_and_wave
    from kinefit.simulation.evaluation import joint_errors

    truth, errors = squat_and_wave(rate=60), []
    placed = placement(truth.body, "CMU_41")
    for seed in range(amount(PEOPLE, 1)):
        rng = np.random.default_rng(seed)
        away = placed.spread[:, None] * rng.normal(size=(len(placed.points), 3))
        points = replace(placed.points, points=placed.points.points + away)
        x = truth.positions(points) + rng.normal(0, 0.002, (len(truth), len(points), 3))
        markers = Markers(points.names, truth.rate, x, up=truth.up)
        still = replace(markers, positions=x[:20])
        motion = fitted([still, markers])[1]
        legs = [truth.body.tree.segment(f"{n}_{s}") for n in ("thigh", "shank", "foot") for s in "rl"]
        errors.append(1e3 * float(joint_errors(truth, motion)[:, legs].mean()))
    print(f"# known people, one by one: {np.round(errors, 1).tolist()} mm")
    figure("markers_known_person_legs", float(np.mean(errors)), "mm", "<= 15")


def long_take() -> None:
    """60 s at 120 Hz of 41 markers: a break dancer's take, forwards and then backwards."""
    folder = recording("markers")
    take = read_markers(folder / "mocaprecovery" / "data__85_12.c3d")
    x = np.concatenate([take.positions, take.positions[::-1]])[: amount(7200, 400)]
    markers = replace(take, positions=x, residual=None)
    fitted([replace(markers, positions=x[:200])])  # compiled
    # one core; the clock on the wall says the same on a machine that does nothing else
    seconds = took(lambda: fitted([markers]))[1]
    figure("markers_fit_60s", seconds, "s", "<= 30")


def compare_centres(motion: Motion, reference: dict[str, NDArray]) -> tuple[float, float]:
    """Mean distance [mm] of joint centres (F, 3) as they are, and without what is constant in the parent segment."""
    tree, Ts = motion.body.tree, motion.segment_poses()
    plain, aligned = {}, {}
    for key, theirs in reference.items():
        joint, side = key.rsplit("_", 1)
        s, count = tree.segment(f"{CHILD[joint]}_{side}"), min(len(Ts), len(theirs))
        R = Ts[:count, tree.parents[s], :3, :3]
        local = np.einsum("fji,fj->fi", R, theirs[:count] - Ts[:count, s, :3, 3])
        plain[key] = 1e3 * float(np.nanmean(np.linalg.norm(local, axis=1)))
        aligned[key] = 1e3 * float(np.nanmean(np.linalg.norm(local - np.nanmean(local, axis=0), axis=1)))
    return float(np.mean(list(plain.values()))), float(np.mean(list(aligned.values())))


def rotation_difference(motion: Motion, child: str, upper: NDArray, lower: NDArray) -> NDArray:
    """(F,) [deg] difference of flexion, both models' turns of a joint seen in our segments' axes.

    upper, lower : (F, 3, 3) the reference's axes of the two segments; a constant turn takes each to ours.
    """
    tree, Ts = motion.body.tree, motion.segment_poses()
    s = tree.segment(child)
    R_upper, R_lower = Ts[:, tree.parents[s], :3, :3], Ts[:, s, :3, :3]
    turned = [theirs @ mean_turn(theirs, ours) for theirs, ours in ((upper, R_upper), (lower, R_lower))]
    angles = [flexion(np.swapaxes(a, 1, 2) @ b) for a, b in ((R_upper, R_lower), turned)]
    return np.degrees(np.angle(np.exp(1j * (angles[0] - angles[1]))))


def mean_turn(theirs: NDArray, ours: NDArray) -> NDArray:
    """(3, 3) the constant C for which theirs C is nearest to ours over all frames."""
    known = np.isfinite(theirs).all(axis=(1, 2))
    u, _, vt = np.linalg.svd(np.einsum("fki,fkj->ij", theirs[known], ours[known]))
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def flexion(R: NDArray) -> NDArray:
    """(F,) [rad] first of the angles about z, x, y."""
    return np.unwrap(np.arctan2(-R[:, 0, 1], R[:, 1, 1]))


def axes(points: dict[str, NDArray], segment: str) -> NDArray:
    """(F, 3, 3) unit axes of a segment of Plug-in-Gait, from its origin and the ends of its axes."""
    ends = [points[segment + end] - points[segment + "O"] for end in "ALP"]
    return np.stack([e / np.linalg.norm(e, axis=1, keepdims=True) for e in ends], axis=2)


def labelled_points(path: Path) -> dict[str, NDArray]:
    """All points of a C3D, computed ones too, in its own unit: label without prefix -> (F, 3)."""
    c3d = read_c3d(path)
    lists: list[Any] = [c3d.parameters.get(f"POINT:LABELS{k}", []) for k in ("", 2, 3)]
    labels = [label.rpartition(":")[2] for some in lists for label in some]
    points = np.where(c3d.missing[..., None], np.nan, c3d.points)
    return {label: points[:, i] for i, label in enumerate(labels[: points.shape[1]])}


def followed_markers(setup: Path) -> set[str]:
    """Markers that an IK setup of OpenSim follows."""
    import xml.etree.ElementTree as ET

    tasks = ET.parse(setup).getroot().iter("IKMarkerTask")
    return {str(t.get("name")) for t in tasks if (t.findtext("apply") or "").strip() == "true"}


def coordinate(motion: Motion, name: str) -> NDArray:
    """(F,) [deg] one angle."""
    return np.degrees(motion.angles[:, motion.body.tree.coordinate(name)])


def rms(values: NDArray) -> float:
    """Root of the mean square of what is known."""
    return float(np.sqrt(np.nanmean(np.square(values))))


def told(values: dict[str, float]) -> str:
    """Values by name and their mean."""
    return ", ".join(f"{k} {v:.1f}" for k, v in values.items()) + f"; mean {np.mean(list(values.values())):.1f}"
