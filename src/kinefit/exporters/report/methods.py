"""Methods paragraph and settings of a motion, to cite and to repeat it, and the table of body lengths."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib import metadata
from typing import Any

import numpy as np

from kinefit.bodies import Body
from kinefit.bodies.motion import SHOWN_UNITS, Motion
from kinefit.exporters.report import page as p
from kinefit.exporters.report.fit import overall_median, sensor_fits
from kinefit.exporters.tables import split_side
from kinefit.findings import listed
from kinefit.readers.plugins import KEYPOINTS

_LIFTED = "lifted "  # before a camera's name: its own landmarks in 3D, by a network, and no other sensor
_BUILT_IN_DETECTOR = "MediaPipe's pose networks as kinefit runs them (Bazarevsky et al. 2020, BlazePose)"


def methods(motion: Motion, date: str, doubtful: int) -> list[p.Html]:
    """A paragraph for a paper and the same as JSON; only what the motion and its provenance hold."""
    text = " ".join(methods_sentences(motion, doubtful))
    facts = {
        "Body": f"{motion.body.name}, {len(motion.body.tree.coordinates)} angles",
        "Sensors": f"{len([name for name in motion.residuals if not name.startswith(_LIFTED)])}",
        "Quality, mean (0–1)": f"{motion.quality.mean():.2f}", "Quality, lowest": f"{motion.quality.min():.2f}",
    }  # fmt: skip
    return [
        p.facts(facts),
        p.paragraph("To paste into a paper:", small=True), p.quote(text),
        p.paragraph(
            "Error bars are standard deviations. They include jitter and systematic errors of the keypoints, "
            "shifts of whole images, and the uncertainty of the body's lengths. They exclude the scale of the "
            "calibration and errors that all cameras share.", small=True),
        p.folded("All settings, as JSON", p.code(json.dumps(summary(motion, date), indent=2, ensure_ascii=False))),
    ]  # fmt: skip


def methods_sentences(motion: Motion, doubtful: int) -> list[str]:
    """The sentences of the methods paragraph."""
    provenance, body = motion.provenance, motion.body
    pixels = [name for name, r in motion.residuals.items() if r.unit == "px"]
    places = [name for name, r in motion.residuals.items() if r.unit == "m" and not name.startswith(_LIFTED)]
    out = [
        f"The motion \"{motion.name}\" ({len(motion)} frames at {motion.rate:g} Hz) was estimated with kinefit "
        f"{provenance.get('kinefit', provenance.get('version', _version()))}."
    ]  # fmt: skip
    out += [text for text in (_cameras(provenance, pixels), _markers(places), _calibration(provenance)) if text]
    of = "those found for the subject" if motion.residuals else "given"
    stature = f" (stature of the model {body.stature:.2f} m)" if body.stature else ""
    out.append(
        f"The body model \"{body.name}\" has {len(body.tree.segments)} rigid segments and {len(body.tree.coordinates)} "
        "joint coordinates, named and signed as in OpenSim (Rajagopal et al. 2016, IEEE TBME 63:2068); its lengths are "
        f"{of}{stature}."
    )
    if motion.residuals:
        out.append("All measurements were fitted together by robust weighted least squares over the joint coordinates.")
    out += _settings(provenance)
    for unit in ("px", "m"):
        median = overall_median(motion, unit)
        if np.isfinite(median):
            fits = [f for f in sensor_fits(motion) if f.unit == SHOWN_UNITS[unit][1]]
            count = sum(f.count for f in fits)
            left = sum(f.count * f.left_out for f in fits) / max(count, 1)
            out.append(
                f"The median residual is {median:.1f} {SHOWN_UNITS[unit][1]} over {count} measured points, of which "
                f"{100 * left:.1f} % were rejected as outliers."
            )
    flagged = {0: "No moment was", 1: "One moment was"}.get(doubtful, f"{doubtful} moments were")
    return [*out, f"{flagged} flagged as doubtful."]


def summary(motion: Motion, date: str) -> dict[str, Any]:
    """What a program needs to know about a motion: numbers of its fit and the whole provenance."""
    sensors = {
        f.name: {
            "median": _number(f.median), "unit": f.unit, "measured_points": f.count,
            "left_out": round(f.left_out, 4), "shift": [_number(v) for v in f.shift], "swapped_frames": f.swapped,
        }
        for f in sensor_fits(motion)
    }  # fmt: skip
    return {
        "name": motion.name, "report_date": date, "kinefit": _version(), "frames": len(motion), "rate_hz": motion.rate,
        "up": motion.up, "body": motion.body.name, "stature_m": _number(motion.body.stature),
        "quality_mean": _number(motion.quality.mean()), "quality_lowest": _number(motion.quality.min()),
        "sensors": sensors, "provenance": _plain(motion.provenance),
    }  # fmt: skip


def lengths_table(motion: Motion) -> p.Html:
    """Distances from joint to joint; left and right in one row, with deviations where the provenance has them."""
    stds = motion.provenance.get("length_std_m", {})
    cells = []
    for name, found in joint_distances(motion.body).items():
        row = dict.fromkeys(("left", "", "right"), "")
        for side, (length, ends) in found.items():
            std = stds.get(ends)
            row[side] = f"{length:.1f}"
            row[side] += f" ± {100 * std:.1f}" if isinstance(std, float) and np.isfinite(std) else ""
        cells.append((name, *row.values()))
    return p.table(["joint to joint [cm]", "left", "middle", "right"], cells)


def joint_distances(body: Body) -> dict[str, dict[str, tuple[float, str]]]:
    """Name of two joints, without the side -> side -> their distance [cm] and "segment-segment"."""
    tree, out = body.tree, dict[str, dict[str, tuple[float, str]]]()
    for child, parent in enumerate(tree.parents):
        length = float(np.linalg.norm(tree.offsets[child]))
        if parent >= 0 and length > 1e-6:
            ends = [split_side(joint) for joint in (body.joints[parent].removeprefix("ground_"), body.joints[child])]
            found = 100 * length, f"{tree.segments[parent]}-{tree.segments[child]}"
            out.setdefault(" to ".join(stem for stem, _ in ends), {})[ends[1][1]] = found
    return out


def _cameras(provenance: Mapping[str, Any], names: list[str]) -> str:
    if not names:
        return ""
    keypoints = [entry for entry in provenance.get("keypoints", []) if isinstance(entry, Mapping)]
    formats = [(str(e.get("format", "")), e.get("set") or "") for e in keypoints]
    summaries = {name: KEYPOINTS.get(name).summary for name in KEYPOINTS.built_in} | {"detect": _BUILT_IN_DETECTOR}
    kinds = dict.fromkeys(f"{summaries.get(name, name)} {points}".strip() for name, points in formats)
    accuracies = sorted({float(e["accuracy"]) for e in keypoints if isinstance(e.get("accuracy"), int | float)})
    text = f"2D keypoints {f'({listed([k for k in kinds if k], 4)}) ' if any(kinds) else ''}of {listed(names, 12)}"
    stated = f" with a stated standard deviation of {listed([f'{a:g}' for a in accuracies])} px" if accuracies else ""
    return f"{text} were used{stated}."


def _markers(names: list[str]) -> str:
    return f"Markers of {listed(names, 4)} were used." if names else ""


def _calibration(provenance: Mapping[str, Any]) -> str:
    found = provenance.get("calibration")
    if not isinstance(found, Mapping) or "file" not in found:
        return ""
    digest = f" (SHA-256 {str(found['sha256'])[:16]}…)" if found.get("sha256") else ""
    return f"The calibration of the cameras was {found['file']}{digest}."


def _settings(provenance: Mapping[str, Any]) -> list[str]:
    out = []
    smoothing = provenance.get("smoothing")
    if smoothing:
        of = smoothing if isinstance(smoothing, Mapping) else {}
        lasts = f" that last {of['acceleration_memory']:g} s" if "acceleration_memory" in of else ""
        out.append(
            f"All frames were estimated together, with a prior of random joint accelerations{lasts}{_estimated(of)}."
        )
    if isinstance(provenance.get("tracking"), Mapping):
        out.append(f"Settings of the tracking: {_listing(provenance['tracking'])}.")
    if provenance.get("height"):
        out.append(f"The subject's height was given as {provenance['height']:g} m.")
    return out


def _estimated(smoothing: Mapping[str, Any]) -> str:
    """Values that smoothing estimated from the take."""
    parts = ["the size of the accelerations"] if isinstance(smoothing.get("acceleration"), Mapping) else []
    sigma = smoothing.get("pixel_sigma")
    values = [v for found in sigma.values() for v in found.values()] if isinstance(sigma, Mapping) else []
    if values:
        parts.append(f"the standard deviation of every keypoint (median {np.median(values):.1f} px)")
    return f"; {listed(parts)} {'was' if len(parts) == 1 else 'were'} estimated from the take" if parts else ""


def _listing(settings: Mapping[str, Any]) -> str:
    def value(v: Any) -> str:
        return f"{v:.4g}" if isinstance(v, float) else str(v)

    plain = {k.replace("_", " "): v for k, v in settings.items() if not isinstance(v, Mapping | list)}
    return ", ".join(f"{k} {value(v)}" for k, v in plain.items())


def _number(value: Any) -> float | None:
    return float(f"{float(value):.6g}") if np.isfinite(value) else None


def _plain(value: Any) -> Any:
    return json.loads(p.to_json(value))


def _version() -> str:
    try:
        return metadata.version("kinefit")
    except metadata.PackageNotFoundError:  # a checkout that is not installed
        return "of unknown version"
