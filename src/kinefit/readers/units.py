"""Units of length and time, as files and people spell them."""

from __future__ import annotations

from typing import Any

LENGTHS = {
    "m": 1.0, "meters": 1.0, "metres": 1.0, "meter": 1.0, "metre": 1.0, "dm": 0.1, "cm": 0.01, "centimeters": 0.01,
    "centimetres": 0.01, "mm": 0.001, "millimeters": 0.001, "millimetres": 0.001, "millimeter": 0.001,
    "millimetre": 0.001, "inch": 0.0254, "in": 0.0254, "inches": 0.0254, "ft": 0.3048,
}  # fmt: skip
"""{unit: metres}."""

TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
"""{unit: seconds}."""


def worth(unit: Any, units: dict[str, float]) -> float | None:
    """Value of a unit in metres or seconds, ignoring case; None if it is not among the `units`."""
    return units.get(unit.strip().lower()) if isinstance(unit, str) else None
