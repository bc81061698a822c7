"""The morphs of P1 3 as published, in conformal geometric algebra; `morphing` has their fast form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.geometry.cga import between, interpolate, translator, vector, versor
from kinefit.geometry.multivectors import Multivector


def joint_motion(Psi: Multivector, other: Multivector, t: ArrayLike) -> Multivector:
    """Interpolate a joint from Ψ (t = 0) to Ψ' (t = 1), t (N,): Mₜ Ψ M̃ₜ with Mₜ = exp(−½ t 2π Ξ) (P1 3.1)."""
    M_t = interpolate(between(Psi, other), t)
    return (M_t * Psi * ~M_t).grade(2)


def global_morph(
    F_1: Multivector, F_2: Multivector, t: float, omega: Callable[[float], float] = lambda t: 1.0 - t
) -> Multivector:
    """F_t = F_1 ω(t) + F_2 (1 − ω(t)) (P1 3.2), a number t: surface 1 at 0, surface 2 at 1; Euclidean vectors."""
    return F_1 * omega(t) + F_2 * (1.0 - omega(t))


def radial_translator(r: NDArray, t: ArrayLike) -> Multivector:
    """T_r = 1 + ½ e t r (P1 3.3) for every node: r (V,) from `morphing.radial_basis`, t (3,) [m] in any direction."""
    return translator(vector(np.asarray(r)[..., None] * np.asarray(t, float)))


def local_morph(F: Multivector, r: NDArray, scale: float, theta: float, direction: ArrayLike) -> Multivector:
    """T_r F T̃_r with t = λ θ r d (P1 3.3): points F (V,), r (V,), λ [m/rad], θ [rad], d (3,) unit."""
    return versor(radial_translator(r, scale * theta * np.asarray(direction, float)), F)
