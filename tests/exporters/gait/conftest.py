"""A child's walk over two real plates, fitted once."""

import pytest

from kinefit import fit_marker_subject, fit_markers, load_body, read_markers


@pytest.fixture(scope="session")
def walk(data_dir):
    """The motion, with its plates."""
    markers = read_markers(data_dir("gait_biomechzoo") / "HC030A" / "straight.c3d")
    return fit_markers(fit_marker_subject(load_body("humanoid"), markers, frames=12), markers, smooth=False)
