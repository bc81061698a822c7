"""How any sensor errs: jitter, drift of every channel, and a shift of the whole sensor, from what a fit left over.

A channel is what errs alike for a while: one axis of a marker, the surface of one segment along its normals. What its
mean residual has that is not new in every frame lasts; what all residuals of a sensor have in common is a shift.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.frame.skin import skin_of
from kinefit.rows import DofRows, Rows
from kinefit.sensors.base import Matched, rows_at
from kinefit.smoothing.linearised import OtherSensors, squares_of
from kinefit.smoothing.spool import Spool
from kinefit.solvers.equations import design

_MOST_HIDDEN = 0.75  # share of its errors that a fit may be thought to follow
_RIGID = 1e-6, 1e-6  # [m], [rad] of a body without joints: it is its surface, and no bone lies below
_EXACT = 1e-4  # [m] as good as 0
_FEW = 5  # frames of a channel, with fewer of which it says nothing of what lasts


@dataclass(eq=False)
class _Channel:
    """Mean residual [m] of a channel frame by frame, and the variance [m²] that it should have."""

    values: list[float] = field(default_factory=list)
    expected: list[float] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class OtherNoise:
    """What lasts of the errors of all sensors but the keypoints.

    Parameters
    ----------
    information : (T, n (n + 1) / 2) of every frame's rows, the upper triangle of each
    lasting : the same of Σ s sᵀ of the pushes s = Jᵀ W e of every lasting error e
    drift : {sensor: standard deviation [m]}
    shift : {sensor: (3,) [m]} in the world
    """

    information: NDArray
    lasting: NDArray
    drift: dict[str, float]
    shift: dict[str, NDArray]

    def pooled(self, f: int, half: int) -> tuple[NDArray, NDArray]:
        """(n, n) information and lasting, each the mean over so many frames to either side."""
        near, n = slice(max(f - half, 0), f + half + 1), int(np.sqrt(2.0 * self.information.shape[1]))
        out = np.empty((2, n, n))
        upper = np.triu_indices(n)
        for square, values in zip(out, (self.information, self.lasting)):
            square[upper] = square.T[upper] = values[near].mean(axis=0)
        return out[0], out[1]

    def as_told(self) -> dict[str, Any]:
        """The same in a few numbers, by sensor."""
        return {
            name: {"drift [m]": round(d, 4), "shift [m]": np.round(self.shift.get(name, np.zeros(3)), 4).tolist()}
            for name, d in self.drift.items()
        }


def other_noise(
    body: Body, others: OtherSensors, matched: Sequence[tuple[Matched, ...]], roots: NDArray, angles: NDArray,
    *, surfaces: bool = True,
) -> OtherNoise:  # fmt: skip
    """Noise of all sensors but the keypoints, from their residuals at fitted states.

    Parameters
    ----------
    matched : T lists of matches
    roots, angles : (T, 4, 4), (T, D) fitted
    surfaces : whether errors of surfaces as wholes count
    """
    T, n = len(roots), body.tree.n_dofs
    pushes, shifts = Spool[list[tuple[str, float, NDArray]]](), Spool[list[tuple[str, NDArray]]]()
    upper = np.triu_indices(n)
    information, lasting = np.zeros((T, len(upper[0]))), np.zeros((T, len(upper[0])))
    channels: dict[str, dict[tuple[int, int], _Channel]] = {}
    normal: dict[str, tuple[NDArray, NDArray]] = {}
    counts: dict[str, list[int]] = {}
    for f in range(T):
        push, moved = list[tuple[str, float, NDArray]](), list[tuple[str, NDArray]]()
        scene = others.scene(f, roots, angles)
        surface: list[Rows] = []
        for m in matched[f]:
            scale = others.scale.get(m.sensor, 1.0)
            for part, rows in enumerate(rows_at(m, scene)):
                if not isinstance(rows, Rows | DofRows) or not len(rows):
                    continue
                if not m.of_points and isinstance(rows, Rows):
                    surface.append(rows.weaker(scale))
                    continue
                J, w = design(body, scene.state, rows), rows.weight * squares_of(rows)[1] / scale**2
                weighted = J * w[:, None]
                information[f] += (J.T @ weighted)[upper]
                names = np.arange(len(rows))
                counts.setdefault(m.sensor, []).append(len(np.unique(names)))
                mine = channels.setdefault(m.sensor, {})
                for c in np.unique(names):
                    of = names == c
                    total = float(w[of].sum())
                    if total > 0.0:
                        channel = mine.setdefault((part, int(c)), _Channel())
                        channel.values.append(float(w[of] @ rows.residual[of]) / total)
                        channel.expected.append(1.0 / total)
                        stated = float(np.sqrt(m.lasts * np.mean(1.0 / rows.weight[of])))
                        push.append((m.sensor, stated, weighted[of].sum(axis=0)))
                if isinstance(rows, Rows):
                    d = rows.direction
                    A, b = normal.get(m.sensor, (np.zeros((3, 3)), np.zeros(3)))
                    normal[m.sensor] = A + d.T @ (d * w[:, None]), b + d.T @ (w * rows.residual)
                    moved += [(m.sensor, weighted.T @ d)]
        if surface:
            settings = others.settings  # also where the fit takes surfaces for exact
            beside = max(settings.skin_shift, _EXACT), settings.skin_turn
            skin = skin_of(scene, surface, *(beside if body.tree.coordinates else _RIGID), matched[f])
            information[f] += skin.information[upper]
            if surfaces:
                lasting[f] += (skin.pushes.T @ skin.pushes)[upper]
        pushes.append(push)
        shifts.append(moved)
    shift = {
        name: np.abs(np.linalg.solve(A + 1e-9 * (np.trace(A) + 1.0) * np.eye(3), b)) for name, (A, b) in normal.items()
    }
    drift = {
        name: _drift(list(mine.values()), min(n / max(float(np.mean(counts[name])), 1.0), _MOST_HIDDEN))
        for name, mine in channels.items()
    }
    for f in range(T):
        for name, stated, s in pushes[f]:
            lasting[f] += max(drift[name], stated) ** 2 * np.outer(s, s)[upper]
        for name, S in shifts[f]:
            moved_by = S * shift[name]
            lasting[f] += (moved_by @ moved_by.T)[upper]
    return OtherNoise(information, lasting, drift, shift)


def _drift(channels: list[_Channel], hidden: float) -> float:
    """[m] standard deviation of what lasts, pooled over a sensor's channels.

    Parameters
    ----------
    hidden : share of a channel's own error that the fit follows, and so hides from its residual
    """
    lasting, frames = 0.0, 0
    for channel in channels:
        values = np.array(channel.values)
        if len(values) >= _FEW:
            new = min(0.5 * float(np.mean(np.diff(values) ** 2)), float(np.mean(values**2)))
            lasting += len(values) * (float(np.mean(values**2)) - new)
            frames += len(values)
    return float(np.sqrt(lasting / max(frames, 1) / (1.0 - hidden)))
