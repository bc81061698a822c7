"""Pose from regions as published by Rosenhahn, Schmaltz et al. (P3 2.3, 2.4, 3.2): densities, signs, rays, closures.

1. The projected body splits every image into two regions; the densities p₁, p₂ of their colours in CIELab are Parzen
   estimates, or mixtures of Gaussians (the paper leaves the form open).
2. Points of the silhouette with p₁ > p₂ are shifted along the outward normal, the others inwards (2.4.2).
3. Least squares gives the pose and the joint angles that move the body's points onto the rays of the shifted points
   (eqs. 6, 7). Closures of the body are appended to that system, with a strong factor (eqs. 18, 19).
4. This is repeated until the pose's average change over up to three iterations is below ε. Energy (8) is reported, not
   minimised.

The tracker (`[[region]]` in a take) uses the likelihood of all positions along a line instead of a sign, colour
histograms near each part of the contour and for parts of the body, robust weights, prediction, and quality.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces.mesh import BodyMesh
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.errors import ObservationError, check_choice
from kinefit.geometry.camera import Rig
from kinefit.papers._colour_densities import COLOURS, DENSITIES, colour_cells
from kinefit.solving import Rows, gauss_newton
from kinefit.solving.correspondences import point_rows
from kinefit.solving.correspondences.closures import closure_targets
from kinefit.solving.correspondences.contours.outlines import RimFinder, outline_rows

__all__ = ["RegionFit", "pose_from_regions", "track_regions"]


@dataclass(frozen=True, eq=False)
class RegionFit:
    """Result of one frame.

    Parameters
    ----------
    state : BodyState
    energy : float, (8) per pixel: the mean over all pixels of all images, in natural logarithms
    cycles : int, number of iterations
    converged : bool, whether the paper's rule ended them, not their largest number
    """

    state: BodyState
    energy: float
    cycles: int
    converged: bool


def pose_from_regions(
    body: Body, state: BodyState, rig: Rig, images: Mapping[str, ArrayLike], *, densities: str = "parzen",
    mesh: BodyMesh | None = None, finder: RimFinder | None = None, shift: float = 1.0, cycles: int = 60,
    epsilon: float = 1e-3, closure_factor: float = 10.0,
) -> RegionFit:  # fmt: skip
    """Estimate pose and joint angles from the colours inside and outside of the body (P3 2.4), with closures (P3 3.2).

    Parameters
    ----------
    state : BodyState, initial: the last frame's.
    images : camera -> (H, W, 3) uint8 RGB, in the size of the calibration.
    densities : form of p₁ and p₂, "parzen" or "mixture".
    mesh, finder : of the body, to reuse them; default: `body_mesh(body)`.
    shift : float [px] of a point; the paper does not state it.
    cycles : int, largest number of iterations.
    epsilon : float [m, rad], the pose's average change over three iterations at which they end.
    closure_factor : float > 0 of the closures' equations (18) and (19), relative to the root mean square of those of
        (6). The paper has "a strong weighting factor". The equations keep the positions of closure points constant, so
        that factors from about 30 on immobilise the body.

    Raises
    ------
    BodyError
        Closures that are no pairs of points; gear that is to be estimated.
    ObservationError
        Another form of densities; an image of another size than its camera's; a body out of view.
    """
    mesh = body_mesh(body) if mesh is None else mesh
    finder = RimFinder(mesh) if finder is None else finder
    check_choice("form of densities", densities, DENSITIES, ObservationError)
    cells = {rig[name]: colour_cells(image, rig[name]) for name, image in images.items()}
    changes: list[NDArray] = []
    energy, converged = np.nan, False
    while len(changes) < cycles and not converged:
        vertices = mesh.posed(body.tree.forward(state.T_world_root, state.angles)[0])
        parts, energies = [], []
        for camera, cell in cells.items():
            rim = finder.find(vertices, camera, inner=False)
            inside = (finder.drawn(camera) >= 0).ravel()
            counts = (np.bincount(cell[of], minlength=COLOURS).astype(float) for of in (inside, ~inside))
            p1, p2 = map(DENSITIES[densities], counts)
            energies.append(-np.where(inside, p1[cell], p2[cell]).mean())
            u, v = np.rint(rim.outline[:2]).astype(np.int64)
            here = cell[v * camera.size[0] + u]
            moved = np.array(rim.outline)
            moved[:2] += shift * np.sign(p1[here] - p2[here]) * moved[2:]
            parts.append(outline_rows(body, state, rim, vertices, camera, moved, by="rays"))
        rows, energy = Rows.concat(*parts), float(np.mean(energies))
        if not len(rows):
            raise ObservationError("no part of the body is in view", remedy="Start nearer to it.")
        damping, sigma = 1e-6 * float(np.sum(rows.weight)), float(np.mean(rows.weight)) ** -0.5 / closure_factor
        rows = Rows.concat(rows, point_rows(body, state, *closure_targets(body, state), sigma=sigma))
        step = gauss_newton(body, state, rows, damping=damping)
        state, changes = step.state, [*changes, step.delta]
        converged = len(changes) >= 3 and float(np.linalg.norm(np.mean(changes[-3:], axis=0))) < epsilon
    return RegionFit(state, energy, len(changes), converged)


def track_regions(
    body: Body, start: BodyState, rig: Rig, images: Iterable[Mapping[str, ArrayLike]],
    densities: str = "parzen",
) -> Iterator[RegionFit]:  # fmt: skip
    """Track a body frame by frame, each from the last pose; images: camera -> (H, W, 3) uint8 RGB."""
    mesh, state = body_mesh(body), start
    finder = RimFinder(mesh)
    for seen in images:
        fit = pose_from_regions(body, state, rig, seen, densities=densities, mesh=mesh, finder=finder)
        state = fit.state
        yield fit
