"""Gruebler's count, the rank of what closes a body, its mobility by finite steps: of all bodies with gear."""

from __future__ import annotations

from benchmarks.figures import figure
from kinefit.bodies import catalogue, load_body
from kinefit.solving.mobility import mobility


def run() -> None:
    """Print the figures: mobility is told by finite steps, and the rank by singular values."""
    for name in catalogue():
        body = load_body(name)
        if not body.closures:
            continue
        m = mobility(body)
        figure(f"{name}: rank of the closures' Jacobian", m.rank, "equations", f"== {m.open_dofs - m.mobility}")
        figure(f"{name}: mobility, beside Gruebler's count", m.mobility, "freedoms", f"== {m.gruebler}")
        for line in m.redundant:
            print(f"  over-constrained: {line}")
