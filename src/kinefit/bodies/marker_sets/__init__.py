"""The catalogue of marker sets: labels, segments, positions on a body; and the matching of labels."""

from kinefit.bodies.marker_sets.labels import bare, matched, subject_of
from kinefit.bodies.marker_sets.placement import MarkerPlacement, find_placement, known_set, placed_set_names, placement
from kinefit.bodies.marker_sets.sets import (
    GIVE,
    MIN_COMMON_LABELS,
    RANGE,
    MarkerSet,
    SetSegment,
    find_marker_set,
    load_marker_set,
    marker_set_names,
)

__all__ = [
    "GIVE", "MIN_COMMON_LABELS", "RANGE", "MarkerPlacement", "MarkerSet", "SetSegment", "bare", "find_marker_set",
    "find_placement", "known_set", "load_marker_set", "marker_set_names", "matched", "placed_set_names",
    "placement", "subject_of",
]
