"""Process noise of a person and noise of sensors, known before a take: from defaults, or from another take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.errors import ObservationError
from kinefit.sensors.channels import Channels

_DEFAULT_ACCELERATIONS = 5.0, 30.0  # [m/s²], [rad/s²] of root and angles: quick; everyday takes have 1 to 4, 4 to 20


@dataclass(frozen=True, eq=False)
class KnownNoise:
    """Process noise of a person and noise of sensors, known before a take.

    Parameters
    ----------
    acceleration : (n,) [m/s², rad/s²] random acceleration of every degree of freedom, one standard deviation
    pixel_sigma : {source of keypoints: {point: standard deviation [px] at full confidence}}; others keep theirs
    scale : {sensor: factor on its standard deviation}
    """

    acceleration: NDArray
    pixel_sigma: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    scale: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def usual(cls, body: Body) -> KnownNoise:
        """Accelerations of a person who moves quickly, 5 m/s² and 30 rad/s², and the sensors' own noise.

        Calm movements have half of that. They are smoothed a little less than they could be.
        """
        return cls(np.where(np.arange(body.tree.n_dofs) < 3, *_DEFAULT_ACCELERATIONS))

    @classmethod
    def of_take(cls, body: Body, provenance: Mapping[str, Any]) -> KnownNoise:
        """Noise estimated from another take: the `Motion.provenance` of its smoothed motion.

        Raises
        ------
        ObservationError
            The motion was not smoothed as a whole, or has another body.
        """
        smoothing = provenance.get("smoothing", {})
        found = smoothing.get("acceleration", {})
        names = ("root_shift",) * 3 + ("root_turn",) * 3 + body.tree.coordinates
        missing = [name for name in names if name not in found]
        if missing:
            problem = f"the motion has no process noise of {missing[0]}"
            raise ObservationError(problem, remedy="Give a motion of this body, smoothed over the whole take.")
        acceleration = np.maximum(np.array([found[name] for name in names]), 1e-3)
        return cls(acceleration, smoothing.get("pixel_sigma", {}), smoothing.get("sigma_factor", {}))

    def as_record(self, body: Body) -> dict[str, Any]:
        """The noise as a provenance record by name, readable by `of_take`."""
        names = ("root_shift", "root_turn", *body.tree.coordinates)
        values = [self.acceleration[0], *self.acceleration[5:]]
        return {
            "acceleration": {name: float(f"{v:.4g}") for name, v in zip(names, values)},
            "pixel_sigma": {source: dict(of) for source, of in self.pixel_sigma.items()},
            "sigma_factor": dict(self.scale),
        }  # fmt: skip


def known_sigma(channels: Channels, noise: KnownNoise) -> NDArray:
    """(N,) [px] standard deviations of keypoints: known ones, else the channels' own."""
    out = np.array(channels.sigma)
    for k, (q, c) in enumerate(zip(channels.source, channels.column)):
        out[k] = noise.pixel_sigma.get(channels.sources[q], {}).get(channels.points.names[c], out[k])
    return out
