"""A row maker of one's own, beside one that comes with kinefit: a hand that holds a taut rope, seen by one camera.

One camera does not tell how far away a hand is. The rope does: its end is somewhere on a sphere about its anchor.

    python examples/02_own_rows.py
"""

import numpy as np

import kinefit


def sphere_rows(body, state, points, centre, radius, *, sigma=0.005):
    """One row a point: it should lie at a distance `radius` [m] from `centre` (3,) [m], give or take sigma [m].

    The distance grows by n·δx with n = (x - c) / |x - c|, so n is the direction, radius - |x - c| the residual.
    """
    x = body.positions(state, points)
    away = x - centre
    distance = np.linalg.norm(away, axis=1)
    weight = np.full(len(points), 1.0 / sigma**2)
    return kinefit.Rows.of(points.segments, x, away / distance[:, None], radius - distance, weight)


def main(seed=0, noise_px=1.0):
    arm, rig = kinefit.load_body("arm"), kinefit.simulation.studio_rig(cameras=1)
    degrees = {"arm_flex_r": 20.0, "arm_add_r": -60.0, "elbow_flex_r": 40.0, "pro_sup_r": 45.0}
    angles = np.zeros(len(arm.tree.coordinates))
    for name, value in degrees.items():
        angles[arm.tree.coordinate(name)] = np.radians(value)
    shoulder = np.eye(4)
    shoulder[:3, 3] = [0.0, 1.4, 0.0]
    truth = kinefit.BodyState(shoulder, angles)

    seen = arm.keypoints("MEDIAPIPE_33")
    camera = np.zeros(len(seen), int)  # every point was seen by camera 0
    uv = rig["cam01"].project(arm.positions(truth, seen))
    uv += np.random.default_rng(seed).normal(0.0, noise_px, uv.shape)
    grip = arm.landmarks.select(("r_dactylion",))
    anchor = np.array([1.5, 2.0, 0.3])
    length = np.linalg.norm(arm.positions(truth, grip)[0] - anchor)

    errors = {}
    for name, with_rope in (("camera alone", False), ("camera and rope", True)):

        def make_rows(state, with_rope=with_rope):
            pixels = kinefit.solving.correspondences.pixel_rows(arm, state, seen, rig, camera, uv, sigma=noise_px)
            rows = [pixels, kinefit.solving.correspondences.prior_rows(arm, state)]
            return rows + [sphere_rows(arm, state, grip, anchor, length)] * with_rope

        fit = kinefit.solving.levenberg_marquardt(arm, arm.rest_state(shoulder), make_rows)
        wrist = arm.landmarks.select(("r_wrist",))
        error = np.linalg.norm(arm.positions(fit.state, wrist) - arm.positions(truth, wrist))
        spread = kinefit.solving.covariance(fit.equations)
        std = np.linalg.norm(kinefit.solving.joint_std(arm, fit.state, spread)[arm.tree.segment("hand_r")])
        errors[name] = (error, std)
        print(f"{name:<16} wrist off by {1000 * error:5.1f} mm, one standard deviation {1000 * std:5.1f} mm")
    return errors


if __name__ == "__main__":
    main()
