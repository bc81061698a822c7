"""Masses of a body's segments and their centres, by published tables, for a person of this size and mass."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.body import Body
from kinefit.bodies.serial import load_body
from kinefit.bodies.surfaces import Surface, TaperedCylinder
from kinefit.errors import BodyError, check_choice

DE_LEVA, TABLES = "de_leva", ("de_leva", "de_leva_women", "de_leva_men", "dempster")
"""The default, which is the mean of women and men; all tables: de Leva 1996, and Dempster 1955 as in Winter 2009."""

_FILE = Path(__file__).with_name("segment_masses.toml")
_BODY_MASS_INDEX = (1.2, 1.6), (15.5, 24.5)  # [m], [kg/m²]: children's medians at 1.2 m (WHO 2007), adults' world mean
_INDEX_SPREAD = 0.17  # relative standard deviation of the index among adults, about that of ANSUR II (2014)
_PERSON_KG = 75.0  # of a body without a stature
_MAX_LENGTH_DIFFERENCE = 0.2  # relative, of a cylinder and its bone; of more it is no cylinder of the generic body
_DENSITY_KG_M3 = 1000.0  # of gear and machines: water
_MIN_WHOLE_SHARE = 0.5  # of the shares of a body that is a whole person, whose masses add up to the person's


@dataclass(frozen=True, eq=False)
class SegmentMasses:
    """Masses of a body's segments.

    Parameters
    ----------
    masses : (S,) [kg]; 0 of gear
    centres : (S, 3) [m] centre of mass in the segment's frame
    std : float [kg], standard deviation of the sum: 0 where the mass was given, inf of a machine whose mass was not
    """

    masses: NDArray
    centres: NDArray
    std: float


def segment_masses(body: Body, table: str = DE_LEVA) -> SegmentMasses:
    """Masses by a table of shares, for the body's mass, or that of people of its stature.

    A longer segment than the generic humanoid's, in proportion to the stature, has a larger share, and so has a thicker
    one. A segment that the table lacks (clavicle, toes, finger) takes a part of the next one inwards, by volumes. Of a
    body without a segment of the table (a machine) the surfaces are filled with water.

    Parameters
    ----------
    table : one of `TABLES`

    Raises
    ------
    BodyError
        No such table.
    """
    shares, centres, known = _shares(body, table)
    volumes = np.array([_volume([c for c in body.surfaces if c.segment == s]) for s in range(len(shares))])
    if not known.any():
        weights = volumes if volumes.any() else np.ones(len(shares))
        whole = body.mass or _DENSITY_KG_M3 * float(volumes.sum()) or _PERSON_KG
        return SegmentMasses(whole * weights / weights.sum(), _middles(body), 0.0 if body.mass else np.inf)
    whole, std = (body.mass, 0.0) if body.mass else _mass_of(body.stature)
    total = float(shares.sum())
    masses = whole * (shares / total if total > _MIN_WHOLE_SHARE else shares)
    return SegmentMasses(*_with_parts(body, masses, centres, known, volumes), std * float(masses.sum()) / whole)


def _mass_of(stature: float) -> tuple[float, float]:
    """[kg] of a person of a stature [m], with its standard deviation."""
    mass = float(np.interp(stature, *_BODY_MASS_INDEX)) * stature**2 if stature else _PERSON_KG
    return mass, _INDEX_SPREAD * mass


def _shares(body: Body, table: str) -> tuple[NDArray, NDArray, NDArray]:
    """Shares (S,), centres (S, 3) [m] in the segments' frames, and which segments (S,) the table has."""
    rows, generic = _table(table), load_body("humanoid")
    tall = body.stature / generic.stature if body.stature else 1.0
    size = len(body.tree.segments)
    shares, centres, known = np.zeros(size), _middles(body), np.zeros(size, bool)
    lengths, typical = body.segment_lengths(), generic.segment_lengths()
    for s, name in enumerate(body.tree.segments):
        stem, side = re.fullmatch(r"(.*?)(_[lr])?", name).groups("")  # type: ignore[union-attr]
        if stem not in rows or body.gear_scale[body.segment_scale[s]]:
            continue
        share, *points, way = rows[stem]
        known[s], shares[s] = True, 0.01 * share
        first, last = (_point(body, s, name, side) for name in points)
        if first is not None and last is not None:
            centres[s] = _on_axis(body, s, first, last, 0.01 * way)
        bones = [key for key in lengths.keys() & typical.keys() if key.startswith(f"{name}-")]
        if bones:
            longer = float(np.mean([lengths[key] / typical[key] for key in bones]))
            shares[s] *= longer / tall * _thicker(body, s, generic, generic.tree.segments.index(name), longer)
    return shares, centres, known


@lru_cache
def _table(name: str) -> dict[str, tuple[float, str, str, float]]:
    """{segment: (mass [%], from, to, centre [%])} of a table."""
    check_choice("table of masses", name, TABLES, BodyError)
    tables = tomllib.loads(_FILE.read_text("utf-8"))
    if name in tables:
        return dict(tables[name])
    women, men = tables["de_leva_women"], tables["de_leva_men"]
    return {s: (0.5 * (a + men[s][0]), first, last, 0.5 * (b + men[s][3])) for s, (a, first, last, b) in women.items()}


def _point(body: Body, segment: int, name: str, side: str) -> NDArray | None:
    """(3,) [m] a point of a table in the segment's frame, at rest; None where the body has none."""
    tree, marks = body.tree, body.landmarks
    if name == "end":
        return body.segment_ends().get(segment)
    places = dict(zip(body.joints, tree.rest)) | dict(zip(marks.names, body.points_rest(marks)))
    wanted = ([f"{name}{side}", f"{side[1:]}_{name}"] if side else []) + [name]
    found = [places[n] for n in wanted if n in places][:1]
    found = found or [places[n] for s in "lr" for n in (f"{name}_{s}", f"{s}_{name}") if n in places]
    return np.mean(found, axis=0) - tree.rest[segment] if found else None


def _on_axis(body: Body, segment: int, first: NDArray, last: NDArray, share: float) -> NDArray:
    """(3,) [m] at a share of the way between two points, on the axis of the segment's first cylinder."""
    at, way = first + share * (last - first), last - first
    for surface in body.surfaces:
        if surface.segment == segment and isinstance(surface, TaperedCylinder):
            start, axis = np.array(surface.start), np.subtract(surface.end, surface.start)
            along = float(axis @ way)
            if abs(along) > 0.5 * np.linalg.norm(axis) * np.linalg.norm(way):
                return np.asarray(start + float((at - start) @ way) / along * axis)
            break
    return np.asarray(at)


def _thicker(body: Body, segment: int, generic: Body, same: int, longer: float) -> float:
    """How much larger the sections are than those of the generic body at this length; 1 but for its own cylinders."""
    of = [[c for c in b.surfaces if c.segment == s] for b, s in ((body, segment), (generic, same))]
    if len(of[0]) != len(of[1]) or not all(isinstance(c, TaperedCylinder) for c in (*of[0], *of[1])):
        return 1.0
    a, b = (sum(float(rod(c)[2]) for c in surfaces) for surfaces in of)
    alike = abs(np.log(a / b / longer)) < _MAX_LENGTH_DIFFERENCE
    return _volume(of[0]) / _volume(of[1]) * b / a / longer**2 if alike else 1.0


def _with_parts(
    body: Body, masses: NDArray, centres: NDArray, known: NDArray, volumes: NDArray
) -> tuple[NDArray, NDArray]:
    """Masses and centres where segments that the table lacks have their part of the next one inwards, by volumes."""
    tree, owner = body.tree, np.arange(len(masses))
    gear = body.gear_scale[body.segment_scale]
    for part in range(len(masses)):
        if not known[part]:
            owner[part] = owner[tree.parents[part]] if part else 0
    out, at = masses.copy(), centres.copy()
    for s in np.flatnonzero(known):
        parts = np.flatnonzero((owner == s) & ~gear & (volumes > 0))
        if len(parts) < 2 or s not in parts:
            continue
        out[parts] = masses[s] * volumes[parts] / volumes[parts].sum()
        others = parts[parts != s]
        away = tree.rest[others] + centres[others] - tree.rest[s]
        at[s] = (masses[s] * centres[s] - out[others] @ away) / out[s]
    return out, at


def _middles(body: Body) -> NDArray:
    """(S, 3) [m] middle of the surfaces of each segment, in its frame; its joint without any."""
    out = np.zeros((len(body.tree.segments), 3))
    for s in range(len(out)):
        rods = [rod(c) for c in body.surfaces if c.segment == s]
        if rods:
            out[s] = np.average([r[0] for r in rods], axis=0, weights=[r[2] * r[3][0] * r[3][1] for r in rods])
    return out


def _volume(surfaces: list[Surface]) -> float:
    """[m³] of elliptical cylinders along the surfaces of a segment."""
    return sum(float(np.pi * length * radii[0] * radii[1]) for _, _, length, radii in map(rod, surfaces))


def rod(surface: Surface) -> tuple[NDArray, NDArray, float, NDArray]:
    """Middle (3,) [m], rotation (3, 3) from an upright cylinder, length [m] and half axes (2,) [m] along its x and z.

    Of a mesh: the elliptical cylinder in the box along its principal directions.
    """
    if isinstance(surface, TaperedCylinder):
        a, b, axis = surface.axes
        middle = 0.5 * np.add(surface.start, surface.end)
        return middle, np.stack([a, axis, -b], axis=1), surface.length, np.mean(surface.radii, axis=0)
    middle, axes, size = surface.box()
    R = np.stack([axes[1], axes[0], np.cross(axes[1], axes[0])], axis=1)
    return middle, R, float(size[0]), 0.5 * size[1:]
