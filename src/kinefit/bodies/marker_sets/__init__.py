"""The catalogue of marker sets: labels, segments, positions on a body; and the matching of labels."""

from kinefit.bodies.marker_sets.placement import (
    MarkerPlacement,
    find_placement,
    ignored_labels,
    known_set,
    placed_set_names,
    placement,
)
from kinefit.bodies.marker_sets.sets import (
    GIVE,
    LANDMARK_SPREAD,
    MIN_COMMON_LABELS,
    RANGE,
    SIDES,
    MarkerSet,
    SetSegment,
    bare,
    find_marker_set,
    load_marker_set,
    marker_set_names,
    matched,
    read_sides,
    side_pairs,
    subject_of,
)

__all__ = [
    "GIVE", "LANDMARK_SPREAD", "MIN_COMMON_LABELS", "RANGE", "SIDES", "MarkerPlacement", "MarkerSet", "SetSegment",
    "bare", "find_marker_set", "find_placement", "ignored_labels", "known_set", "load_marker_set", "marker_set_names",
    "matched", "placed_set_names", "placement", "read_sides", "side_pairs", "subject_of",
]  # fmt: skip
