"""A body of one's own, written as TOML, and its fit to measured points.

    python examples/01_own_body.py
"""

import numpy as np

import kinefit

LAMP = """
[body]
name = "desk lamp"

[[segment]]                                    # the root: it stands still, so its joint is fixed
name = "foot"
joint = { name = "ground", type = "fixed" }

[[segment]]
name = "lower"
parent = "foot"
scale = "arms"                                 # lengths of one group are stretched together

[segment.joint]
name = "base"
type = "universal"
at = [0.0, 0.03, 0.0]                          # metres, in the parent's frame
axes = ["y", "z"]
coordinates = ["turn", "lift"]
range = [[-180, 180], [-80, 80]]               # degrees

[[segment]]
name = "upper"
parent = "lower"
joint = { name = "bend", type = "revolute", at = [0.0, 0.40, 0.0], axes = ["-z"], range = [[0, 150]] }

[[segment]]
name = "shade"
parent = "upper"
joint = { name = "nod", type = "revolute", at = [0.0, 0.35, 0.0], axes = ["-z"], range = [[-90, 90]] }

[landmarks]                                    # metres, in the frame of their segment
bend_left = { segment = "lower", at = [0.0, 0.40, -0.03] }
bend_right = { segment = "lower", at = [0.0, 0.40, 0.03] }
nod = { segment = "shade", at = [0.0, 0.0, 0.0] }
rim_front = { segment = "shade", at = [0.12, 0.05, 0.0] }
bulb = { segment = "shade", at = [0.0, 0.12, 0.0] }
"""


def main(seed=0, noise=0.002):
    lamp = kinefit.parse_body(LAMP, "the lamp of this example")
    truth = kinefit.BodyState(np.eye(4), np.radians([40.0, -20.0, 75.0, 30.0]))

    measured = lamp.positions(truth, lamp.landmarks)  # (5, 3) [m]
    measured += np.random.default_rng(seed).normal(0.0, noise, measured.shape)
    measured[lamp.landmarks.index("rim_front")] = np.nan  # hidden: NaN is "not measured"

    def make_rows(state):  # called at every state that is tried
        return (
            kinefit.solving.correspondences.point_rows(lamp, state, lamp.landmarks, measured, sigma=noise),
            kinefit.solving.correspondences.prior_rows(lamp, state),  # a weak prior for what nothing observes
        )

    fit = kinefit.solving.levenberg_marquardt(lamp, lamp.rest_state(), make_rows)
    # The normal matrix has six rows for the root in front; this root is fixed.
    std = np.degrees(kinefit.solving.covariance(fit.equations).std[6:])
    found = np.degrees(fit.state.angles)
    print(f"{lamp.name}: fitted in {fit.iterations} iterations")
    for name, a, s, t in zip(lamp.tree.coordinates, found, std, np.degrees(truth.angles)):
        print(f"  {name:<5} {a:7.2f} ±{s:.2f} deg   (truth {t:.0f})")
    return found, std, np.degrees(truth.angles)


if __name__ == "__main__":
    main()
