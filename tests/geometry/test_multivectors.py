"""The algebra: its axioms, and the same products as two other libraries."""

import numpy as np
import pytest

from kinefit.errors import KinefitError
from kinefit.geometry import multivectors as mv
from kinefit.geometry.multivectors import I3, E, I, Multivector, anticommutator, commutator, e, e0, e1, e2, e3, stack

ALL = tuple(range(32))


def random_multivectors(seed, shape=(5,), blades=ALL):
    return Multivector(blades, np.random.default_rng(seed).normal(size=(len(blades), *shape)))


A, B, C = (random_multivectors(seed) for seed in range(3))


def close(a, b, tolerance=1e-12):
    np.testing.assert_allclose((a - b).values, 0, atol=tolerance)


def test_the_basis():
    for a in (e1, e2, e3):
        close(a * a, 1)
        close(a | e, 0)
        close(a | e0, 0)
        close((a ^ e) + (e ^ a), 0)
    close(e * e, 0)
    close(e0 * e0, 0)
    close(e | e0, -1)
    close(E * E, 1)
    close(I3 * I3, -1)
    close(I * I, -1)
    close((e2 - e) * e0 - (e2 ^ e0), 1 - E)


def test_axioms():
    close((A * B) * C, A * (B * C), 1e-11)
    close((A ^ B) ^ C, A ^ (B ^ C), 1e-11)
    close(A * (B + C), A * B + A * C)
    close(~(A * B), ~B * ~A)
    close(commutator(A, B) + anticommutator(A, B), A * B)
    close(2 * commutator(A, B), A * B - B * A)
    close(2.0 - A, -(A - 2.0))
    close(commutator(A, commutator(B, C)) + commutator(B, commutator(C, A)) + commutator(C, commutator(A, B)), 0, 1e-11)


def test_shapes_broadcast_and_are_indexed():
    a, b = random_multivectors(3, (4, 1), (1, 3)), random_multivectors(4, (7,), (2, 8, 24))
    product = a * b
    assert product.shape == (4, 7)
    close(product[2, 5], a[2, 0] * b[5])
    close(a[1] * b, product[1])
    close(np.arange(7.0) * a[0], a[0] * np.arange(7.0))
    assert (np.arange(7.0) * e1).shape == (7,)
    assert (e1 + np.arange(7.0)).shape == (7,)
    joined = stack([b[0], e1, b[1]])
    assert joined.shape == (3,)
    close(joined[1], e1)
    np.testing.assert_array_equal(b.dense()[:, 24], b.values[2])


def test_coefficients_by_blade():
    x = 3 * (e1 ^ e2) - 2 * (e ^ e0) + 7
    assert x.along(e2 ^ e1) == -3
    assert x.along(2 * E) == -1
    assert x.scalar == 7
    assert x.grade(2).scalar == 0
    assert x.grades == (0, 2)


def test_it_reads_as_it_is_written():
    assert str(e1 * e2 - 0.5 * E + 2) == "2 + e1∧e2 - 0.5 e∧e0"
    assert str(e1 - e1) == "0"
    assert str(-e2) == "-e2"
    assert "array (5,)" in str(A)


def test_coefficients_that_do_not_fit_their_blades():
    with pytest.raises(KinefitError, match="2 rows of coefficients for 1 blades"):
        Multivector((1,), np.zeros(2))


@pytest.mark.parametrize("name", ["*", "^", "|", "commutator", "anticommutator", "reverse", "dual"])
def test_the_same_products_as_clifford(clifford, name):
    to_theirs, layout = clifford
    ours = {
        "*": lambda a, b: a * b, "^": lambda a, b: a ^ b, "|": lambda a, b: a | b, "commutator": commutator,
        "anticommutator": anticommutator, "reverse": lambda a, b: ~a, "dual": lambda a, b: a * -I,
    }[name](A, B)  # fmt: skip
    theirs = {
        "*": lambda a, b: a * b, "^": lambda a, b: a ^ b, "|": lambda a, b: a | b,
        "commutator": lambda a, b: 0.5 * (a * b - b * a), "anticommutator": lambda a, b: 0.5 * (a * b + b * a),
        "reverse": lambda a, b: ~a, "dual": lambda a, b: a * layout.pseudoScalar.inv(),
    }[name]  # fmt: skip
    for k in range(5):
        a, b = (layout.MultiVector(to_theirs @ x[k].dense()) for x in (A, B))
        np.testing.assert_allclose(to_theirs @ ours[k].dense(), theirs(a, b).value, atol=1e-12)


def test_the_same_products_as_kingdon():
    kingdon = pytest.importorskip("kingdon", reason="the package kingdon is not installed")
    algebra = kingdon.Algebra(4, 1)
    x1, x2, x3, p, m = (algebra.blades[f"e{i}"] for i in range(1, 6))
    basis = [x1, x2, x3, p + m, 0.5 * (m - p)]
    rows = np.array([[float(getattr(vector, f"e{j}")) for j in range(1, 6)] for vector in basis])  # ours to theirs
    a, b = random_multivectors(5, (9,), (1, 2, 4, 8, 16)), random_multivectors(6, (9,), (1, 2, 4, 8, 16))
    c = random_multivectors(7, (9,), (1, 2, 4, 8, 16))
    ta, tb, tc = (algebra.vector(rows.T @ v.values) for v in (a, b, c))
    close(Multivector((0,), np.asarray((ta * tb * tc * ta).e)[None]), (a * b * c * a).grade(0), 1e-11)
    close(Multivector((0,), np.asarray(((ta ^ tb ^ tc) | (tc ^ tb ^ ta)).e)[None]), (a ^ b ^ c) | (c ^ b ^ a), 1e-11)
    theirs = (ta * tb * ~(ta * tb)).grade(0).e
    np.testing.assert_allclose(theirs, (a * b * ~(a * b)).scalar, atol=1e-11)
    bivector, ours = ta.cp(tb), commutator(a, b)
    np.testing.assert_allclose((bivector * (tb ^ tc)).grade(0).e, (ours * (b ^ c)).scalar, atol=1e-11)


def test_every_product_of_blades_is_in_the_plan():
    for a in ALL:
        for b in ALL:
            left, right = Multivector((a,), np.ones(1)), Multivector((b,), np.ones(1))
            assert len(mv._blade_product(a, b)) in (0, 1, 2)
            close(left * right, commutator(left, right) + anticommutator(left, right))
