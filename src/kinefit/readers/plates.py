"""Force plates of C3D files, types 1 to 4, and ground forces of OpenSim's `.mot`.

Source: C3D User Guide, Motion Lab Systems, 2008, "The FORCE_PLATFORM group". Files contradict it and each other:
whether a force acts on the plate or on the person, the sign of ORIGIN, the unit of moments. What presses on a plate is
decided by the load, which never lifts a plate; the unit of moments by where the centre of pressure then is.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit._files import no_column, read_text
from kinefit.errors import FileError
from kinefit.geometry.force_plates import LEAST_LOAD, ForcePlate
from kinefit.readers.c3d_file import C3d

_CHANNELS = {1: 6, 2: 6, 3: 8, 4: 6}  # of each type
_PER_UNIT = {"": 1.0, "n": 1.0, "nt": 1.0, "nm": 1.0, "nmm": 1e-3, "ntmm": 1e-3, "ncm": 1e-2, "ntm": 1.0, "kn": 1e3}
_FACTORS = 1e-3, 1e3  # by which a stated unit of moments is wrong, if it is
_SHARE_INSIDE, _SHARE_OUTSIDE = 0.9, 0.5  # of loaded samples with the centre of pressure on the plate: surely; not
_RESTS = 0.1  # of the range of the load, that a plate shows at rest
_MAX_PLACE = 50.0  # [m] from a laboratory's origin: millimetres that are read as metres
_MARGIN = 0.05  # [m] beyond a plate's edge: errors of a centre of pressure at light loads
_MOT_REMEDY = "Give a .mot of OpenSim: a line endheader, then time and ground_force_vx, _vy, _vz, _px, _py, _pz."
_MIN_SIDE = 0.05  # [m]: corners nearer to each other are none


@dataclass(frozen=True, eq=False)
class PlatesRead:
    """Plates of a file, and what is worth saying of them."""

    plates: tuple[ForcePlate, ...]
    notes: tuple[str, ...]


def read_plates(c3d: C3d, metres: float, up: str | None = None) -> PlatesRead:
    """The force plates of a C3D file, in the world of its points.

    Parameters
    ----------
    metres : float [m] of the unit of points
    up : vertical axis of the world of the points; default: the axis that a plate's surface is nearest to facing

    Raises
    ------
    FileError
        Channels or corners that the file does not have.
    """
    used = c3d.parameters.get("FORCE_PLATFORM:USED")
    try:
        count = int(used.flat[0]) if isinstance(used, np.ndarray) and used.size else 0
        with np.errstate(all="ignore"):  # what a damaged file then has is left out
            return _read(c3d, count if c3d.analog.size else 0, metres, up)
    except (IndexError, ValueError, TypeError, OverflowError) as error:
        remedy = "Correct the groups FORCE_PLATFORM and ANALOG in a C3D editor such as Mokka."
        raise FileError(f"parameters do not fit together ({error})", place="FORCE_PLATFORM", remedy=remedy) from error


def _read(c3d: C3d, count: int, metres: float, up: str | None) -> PlatesRead:
    """So many plates."""
    plates, notes, samples = list[ForcePlate](), list[str](), _samples(c3d) if count > 0 else np.zeros((0, 0))
    for k in range(count):
        kind = int(_of(c3d, "TYPE", k))
        if kind not in _CHANNELS:
            notes.append(f"force plate {k + 1} is of type {kind} and left out: types 1 to 4 are read")
            continue
        plate, said = _plate(c3d, k, kind, samples, metres, up)
        plates += [] if plate is None else [plate]
        notes += [f"force plate {k + 1}: {text}" for text in said]
    return PlatesRead(tuple(plates), tuple(notes))


def _of(c3d: C3d, name: str, k: int) -> NDArray:
    """Entry of plate `k` of a parameter, whose last axis counts plates."""
    value = c3d.parameters.get(f"FORCE_PLATFORM:{name}")
    if not isinstance(value, np.ndarray) or not value.ndim or value.shape[-1] <= k:
        remedy = "Correct the group FORCE_PLATFORM in a C3D editor such as Mokka, or set its USED to 0."
        raise FileError(f"no {name} of force plate {k + 1}", place=f"FORCE_PLATFORM:{name}", remedy=remedy)
    return np.asarray(value[..., k], float)


def _samples(c3d: C3d) -> NDArray:
    """(N, C) analog samples in their own units."""
    frames, width = c3d.analog.shape
    channels = width // c3d.samples
    raw = c3d.analog.reshape(frames * c3d.samples, channels).astype(float)
    numbers = {key: c3d.parameters.get(f"ANALOG:{key}") for key in ("SCALE", "OFFSET", "GEN_SCALE")}
    if "".join(map(str, c3d.parameters.get("ANALOG:FORMAT", []))).upper().startswith("UNSIGNED"):
        offset = numbers["OFFSET"]
        numbers["OFFSET"] = np.mod(offset.astype(float), 65536.0) if isinstance(offset, np.ndarray) else offset
    each = {
        key: np.resize(value.astype(float), channels) if isinstance(value, np.ndarray) and value.size else blank
        for (key, value), blank in zip(numbers.items(), (1.0, 0.0, 1.0))
    }
    return (raw - each["OFFSET"]) * each["SCALE"] * each["GEN_SCALE"]


def _plate(
    c3d: C3d, k: int, kind: int, samples: NDArray, metres: float, up: str | None
) -> tuple[ForcePlate | None, list[str]]:
    columns = _of(c3d, "CHANNEL", k)[: _CHANNELS[kind]].astype(int) - 1
    if len(columns) < _CHANNELS[kind] or columns.min() < 0 or columns.max() >= samples.shape[1]:
        raise FileError(
            f"force plate {k + 1} of type {kind} has the channels {(columns + 1).tolist()}, the file has "
            f"{samples.shape[1]}", place="FORCE_PLATFORM:CHANNEL", remedy="Correct CHANNEL, or TYPE, of this plate.",
        )  # fmt: skip
    corners = metres * _of(c3d, "CORNERS", k).T
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    if corners.shape != (4, 3) or not np.all(sides > _MIN_SIDE):
        return None, ["left out: it has no corners"]
    values = samples[:, columns]
    if kind == 4:
        values = values @ _of(c3d, "CAL_MATRIX", k).T * np.repeat([1.0, metres], 3)  # N, and N times the unit of points
    else:
        values = values * _units(c3d, columns, kind)
    zero, text = _baseline(c3d, values, kind)
    values, notes = values - zero, [text] * bool(text)
    placed = lambda values: _placed(kind, values, _of(c3d, "ORIGIN", k), metres, corners, up)
    rate, start = c3d.rate * c3d.samples, max(c3d.first_frame - 1, 0) / c3d.rate
    plate = ForcePlate(f"plate {k + 1}", corners, rate, start, *placed(values))
    if not (np.isfinite(plate.force).all() and np.isfinite(plate.moment).all()):
        return None, ["left out: its forces are not finite"]
    if share_inside(plate) < _SHARE_OUTSIDE:
        for factor in _FACTORS if kind in (2, 4) else ():
            other = replace(plate, moment=placed(values * np.repeat([1.0, factor], 3))[1])
            moves = np.ptp(np.nan_to_num(other.centre_of_pressure()), axis=0).max() > 1e-3
            if share_inside(other) > _SHARE_INSIDE and moves:
                said = "N mm" if factor > 1 else "N m"
                text = f"its moments are not in {said}, though the file says so: corrected by {factor:g}"
                return other, [*notes, text]
        return None, [*notes, "left out: its centre of pressure does not lie on it, by a wrong type, unit or corners"]
    return plate, notes


def _placed(
    kind: int, values: NDArray, origin: NDArray, metres: float, corners: NDArray, up: str | None
) -> tuple[NDArray, NDArray]:
    """Forces and moments (N, 3) along the world's axes on who stands on a plate, about the centre of its corners."""
    plain = ForcePlate("", corners, 1.0, 0.0, *_wrench(kind, values, origin, metres))
    axes = np.vstack([plain.axes, np.cross(*plain.axes)])
    vertical = "xyz".index(up[-1]) if up else int(np.argmax(np.abs(axes[2])))
    load = (plain.force @ axes)[:, vertical] * (-1.0 if up and up.startswith("-") else 1.0)
    sign = -1.0 if np.sum(load * np.abs(load)) < 0 else 1.0
    return sign * plain.force @ axes, sign * plain.moment @ axes


def share_inside(plate: ForcePlate) -> float:
    """Share of loaded samples whose centre of pressure lies on the plate; 1 of an unloaded plate."""
    at = plate.centre_of_pressure(5.0 * LEAST_LOAD)
    at = (at[np.isfinite(at).all(axis=1)] - plate.centre) @ plate.axes.T
    half = 0.5 * np.ptp((plate.corners - plate.centre) @ plate.axes.T, axis=0) + _MARGIN
    return float(np.mean(np.all(np.abs(at) < half, axis=1))) if len(at) else 1.0


def _units(c3d: C3d, columns: NDArray, kind: int) -> NDArray:
    """Factors to N and N m of plates whose channels are scaled; places of type 1 stay in the unit of points."""
    units = c3d.parameters.get("ANALOG:UNITS")
    names = [units[c] if isinstance(units, list) and c < len(units) else "" for c in columns]
    plain = (re.sub(r"[^a-z]", "", name.lower()) for name in names)
    factors = np.array([_PER_UNIT.get(name, 1.0) for name in plain])
    return np.where((kind == 1) & np.isin(np.arange(len(columns)), (3, 4)), 1.0, factors)


def _baseline(c3d: C3d, values: NDArray, kind: int) -> tuple[NDArray | float, str]:
    """Mean of the frames that ZERO names, where the plate bears no load in them; else 0, and why it is not used."""
    zero = c3d.parameters.get("FORCE_PLATFORM:ZERO")
    first, last = (int(v) for v in zero.flat[:2]) if isinstance(zero, np.ndarray) and zero.size >= 2 else (0, 0)
    load = values[:, 4:].sum(axis=1) if kind == 3 else values[:, 2]
    part = slice((first - 1) * c3d.samples, last * c3d.samples)
    if not 0 < first <= last or not len(load[part]):
        return 0.0, ""
    spread = float(np.ptp(load))
    if abs(load[part].mean()) > _RESTS * spread or load[part].std() > _RESTS * spread:
        return 0.0, f"frames {first} to {last}, which ZERO names, are under load and not taken for its zero"
    return values[part].mean(axis=0), ""


def _wrench(kind: int, v: NDArray, origin: NDArray, metres: float) -> tuple[NDArray, NDArray]:
    """Forces and moments (N, 3) about the surface's centre along the plate's axes."""
    o = metres * origin
    if kind == 1:
        force, at = v[:, :3], np.column_stack([v[:, 3:5], np.zeros(len(v))]) * metres
        return force, np.cross(at, force) + v[:, 5:6] * [0.0, 0.0, 1.0]
    if kind == 3:
        x12, x34, y14, y23, *z = v.T
        force = np.column_stack([x12 + x34, y14 + y23, sum(z)])
        a, b = o[0], o[1]
        moment = np.column_stack([
            b * (z[0] + z[1] - z[2] - z[3]), a * (-z[0] + z[1] + z[2] - z[3]), b * (x34 - x12) + a * (y14 - y23),
        ])  # fmt: skip
        o = np.array([0.0, 0.0, -abs(o[2])])
    else:
        force, moment = v[:, :3], v[:, 3:6]
    o = -o if o[2] > 0 else o  # from the sensor up to the surface, against the plate's z, which is down
    return force, moment + np.cross(force, o)


def read_force_file(path: Path) -> PlatesRead:
    """Ground forces of OpenSim's `.mot` or `.sto`: `ground_force_vx`, `_px` and `ground_torque_x`, with any prefix.

    The table has no corners: each plate is the rectangle that its centres of pressure need. The world is y up, in
    metres.

    Raises
    ------
    FileError
        No such table, columns that are missing, a cell that is no number.
    """
    lines = read_text(path, "the forces", remedy=_MOT_REMEDY).splitlines()
    start = next((k for k, line in enumerate(lines) if line.strip().lower() == "endheader"), None)
    if start is None or start + 2 >= len(lines):
        raise FileError("no line 'endheader' with a table below", file=path, remedy=_MOT_REMEDY)
    names, rows = lines[start + 1].split(), list[list[float]]()
    stems = [name.removesuffix("_vx") for name in names if name.endswith("_vx")]
    wanted = [f"{stem}_{kind}{axis}" for stem in stems for kind in "vp" for axis in "xyz"]
    missing = [name for name in ("time", *wanted) if name not in names]
    if missing or not stems:
        raise FileError(no_column(missing or ["ground_force_vx"], names), file=path, remedy=_MOT_REMEDY)
    for number, line in enumerate(lines[start + 2 :], start + 3):
        cells = line.split()
        if not cells:
            continue
        try:
            rows.append([float(cell) for cell in cells])
        except ValueError:
            raise FileError("a cell is no number", file=path, place=f"line {number}", remedy=_MOT_REMEDY) from None
        if len(cells) != len(names):
            problem = f"{len(cells)} cells for {len(names)} columns"
            raise FileError(problem, file=path, place=f"line {number}", remedy="Export or copy the file again.")
    stated = next((re.findall(r"\d+", line) for line in lines[:start] if line.strip().lower().startswith("nrows")), [])
    if stated and int(stated[0]) > len(rows):
        problem = f"the file is truncated: {len(rows)} of {stated[0]} rows can be read"
        raise FileError(problem, file=path, remedy="Export or copy the file again.")
    columns = dict(zip(names, np.array(rows).T))
    rate = _even_rate(columns["time"], path)
    found = [_of_table(stem, columns, rate, path) for stem in stems]
    return PlatesRead(tuple(plate for plate, _ in found), tuple(text for _, text in found if text))


def _even_rate(times: NDArray, path: Path) -> float:
    """Rate [Hz] of rows, of whose times (N,) [s] none is more than half a sample off."""
    rate = (len(times) - 1) / float(times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else np.nan
    off = np.abs((times - times[0]) * rate - np.arange(len(times)))
    if not np.all(off < 0.5):
        place = f"row {int(np.argmax(~(off < 0.5))) + 1}"
        raise FileError("times that are not evenly spaced", file=path, place=place, remedy="Export it without gaps.")
    return rate


def _of_table(stem: str, columns: dict[str, NDArray], rate: float, path: Path) -> tuple[ForcePlate, str]:
    """The plate of one set of columns, and what is worth saying of it."""
    force, at = (np.column_stack([columns[f"{stem}_{kind}{axis}"] for axis in "xyz"]) for kind in "vp")
    turning = stem.replace("force", "torque")
    names = [next((n for n in (f"{turning}_{a}", f"{turning}_m{a}") if n in columns), "") for a in "xyz"]
    torque = np.column_stack([columns[name] if name else np.zeros(len(force)) for name in names])
    up = int(np.argmax(np.square(np.nan_to_num(force)).sum(axis=0)))
    on_plate = np.sum(force[:, up] * np.abs(force[:, up])) < 0
    force, torque = (-force, -torque) if on_plate else (force, torque)
    stood = force[:, up] > LEAST_LOAD
    at = np.where(stood[:, None], at, 0.0)  # what stands there without load is no place
    for what, values in (("force", force), ("centre of pressure", at), ("torque", torque)):
        if not np.isfinite(values).all():
            place = f"row {int(np.argmax(~np.isfinite(values).all(axis=1))) + 1}, {stem}"
            raise FileError(f"a {what} that is no number", file=path, place=place, remedy="Export it without gaps.")
    if np.abs(at).max() > _MAX_PLACE:
        problem = f"a centre of pressure {np.abs(at).max():.0f} m from the origin"
        raise FileError(problem, file=path, place=stem, remedy="Give metres: OpenSim's unit.")
    used = at[stood] if stood.any() else np.zeros((1, 3))
    a, b = (up + 1) % 3, (up + 2) % 3
    corners = np.tile(used.mean(axis=0), (4, 1))
    for axis, signs in ((a, (1, -1, -1, 1)), (b, (1, 1, -1, -1))):
        low, high = used[:, axis].min() - _MARGIN, used[:, axis].max() + _MARGIN
        corners[:, axis] = [high if sign > 0 else low for sign in signs]
    centre = corners.mean(axis=0)
    plate = ForcePlate(stem, corners, rate, float(columns["time"][0]), force, torque + np.cross(at - centre, force))
    moment = np.where(stood[:, None], plate.moment, torque)
    return replace(plate, moment=moment), f"{stem}: forces on the plate, turned round" if on_plate else ""
