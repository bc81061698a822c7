"""Points of the balancing trial's scene, read from its pictures by hand: an independent check of a calibration.

Pixels are of the calibration's pictures (1088 x 1920), the first pixel's centre being (0, 0). Nothing here was fitted
to a rig; no rig may be fitted to it.

Scene: the centres of four white stickers and the mouths of two posts on the platform, a corner of the wooden box, the
roller-side end of the beam, all in the pictures of `calibration/extrinsics`; the stickers are in the same place within
0.3 px in the background plates of the trial. Person: centres of reflective markers on the one who stands still in the
`static_trial` (mean of 11 frames; cam03 and cam04 mapped back from their letterboxed 1080 x 1920). Bright round marks
are centroids (good to 0.3 px), corners and posts read at 8 to 14 times (1 px), the high markers are small and partly
hidden by the arm (1.5 px). They agree with each other: cameras that are moved to fit all of them leave 0.2 px.
"""

from __future__ import annotations

import numpy as np

from kinefit.geometry.camera import Rig
from kinefit.geometry.lines import triangulate

POINTS: dict[str, dict[str, tuple[float, float]]] = {
    "sticker_cable_post": {
        "cam01": (319.7, 1337.8), "cam02": (327.9, 1209.3), "cam03": (516.4, 1091.1), "cam04": (889.5, 1069.6),
    },
    "sticker_cable_roller": {
        "cam01": (109.5, 1061.0), "cam02": (441.9, 1041.3), "cam03": (873.6, 1234.0), "cam04": (836.5, 1410.5),
    },
    "sticker_screw_post": {
        "cam01": (772.5, 1292.9), "cam02": (763.4, 1271.6), "cam03": (164.4, 1240.5), "cam04": (519.7, 1116.9),
    },
    "sticker_screw_roller": {
        "cam01": (522.0, 1064.6), "cam02": (794.3, 1085.0), "cam03": (485.2, 1431.7), "cam04": (385.3, 1396.1),
    },
    "post_cable_top": {
        "cam01": (673.5, 1525.0), "cam02": (274.5, 1318.7), "cam03": (261.0, 968.7), "cam04": (829.0, 858.0),
    },
    "post_screw_top": {
        "cam01": (954.5, 1427.5), "cam02": (634.5, 1344.7), "cam03": (61.5, 1058.5), "cam04": (607.5, 922.0),
    },
    "box_corner": {"cam02": (62.7, 1555.8), "cam03": (98.1, 878.5), "cam04": (853.7, 716.8)},
    "beam_end_screw_side": {"cam01": (234.0, 950.5), "cam02": (623.6, 979.6), "cam04": (521.9, 1582.5)},
    "beam_end_cable_side": {"cam01": (226.1, 951.1), "cam02": (616.8, 979.6), "cam04": (535.4, 1582.5)},
    "heel_left": {"cam01": (404.2, 1203.2), "cam02": (501.6, 1144.4), "cam03": (511.3, 1170.6)},
    "heel_right": {"cam01": (501.4, 1184.6), "cam02": (604.2, 1147.5), "cam04": (614.4, 1185.8)},
    "ankle_left_outer": {"cam01": (375.9, 1194.8), "cam02": (482.2, 1134.0), "cam04": (737.0, 1162.2)},
    "ankle_left_inner": {"cam02": (512.6, 1118.4), "cam03": (538.9, 1174.9), "cam04": (702.3, 1180.4)},
    "ankle_right_outer": {"cam01": (516.9, 1171.1), "cam02": (627.2, 1140.4), "cam03": (427.6, 1226.4)},
    "acromion_right": {"cam01": (643.0, 529.5), "cam02": (588.0, 529.3), "cam04": (309.8, 609.2)},
    "elbow_left": {"cam01": (358.0, 575.4), "cam02": (331.5, 596.5), "cam03": (607.5, 590.8)},
    "elbow_right": {"cam01": (724.3, 606.0), "cam02": (724.3, 592.3), "cam04": (217.8, 729.2)},
}


def residuals(rig: Rig) -> dict[str, dict[str, float]]:
    """{point: {camera: px}} from where the rig's own triangulation of the point puts it."""
    out = {}
    for name, told in POINTS.items():
        seen = {camera: uv for camera, uv in told.items() if camera in rig}
        if len(seen) < 2:
            continue
        uv = np.full((1, len(rig), 2), np.nan)
        for camera, pixel in seen.items():
            uv[0, rig.index(camera)] = pixel
        x = triangulate(rig, uv)[0]
        out[name] = {camera: float(np.linalg.norm(rig[camera].project(x) - pixel)) for camera, pixel in seen.items()}
    return out


def static_residual(rig: Rig) -> float:
    """Median [px] over all points and all cameras that see them."""
    return float(np.median([px for point in residuals(rig).values() for px in point.values()]))
