"""Errors of results against ground truth."""

from kinefit.simulation.evaluation.sequences import (
    ErrorBarCoverage,
    angle_errors,
    coverage,
    coverage_of_groups,
    joint_errors,
    orientation_errors,
)

__all__ = ["ErrorBarCoverage", "angle_errors", "coverage", "coverage_of_groups", "joint_errors", "orientation_errors"]
