"""Shoulders with joints of their own (P1 3.3): how much of the collar bones' angles silhouettes show, rendered.

`humanoid_shoulders` raises one shoulder by 20° and lowers the other, both come forward; three views and six, 9 frames.
"""

from __future__ import annotations

import cv2
import numpy as np

from benchmarks.figures import figure
from benchmarks.silhouettes_scene import ring, standing
from kinefit.bodies import Body, BodyState, load_body
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.observations import SilhouetteFrame
from kinefit.rendering import Canvas
from kinefit.sensors.settings import TrackSettings
from kinefit.tracking.tracker import Tracker

FRAMES = 9
ENDS = {"clav_elev_r": 20.0, "clav_prot_r": 12.0, "clav_elev_l": -8.0, "clav_prot_l": 16.0}  # [deg]


def posture(body: Body, i: int) -> BodyState:
    """Step i of FRAMES, one arm raised forward, one to the side."""
    angles = np.array(body.tree.usual)
    now = {name: end * i / (FRAMES - 1) for name, end in ENDS.items()}
    for name, degrees in {**now, "arm_flex_r": 40.0, "arm_add_l": -40.0}.items():
        angles[body.tree.coordinate(name)] = np.radians(degrees)
    return standing(body, angles)


def run() -> None:
    """Print the mean error of the collar bones' four angles beside their mean size, and what the fit states."""
    body = load_body("humanoid_shoulders")
    model, own = Morphing(body), [body.tree.coordinate(name) for name in ENDS]
    size = float(np.mean(np.abs(list(ENDS.values()))))
    for count in (3, 6):
        rig = ring(count)
        tracker = Tracker(body, rig, rate=30.0, up="y", settings=TrackSettings(search=False))
        tracker.start_at(posture(body, 0))
        for i in range(FRAMES):
            vertices, frames = model.pose(posture(body, i)).vertices, []
            for camera in rig:
                large = camera.scaled((2 * camera.size[0], 2 * camera.size[1]))
                drawn = Canvas(large.size).draw_for(large, vertices, model.mesh.faces, cull=True).seen
                mask = cv2.resize(255 * drawn.astype(np.uint8), camera.size, interpolation=cv2.INTER_AREA)
                frames.append(SilhouetteFrame(camera.name, i / 30.0, mask))
            result = tracker.update(frames)
        assert result is not None
        off = np.degrees(result.state.angles - posture(body, FRAMES - 1).angles)[own]
        told = np.degrees(result.dof_std[6:][own])
        print(f"#   {count} views: errors {np.round(off, 1).tolist()} deg of {list(ENDS.values())}, stated standard "
              f"deviations {np.round(told, 1).tolist()} deg")  # fmt: skip
        name = f"collar_bones_{count}_views_deg"
        figure(name, float(np.abs(off).mean()), f"deg mean, of {size:.0f} that they move", "<= 5")


if __name__ == "__main__":
    run()
