"""How a fusion of sensors runs: every number in one place, with its reason."""

from __future__ import annotations

from dataclasses import dataclass, field

from kinefit.solvers.losses import Loss, geman_mcclure


@dataclass(frozen=True)
class FusionSettings:
    """Settings of the fusion tracker.

    Parameters
    ----------
    points : int
        Measured points of a depth image that take part, at most.
    samples : int
        Points of the body's surface that look for their measurement.
    reach : float [m]
        How far outside of the predicted body's box a measured point may lie: what a hand moves between two frames.
    far, near : float [m]
        Bound of a correspondence in the first iteration and in the last: from what a prediction may be off to three
        deviations of a sensor of a centimetre.
    shrink : float
        By which the bound shrinks from iteration to iteration.
    iterations : int, at most
    tolerance : float [m, rad]
        Norm of a step below which a frame is done.
    patch : float [m]
        Size of a patch of surface over which the errors of depth are alike (shape, and the sensor's own): as many
        measurements count as there are patches.
    render_every : int
        Iterations after which the body's own hidden parts are found anew.
    angle_acceleration, root_acceleration : float [rad/s²], [m/s²]
        How abruptly a body moves: one standard deviation.
    velocity_memory : float [s]
        How long a velocity lasts that nothing confirms.
    loss : Loss of keypoints and markers, in their standard deviations.
    """

    points: int = 2500
    samples: int = 1500
    reach: float = 0.25
    far: float = 0.15
    near: float = 0.03
    shrink: float = 0.7
    iterations: int = 12
    tolerance: float = 2e-3
    patch: float = 0.05
    render_every: int = 4
    angle_acceleration: float = 150.0
    root_acceleration: float = 15.0
    velocity_memory: float = 0.1
    loss: Loss = field(default_factory=geman_mcclure)
