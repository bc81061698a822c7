"""What tests of geometric algebra share: another library's algebra, which takes seconds to compile."""

import numpy as np
import pytest


@pytest.fixture(scope="session")
def clifford():
    """Matrix (32, 32) from our blades to those of the package clifford's G(4,1), and its layout."""
    module = pytest.importorskip("clifford", reason="the package clifford is not installed")
    layout, blades = module.Cl(4, 1)
    basis = [blades[f"e{i}"] for i in (1, 2, 3)]
    basis += [blades["e5"] + blades["e4"], 0.5 * (blades["e5"] - blades["e4"])]
    columns = []
    for blade in range(32):
        product = layout.scalar
        for i in range(5):
            product = product ^ basis[i] if blade >> i & 1 else product
        columns.append(product.value)
    return np.array(columns, float).T, layout
