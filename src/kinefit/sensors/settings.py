"""How a track runs: every number in one place, with its reason."""

from __future__ import annotations

from dataclasses import dataclass, field

from kinefit.images.regions import RegionSettings
from kinefit.losses import Loss, geman_mcclure
from kinefit.observations import KEYPOINT_SIGMA

MARKER_LOSS = geman_mcclure(5.0)
"""Of a marker: three residuals in one, which are 1.6 standard deviations long on average; those of a keypoint 1.25."""


@dataclass(frozen=True)
class CameraErrors:
    """How far each camera may stand from where its calibration has it, one standard deviation along each axis.

    Parameters
    ----------
    position, direction : float [m], [rad]
    own_world : bool, nothing but the cameras says where the world is: what they are off by in common is no error.
    """

    position: float
    direction: float
    own_world: bool = False


@dataclass(frozen=True)
class TrackSettings:
    """Settings of the tracker and of the smoother.

    Parameters
    ----------
    points : int
        Measured points of a depth image that take part, about.
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
    tolerance : float [standard deviations]
        Of each degree of freedom, on average: a smaller step ends a frame.
    patch : float [m]
        Size of a patch of surface over which the errors of depth are alike (shape, and the sensor's own): as many
        measurements count as there are patches.
    render_every : int
        Iterations after which the body's own hidden parts are found anew.
    depth, pixel, marker, silhouette, region, line : float [m], [px], [m], [px], [px], [px]
        Standard deviation of a sensor that none is given for.
        `region` is that of a mesh of the very body.
    lifted : float [m]
        Standard deviation of how far a network tells a landmark to be behind the hips. It errs by 7 and 10 cm on the
        two trials of one person before one telephone that have markers, for as long as a pose lasts. Of 20, 30 and
        40 cm, 30 left each camera of the balancing trial nearest to all four.
    shape : float [m]
        Standard deviation of the contour of a body of simple shapes where colours show it: on the balancing trial
        half of the contour is within 0.8 cm of it, once its girths are fitted.
    regions : RegionSettings, of colours inside and outside of a body
    outline : int [px]
        Longer side, about, of the image in which silhouettes are compared: at 320 a pixel is a centimetre of a person
        and the room about. Outlines are found to parts of a pixel.
    angle : float [rad]
        Largest angle between normals of two outlines of which points are paired.
    background : float [s]
        How long a thing near the body must be seen, and not be taken for the body, to count as background; see
        `Background`. inf for depth cameras that move.
    through : float [px]
        Standard deviation, in cells of 1/160 of an image's width, of rows that draw what the sensor saw through to
        where something was measured; see `free_space_rows`. inf for none.
    collision, flesh : float [m]
        Softness of what parts that run into each other are kept apart with, and how far they may. See
        `collision_rows`.
    skin_shift, skin_turn : float [m], [rad]
        Standard deviations by which a segment's surface is shifted and turned about its bone: beside points that hold
        the body, surfaces tell of joints no better, however much of them is seen; see `rows_of` in `kinefit.frame.fit`.
        Shift: with silhouettes of the balancing trial's first 30 frames, 0 left keypoints 1.25 times as far off as
        without silhouettes, 0.01 1.07 times, 0.02 1.02 times, on a trunk that lay 1 to 1.5 cm further forward than the
        catalogue's; on the catalogue's 0.02 leaves 1.03 times. Turn: not swept. 0 takes surfaces for exact everywhere.
    camera_std : (2,) [m] and [rad], or None; own_world : bool, see `CameraErrors`
        Standard deviations of each camera's calibrated position and of its direction, before a take shows how large
        they are; of three cameras or more one that is surely three of them off is moved. None takes calibrations for
        exact.
    view_bias : bool
        Whether it is found from the take how far beside its point a detector puts each keypoint, seen from each side,
        see `ViewBias`. It takes three cameras that show a point, and keypoints alone: beside other sensors cameras
        are found, whose errors it would follow.
    angle_acceleration, root_acceleration : float [rad/s²], [m/s²]
        How abruptly a body moves: one standard deviation.
    velocity_memory : float [s]
        How long a velocity lasts that nothing confirms.
    loss : Loss of keypoints, in their standard deviations.
    marker_loss : Loss of markers, likewise.
    pause : float [s]
        A longer gap between frames leaves the velocity unknown; a clock that goes back further was set.
    search : bool
        Whether what is lost is sought: a limb takes 30 ms of one core, a whole body 1 s. Without it every frame takes
        as long as any other, and `start_at` is the only start.
    support : float in 0..1
        Share of the evidence that agrees below which a start from points that are known in space is tried.
    poor : float in 0..1
        Mean quality of what is seen, below which the whole body counts as lost, and is sought as at the start.
    doubtful : float in 0..1
        Quality of a segment below which its limb is sought together with one that is lost.
    search_after, search_every : float [s]
        How long something must have been lost, and how long to wait between two searches.
    smooth_memory : float [s]
        Time constant of a velocity that nothing confirms, where a whole take is smoothed.
    acceleration_memory : float [s]
        Time constant of an acceleration, where a whole take is smoothed.
    smooth_rounds : int
        How often process noise and the sensors' noise are estimated anew, at most.
    """

    points: int = 1000
    samples: int = 600
    reach: float = 0.25
    far: float = 0.15
    near: float = 0.03
    shrink: float = 0.5
    iterations: int = 8
    tolerance: float = 0.3
    patch: float = 0.05
    render_every: int = 4
    depth: float = 0.01
    pixel: float = KEYPOINT_SIGMA
    marker: float = 0.005
    silhouette: float = 4.0
    region: float = 0.5
    shape: float = 0.01
    line: float = 2.0
    lifted: float = 0.3
    regions: RegionSettings = field(default_factory=RegionSettings)
    outline: int = 320
    angle: float = 1.0
    background: float = 0.5
    through: float = 3.0
    collision: float = 0.01
    flesh: float = 0.02
    skin_shift: float = 0.02
    skin_turn: float = 0.1
    camera_std: tuple[float, float] | None = (0.003, 0.001745)
    own_world: bool = False
    view_bias: bool = True
    angle_acceleration: float = 60.0
    root_acceleration: float = 15.0
    velocity_memory: float = 0.1
    loss: Loss = field(default_factory=geman_mcclure)
    marker_loss: Loss = MARKER_LOSS
    pause: float = 1.0
    search: bool = True
    support: float = 0.5
    poor: float = 0.4
    doubtful: float = 0.6
    search_after: float = 0.0
    search_every: float = 0.1
    smooth_memory: float = 1.0
    acceleration_memory: float = 0.2
    smooth_rounds: int = 8

    @property
    def camera_errors(self) -> CameraErrors | None:
        """Of the calibration; None where it is taken for exact."""
        return None if self.camera_std is None else CameraErrors(*self.camera_std, self.own_world)
