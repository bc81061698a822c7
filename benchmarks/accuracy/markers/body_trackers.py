"""Trackers on the body, made of real marker plates: ten poses against the fit to all 61 markers (P2-10).

    python -m benchmarks markers body_trackers

A person moves with plates of three markers on thighs, shanks, upper arms and forearms. Each plate shows an orientation,
as a magnetic tracker does, and the marker at the nearest feature point of H-Anim its place. The mounts are known from
the first tenth of the take, as from a calibration pose. The take of trackers starts with the body of the fit to all
markers; two others know neither body nor start, and the second no mounts either. Printed is how far joint centres are
from the fit to all markers in the other frames.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, data, figure
from kinefit import Motion, track_take, write_motion
from kinefit.geometry import se3
from kinefit.observations import Markers
from kinefit.readers.markers import read_markers
from kinefit.readers.take.file import read_take

FILE = "nimblephysics/data__osim__WeirdFormatTests__markers.trc"
PLATES = {  # tracker: markers that show its orientation, the marker at its place, and the landmark there
    "pelvis": (("Pelvis1", "Pelvis2", "Pelvis3"), "RASI", "r_asis"),
    "thorax": (("C7", "T10", "STRN", "CLAV"), "C7", "cervicale"),
    **{
        f"{part}_{s.lower()}": (tuple(f"{s}{name}" for name in names), f"{s}{at}", f"{s.lower()}_{landmark}")
        for s in "RL"
        for part, names, at, landmark in (
            ("upperarm", ("UA1", "UA2", "UA3"), "ELB", "humeral_lateral_epicondyle"),
            ("forearm", ("LA1", "LA2", "LA3"), "WRA", "radial_styloid"),
            ("thigh", ("THI", "THI2", "THI3"), "KNE", "femoral_lateral_epicondyle"),
            ("shank", ("TIB", "TIB2", "TIB3"), "ANK", "lateral_malleolus"),
        )
    },
}  # fmt: skip
CALIBRATION = 0.1  # of the frames, in which mounts are known


def run() -> None:
    """Print the figures."""
    folder = data("markers")
    apart: dict[bool, float] = {}
    unknown: dict[str, float] = {}
    if folder is not None:
        with tempfile.TemporaryDirectory() as where:
            markers = read_markers(folder / FILE)
            whole = _tracked(Path(where), f'[[markers]]\nfile = "{folder / FILE}"\n', markers)
            write_motion(whole, Path(where) / "motion.npz")
            for turned in (True, False):
                table = _trackers(Path(where), markers, whole, turned)
                apart[turned] = _apart(whole, _tracked(Path(where), table, markers))
            (Path(where) / "motion.npz").unlink()
            table = _trackers(Path(where), markers, whole, True)
            free = "\n".join(line for line in table.splitlines() if not line.startswith("mounts"))
            for label, lines in (("start", table), ("mounts", f"{free}\nmount_sigma = 180\n")):
                unknown[label] = _apart(whole, _tracked(Path(where), lines, markers))
    for turned, label in ((True, "places and orientations"), (False, "places alone")):
        if turned in apart:
            print(f"{len(PLATES)} trackers, {label}: joint centres {apart[turned]:.1f} mm apart", flush=True)
    reason = "" if apart else "no recording"
    figure("worn_trackers_mm", apart.get(True), "mm of joint centres from the fit to all markers", "<= 20", reason)
    figure("worn_trackers_start_mm", unknown.get("start"), "mm, body and start unknown", "<= 18", reason)
    figure("worn_trackers_mounts_mm", unknown.get("mounts"), "mm, mounts unknown as well", "<= 25", reason)
    gain = apart[True] / apart[False] if apart else None
    figure("worn_trackers_turns", gain, "times the distance without orientations", "<= 1", reason)


def _tracked(where: Path, tables: str, markers: Markers) -> Motion:
    """The motion of a take in which some tables stand."""
    start = f'start = "{where}/motion.npz"\n' if (where / "motion.npz").exists() else ""
    frames = f"frames = [0, {amount(len(markers), 30)}]\n"
    (where / "take.toml").write_text(f'[take]\nrate = {markers.rate}\nup = "y"\n{frames}{start}{tables}')
    return track_take(read_take(where / "take.toml"))[0]


def _trackers(where: Path, markers: Markers, whole: Motion, turned: bool) -> str:
    """The table of a take, and its file: what plates show in every frame."""
    count, x = len(whole), {name: markers.positions[:, k] for k, name in enumerate(markers.names)}
    Ts, body, rows, mounts = whole.body.tree.segment_poses(whole.Ts_world_root, whole.angles), whole.body, [], []
    for name, (plate, at, landmark) in PLATES.items():
        seen = np.stack([x[m][:count] for m in plate], axis=1)
        R = _orientations(seen)
        segment = body.landmarks.segments[body.landmarks.index(landmark)]
        few = max(int(CALIBRATION * count), 1)
        M = se3.nearest_rotation(np.nansum(Ts[:few, segment, :3, :3].swapaxes(1, 2) @ R[:few], axis=0))
        mounts.append(f"{name} = {np.degrees(se3.log_so3(M)).round(4).tolist()}")
        for i in np.flatnonzero(np.isfinite(x[at][:count]).all(axis=1)):
            known = turned and np.isfinite(R[i]).all()
            q = ",".join(f"{v:.8f}" for v in se3.quaternion(R[i])) if known else ",,,"
            rows.append(f"{i / markers.rate:.6f},{name}," + ",".join(f"{v:.6f}" for v in x[at][i]) + f",{q}")
    (where / "trackers.csv").write_text("time_s,tracker,x,y,z,qw,qx,qy,qz\n" + "\n".join(rows) + "\n")
    points = ", ".join(f'{name} = "{landmark}"' for name, (_, _, landmark) in PLATES.items())
    return f'[[tracker]]\nfile = "trackers.csv"\npoints = {{ {points} }}\nmounts = {{ {", ".join(mounts)} }}\n'


def _orientations(seen: NDArray) -> NDArray:
    """(F, 3, 3) rotations of a plate (F, M, 3) from its first whole frame; NaN where a marker is not seen."""
    whole = np.flatnonzero(np.isfinite(seen).all(axis=(1, 2)))
    rest = seen[whole[0]] - seen[whole[0]].mean(axis=0)
    out = np.full((len(seen), 3, 3), np.nan)
    for i in whole:
        out[i] = se3.nearest_rotation((seen[i] - seen[i].mean(axis=0)).T @ rest)
    return out


def _apart(whole: Motion, found: Motion) -> float:
    """Mean distance [mm] of joint centres after the calibration."""
    first = int(CALIBRATION * len(whole))
    return 1e3 * float(np.linalg.norm(whole.joint_centres - found.joint_centres, axis=2)[first:].mean())
