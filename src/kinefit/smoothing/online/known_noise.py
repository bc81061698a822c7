"""How lively a person is and how noisy the sensors are, known before a take: from settings, or from another take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.errors import ObservationError
from kinefit.sensors.channels import Channels

_QUICK = 5.0, 30.0  # [m/s²], [rad/s²] of the root and of angles; takes of everyday movements tell 1 to 4 and 4 to 20


@dataclass(frozen=True, eq=False)
class KnownNoise:
    """How lively a person and how noisy the sensors are, known beforehand.

    Parameters
    ----------
    acceleration : (n,) [m/s², rad/s²] random acceleration of every degree of freedom, one standard deviation
    pixel_sigma : {source of keypoints: {point: standard deviation [px] at full confidence}}; others stay as stated
    scale : {sensor: factor on its standard deviation}
    """

    acceleration: NDArray
    pixel_sigma: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    scale: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def usual(cls, body: Body) -> KnownNoise:
        """Accelerations of a person who moves quickly, 5 m/s² and 30 rad/s², and the sensors as stated.

        Calm movements have half of them, and are smoothed a little less than they could be.
        """
        return cls(np.where(np.arange(body.tree.n_dofs) < 3, *_QUICK))

    @classmethod
    def of_take(cls, body: Body, provenance: Mapping[str, Any]) -> KnownNoise:
        """What another take of a smoothed motion told: its `Motion.provenance`.

        Raises
        ------
        ObservationError
            A motion that was not smoothed as a whole, or of another body.
        """
        told = provenance.get("smoothing", {})
        found = told.get("acceleration", {})
        names = ("root_shift",) * 3 + ("root_turn",) * 3 + body.tree.coordinates
        missing = [name for name in names if name not in found]
        if missing:
            problem = f"a motion that tells no process noise of {missing[0]}"
            raise ObservationError(problem, remedy="Give one of this body that was smoothed as a whole.")
        acceleration = np.maximum(np.array([found[name] for name in names]), 1e-3)
        return cls(acceleration, told.get("pixel_sigma", {}), told.get("sigma_factor", {}))

    def as_told(self, body: Body) -> dict[str, Any]:
        """The same by name, as `of_take` reads it."""
        names = ("root_shift", "root_turn", *body.tree.coordinates)
        values = [self.acceleration[0], *self.acceleration[5:]]
        return {
            "acceleration": {name: round(float(v), 2) for name, v in zip(names, values)},
            "pixel_sigma": {source: dict(of) for source, of in self.pixel_sigma.items()},
            "sigma_factor": dict(self.scale),
        }  # fmt: skip


def known_sigma(channels: Channels, noise: KnownNoise) -> NDArray:
    """(N,) [px] standard deviations of keypoints, as they are known or else as stated."""
    out = np.array(channels.sigma)
    for k, (q, c) in enumerate(zip(channels.source, channels.column)):
        out[k] = noise.pixel_sigma.get(channels.sources[q], {}).get(channels.points.names[c], out[k])
    return out
