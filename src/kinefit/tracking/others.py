"""Other people in view, whose motions are known: where they are at each time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kinefit.bodies import BodyState
from kinefit.geometry.camera import Rig
from kinefit.motion import Motion
from kinefit.sensors.scene import Scene


class OtherPeople:
    """Scenes of other people at any time of a recording.

    Parameters
    ----------
    motions : in the recording's world and time; one whose body has no surfaces hides nothing
    rig : Rig of all cameras
    within : float [s], how far the nearest frame of a motion may be
    """

    def __init__(self, motions: Sequence[Motion], rig: Rig, within: float) -> None:
        self.motions, self.within = tuple(m for m in motions if m.body.surfaces), within
        self._scenes = [Scene(m.body, m.body.usual_state(np.eye(4)), rig) for m in self.motions]

    def at(self, time: float) -> list[Scene]:
        """Everybody who is there at a time [s]."""
        out = []
        for motion, scene in zip(self.motions, self._scenes):
            k = int(np.argmin(np.abs(motion.times - time)))
            if abs(motion.times[k] - time) <= self.within and np.isfinite(motion.Ts_world_root[k]).all():
                out.append(scene.at(BodyState(motion.Ts_world_root[k], motion.angles[k]), time=time))
        return out
