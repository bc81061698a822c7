"""Error bars of real marker takes against markers that are left out: `python -m benchmarks markers markers_left_out`.

Subject: `fit_marker_subject` of other takes of the same person. They give the size, and every marker's place on its
segment; of the take itself no marker's place is calibrated. Then, of every third marker in turn: the take is tracked
without it (`track`, smoothed), and its place, carried by the fitted motion, is compared with where it was seen, along
each axis of the world. What is stated has two parts. One is the deviation of that point of the body: a segment without
a joint of its own is welded to the marker's segment at its place, so that `Motion.joint_std` has it. The other is what
a marker is off by, as the take's other markers show it (bias, drift and jitter of `sensor noise`): their places were
calibrated on the same other takes, so that their bias has the deviation of a place. It is at least as much as the
marker moved on its segment in those takes (`MarkerSubject.sigma`). Infinite deviations are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.mixed.mixed_figures import SIGMAS
from benchmarks.figures import amount, data, figure
from kinefit import Markers, Recording, load_body, read_markers, track
from kinefit.bodies import Body
from kinefit.fitting.markers.subject import MarkerSubject, fit_marker_subject
from kinefit.fitting.subject.subject import Subject
from kinefit.geometry.camera import Rig
from kinefit.observations import MarkerFrame

RATE, FRAMES, EVERY = 25.0, amount(50, 12), amount(3, 16)  # [Hz]; of each take, from its middle; markers
GROUPS = {
    "trunk": ("pelvis", "lumbar", "torso", "thorax", "head", "neck", "clavicle"),
    "arms": ("upperarm", "forearm", "hand"), "thighs": ("thigh",), "shanks": ("shank",), "feet": ("foot", "toes"),
}  # fmt: skip
STANFORD, BMC, PYCGM = "forces_nimblephysics/subject4/{}.trc", "markers_bmc_run/run/ExpData/{}.trc", "markers_pycgm/{}"
CASES = {
    "squats": (STANFORD, ("static1", "walking1"), "squats1"),
    "walk": (STANFORD, ("static1", "squats1"), "walking2"),
    "jump": (STANFORD, ("static1", "squats1"), "DJ2"),
    "run": (BMC, ("static_run",), "motion_capture_run"),
    "plug-in-gait": (PYCGM, ("Test_Files/Static_trial.c3d",), "Test_Files/Movement_trial.c3d"),
}  # fmt: skip
"""Name: where a person's takes lie, those that calibrate, and the one that is asked. The last two know a static trial
alone: their markers' places come from one posture."""


def run() -> None:
    """Print how often markers that are left out lie inside their stated 95 % intervals."""
    inside: dict[str, list[NDArray]] = {group: [] for group in GROUPS}
    absent, takes = [], {}
    for name, (folder, known, asked) in list(CASES.items())[: amount(None, 1)]:
        paths = [data(folder.format(file)) for file in (*known, asked)]
        if None in paths:
            absent.append(name)
            continue
        found = left_out([read_markers(path) for path in paths[:-1]], read_markers(paths[-1]))
        for label, (segment, z) in found.items():
            group = next(g for g, parts in GROUPS.items() if segment.startswith(parts))
            inside[group].append(np.abs(z) <= SIGMAS)
            print(f"#   {name}, {label} ({segment}): {100 * np.mean(np.abs(z) <= SIGMAS):.0f} %, error over deviation "
                  f"{np.sqrt(np.mean(z**2)):.2f}")  # fmt: skip
        takes[name] = np.concatenate([np.abs(z) <= SIGMAS for _, z in found.values()])
        print(f"# {name}: {len(found)} markers, {100 * takes[name].mean():.1f} % inside", flush=True)
    reason = f"recordings absent: {', '.join(absent)}" if absent else ""
    shares = {g: 100 * float(np.mean(np.concatenate(some))) for g, some in inside.items() if some}
    for group in GROUPS:
        value = None if reason else shares.get(group)
        figure(f"left_out_markers_inside_{group}_least", value, "%", ">= 90", reason, whole=EVERY == 3)
        figure(f"left_out_markers_inside_{group}_most", value, "%", "<= 98", reason, whole=EVERY == 3)
    whole = 100 * float(np.mean(np.concatenate(list(takes.values())))) if takes and not reason else None
    figure("left_out_markers_inside_least", whole, "%", ">= 90", reason, whole=EVERY == 3)
    figure("left_out_markers_inside_most", whole, "%", "<= 98", reason, whole=EVERY == 3)


def left_out(known: Sequence[Markers], take: Markers) -> dict[str, tuple[str, NDArray]]:
    """Label: its segment, and how many stated deviations it was seen from where the motion has it, (N,) of all axes."""
    subject = fit_marker_subject(load_body("humanoid"), known)
    points, body = subject.points, with_points(subject)
    take = middle(take)
    names = [n for n in points.names if n in take.names and np.isfinite(take.positions[:, take.names.index(n)]).any()]
    out = {}
    for label in names[::EVERY]:
        kept = [take.names.index(n) for n in names if n != label]
        steps = [
            [MarkerFrame("markers", i / take.rate, tuple(take.names[k] for k in kept), x[kept], subject.marker_set)]
            for i, x in enumerate(take.positions)
        ]
        sized = Subject(body, subject.scales)
        motion = track(Recording.of_frames(steps, Rig(()), rate=take.rate, up=take.up or "y"), body, subject=sized)
        k = points.index(label)
        s = body.tree.segment(welded(label))
        noise = motion.provenance["sensor noise"]["markers"]
        own = sum(noise[f"{part} [m]"] ** 2 for part in ("bias", "drift", "jitter"))
        stated = np.sqrt(motion.joint_std[:, s] ** 2 + max(own, subject.sigma[k] ** 2))
        z = (take.positions[:, take.names.index(label)] - motion.segment_poses()[:, s, :3, 3]) / stated
        z = z[np.isfinite(z) & np.isfinite(stated)]
        if len(z):
            out[label] = body.tree.segments[body.tree.parents[s]], z
    return out


def middle(take: Markers) -> Markers:
    """Some frames a second from the middle of a take."""
    step = max(round(take.rate / RATE), 1)
    some = take.positions[::step]
    first = max((len(some) - FRAMES) // 2, 0)
    return replace(take, positions=some[first : first + FRAMES], rate=take.rate / step, residual=None)


def welded(label: str) -> str:
    """Name of the segment that stands for a marker's place."""
    return f"at {label}"


def with_points(subject: MarkerSubject) -> Body:
    """The subject's body with a segment at each marker's place, which moves with the marker's own segment."""
    body, points = subject.body, subject.points
    tree, names = body.tree, tuple(welded(label) for label in points.names)
    tree = replace(
        tree, segments=(*tree.segments, *names), parents=np.concatenate([tree.parents, points.segments]),
        offsets=np.concatenate([tree.offsets, points.points]),
    )  # fmt: skip
    scale = np.concatenate([body.segment_scale, body.segment_scale[points.segments]])
    return replace(body, tree=tree, joints=(*body.joints, *names), segment_scale=scale)
