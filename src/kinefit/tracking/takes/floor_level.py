"""The world of a take whose vertical nothing measured, set level on the floor under the feet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from kinefit.geometry.camera import Rig
from kinefit.motion import UP_AXES, Motion
from kinefit.smoothing.foot_contacts import FloorPlane, find_contacts, soles
from kinefit.tracking.recording import Recording

FLOOR = "floor"
"""Key of `Motion.provenance`: the floor that was found from the feet, and how the world was moved onto it."""

_MAX_LOST = 0.5  # share of frames in which the feet may be lost, to tell a floor


def on_floor(motion: Motion, recording: Recording, floors: list[FloorPlane]) -> Motion:
    """A motion in a world whose floor is level and at zero; as it is where the vertical was measured, or no foot rests.

    Parameters
    ----------
    motion : of one person of the recording
    floors : the floor that an earlier person of the recording stands on, which holds for all; else it is added
    """
    if recording.level:
        return motion
    eye = None if recording.alone is None else recording.alone.centre_world
    if not floors and motion.lost[:, np.unique(soles(motion.body).segments)].mean() <= _MAX_LOST:
        states = motion.Ts_world_root, motion.angles
        found = find_contacts(motion.body, *states, motion.rate, motion.up, eye, level=False).floor
        floors += [] if found is None else [found]
    if not floors:
        return motion
    floor, axis = floors[0], np.array(UP_AXES[motion.up])
    T = floor.T_level_world(motion.up)
    entries = {
        "T_level_world": T.tolist(), "tilt_deg": float(np.degrees(np.arccos(np.clip(floor.normal @ axis, -1.0, 1.0)))),
        "height_std_m": round(floor.height_std, 4), "tilt_std_deg": round(float(np.degrees(floor.tilt_std)), 2),
    }  # fmt: skip
    return replace(motion.moved(T, eye), provenance={**motion.provenance, FLOOR: entries})


def rig_on_floor(rig: Rig, provenance: Mapping[str, Any]) -> Rig:
    """The cameras in the world of a motion that `on_floor` moved."""
    return rig.moved(np.array(provenance[FLOOR]["T_level_world"])) if FLOOR in provenance else rig


def floor_sentences(provenance: Mapping[str, Any]) -> list[str]:
    """What is worth saying of a floor that was found."""
    if FLOOR not in provenance:
        return []
    entries = provenance[FLOOR]
    return [
        "the floor was estimated from resting feet and is at height zero; standard deviations "
        f"{1e3 * entries['height_std_m']:.0f} mm and {entries['tilt_std_deg']:.1f} degrees. Resting soles stay still"
    ]
