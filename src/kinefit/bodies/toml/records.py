"""Records of a body file, and the merge of a body file with its base."""

from __future__ import annotations

from os import PathLike

import msgspec

from kinefit.bodies.morphs.morph_files import MorphRecord
from kinefit.bodies.surfaces.files import SurfaceRecord
from kinefit.bodies.surfaces.skins.skin_files import SkinRecord
from kinefit.bodies.toml.closures import ClosureRecord, DimensionRecord
from kinefit.errors import BodyError

Vector = tuple[float, float, float]


class JointRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`joint` of a segment."""

    name: str
    type: str
    at: Vector = (0.0, 0.0, 0.0)
    axes: list[str | Vector] = []
    coordinates: list[str] = []
    range: list[tuple[float, float]] = []
    usual: list[float] = []
    spread: list[float] = []


class SegmentRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One `[[segment]]`."""

    name: str
    joint: JointRecord
    parent: str | None = None
    scale: str | None = None
    surface: SurfaceRecord | list[SurfaceRecord] | None = None
    names: dict[str, str] = {}


class CouplingRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One `[[coupling]]`."""

    name: str
    of: dict[str, float]
    spread: float


class PointRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A named point on a segment."""

    segment: str
    at: Vector


class HeadRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`[body]`; missing values come from the `base`, if there is one."""

    name: str
    base: str | None = None
    stature: float | None = None
    mirror: bool | None = None


def stature_of(value: float, source: str | PathLike[str] | None = None) -> float:
    """Check a stature [m] as stated in a file; 0 if not stated.

    Raises
    ------
    BodyError
        A number that is no stature.
    """
    if not 0 <= value <= _TALLEST:
        raise BodyError(f"a stature of {value:g} m", file=source, place="body.stature", remedy="Give metres.")
    return value


_TALLEST = 100.0  # [m]: of machines, too


class MarkerSetRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One `[markers.SET]`."""

    points: list[str] = []
    placed: dict[str, PointRecord] = {}


class FileRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A body file."""

    body: HeadRecord
    segment: list[SegmentRecord] = []
    usual: dict[str, float] = {}
    coupling: list[CouplingRecord] = []
    closure: list[ClosureRecord] = []
    dimension: list[DimensionRecord] = []
    morph: list[MorphRecord] = []
    skin: SkinRecord | None = None
    landmarks: dict[str, PointRecord] = {}
    keypoints: dict[str, dict[str, str]] = {}
    markers: dict[str, MarkerSetRecord] = {}


def merged(base: FileRecord, own: FileRecord) -> FileRecord:
    """Merge a file into its base: segments and entries of the same name are replaced, all others added."""
    new = {s.name: s for s in own.segment}
    segments = [new.pop(s.name, s) for s in base.segment]
    couplings = {c.name: c for c in base.coupling + own.coupling}
    closures = {c.name: c for c in base.closure + own.closure}
    dimensions = {d.name: d for d in base.dimension + own.dimension}
    head = msgspec.structs.replace(
        own.body,
        base=None,
        stature=base.body.stature if own.body.stature is None else own.body.stature,
        mirror=base.body.mirror if own.body.mirror is None else own.body.mirror,
    )
    return FileRecord(
        body=head,
        segment=segments + list(new.values()),
        usual=base.usual | own.usual,
        coupling=list(couplings.values()),
        closure=list(closures.values()),
        dimension=list(dimensions.values()),
        morph=base.morph + own.morph,
        skin=own.skin or base.skin,
        landmarks=base.landmarks | own.landmarks,
        keypoints=base.keypoints | own.keypoints,
        markers=base.markers | own.markers,
    )


_EXTENDS = {"MEDIAPIPE_75": "MEDIAPIPE_33", "BODY_25_HANDS": "BODY_25", "COCO_WHOLEBODY_133": "COCO_17"}
"""Keypoint sets with hands, and the sets that they extend."""


def extended(sets: dict[str, dict[str, str]]) -> dict[str, dict[str, str]]:
    """Keypoint sets of a file, and the sets that extend them, without hands if the body has no fingers."""
    return sets | {name: sets[of] | sets.get(name, {}) for name, of in _EXTENDS.items() if of in sets}
