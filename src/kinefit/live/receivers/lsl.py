"""Lab Streaming Layer: angles and joint centres as two streams for laboratories (extra `lsl`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from kinefit.bodies import Body
from kinefit.errors import ExportError
from kinefit.live.packets import PosePacket


class Lsl:
    """Two outlets: NAME-angles [deg, of sliding coordinates m] and NAME-joints [m], each with standard deviations.

    Unobserved coordinates have the standard deviation inf; while the person is not found, nothing is sent.

    Raises
    ------
    ExportError
        The package `pylsl`, or its library, is missing.
    """

    def __init__(self, name: str, *, rate: float) -> None:
        try:
            import pylsl
        except (ImportError, RuntimeError) as error:
            remedy = "Install it: pip install 'kinefit[lsl]'."
            raise ExportError(f"LSL needs the package pylsl ({error})", place="--lsl", remedy=remedy) from error
        self._lsl, self.name, self.rate = pylsl, name, rate
        self._outlets: list[Any] = []
        self._factor = np.ones(0)

    def hello(self, body: Body, packet: bytes) -> None:
        """Open streams for a new body; those of the previous one end."""
        tree = body.tree
        self._factor = np.where(tree.prismatic, 1.0, np.degrees(1.0))
        angles = [(name, "m" if slides else "deg") for name, slides in zip(tree.coordinates, tree.prismatic)]
        angles += [(f"{name} std", unit) for name, unit in angles]
        joints = [(f"{name} {axis}", "m") for name in tree.segments for axis in "xyz"]
        joints += [(f"{name} std", unit) for name, unit in joints]
        self._outlets = [self._outlet(kind, columns) for kind, columns in (("angles", angles), ("joints", joints))]

    def pose(self, posed: PosePacket, packet: bytes) -> None:
        """Send one sample of each stream."""
        r = posed.result
        if r is None:
            return
        f = self._factor
        angles = np.concatenate([f * r.state.angles, f * r.dof_std[6:]])
        joints = np.concatenate([posed.Ts_world_segment[:, :3, 3].ravel(), r.joint_std.ravel()])
        for outlet, sample in zip(self._outlets, (angles, joints)):
            outlet.push_sample(sample.tolist())

    def close(self) -> None:
        """End the streams."""
        self._outlets = []

    def _outlet(self, kind: str, columns: list[tuple[str, str]]) -> Any:
        name = f"{self.name}-{kind}"
        info = self._lsl.StreamInfo(name, "MoCap", len(columns), self.rate, "double64", f"kinefit-{name}")
        channels = info.desc().append_child("channels")
        for label, unit in columns:
            channel = channels.append_child("channel")
            channel.append_child_value("label", label)
            channel.append_child_value("unit", unit)
        return self._lsl.StreamOutlet(info)
