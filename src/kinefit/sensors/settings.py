"""Settings of tracking and smoothing, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass, field

from kinefit.geometry.losses import Loss, geman_mcclure
from kinefit.images.regions import RegionSettings
from kinefit.observations import KEYPOINT_SIGMA

MARKER_LOSS = geman_mcclure(5.0)
"""Of a marker: three residuals in one, which are 1.6 standard deviations long on average; those of a keypoint 1.25."""


@dataclass(frozen=True)
class CameraErrors:
    """Standard deviations of the cameras' calibrated extrinsics, along each axis.

    Parameters
    ----------
    position, direction : float [m], [rad]
    own_world : bool, only the cameras define the world: an error that they have in common is none.
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
        Measured points of a depth image in a fit, about.
    samples : int
        Points of the body's surface that are compared with a depth image.
    reach : float [m]
        Margin about the predicted body's box in which measured points count: what a hand moves between two frames.
    far, near : float [m]
        Correspondence distance of the first and the last iteration: from the error of a prediction to three standard
        deviations of a sensor of 1 cm.
    shrink : float
        Factor 0..1 on the correspondence distance from iteration to iteration.
    iterations : int, at most
    tolerance : float [standard deviations]
        Step of a degree of freedom, on average, below which a frame's fit ends.
    patch : float [m]
        Size of a patch of surface over which the errors of depth are alike (shape, and the sensor's own): as many
        measurements count as there are patches.
    render_every : int
        Iterations between two renderings that find the body's self-occlusions.
    depth, pixel, marker, silhouette, region, line : float [m], [px], [m], [px], [px], [px]
        Default standard deviation of each kind of sensor.
        `region` holds for a scanned mesh of the body itself.
    lifted : float [m]
        Standard deviation of a landmark's depth relative to the hips, as a network estimates it. It errs by 7 and 10 cm
        on the two trials of one person before one phone that have markers, for as long as a pose lasts. Of 20, 30 and
        40 cm, 30 left each camera of the balancing trial nearest to all four.
    shape : float [m]
        Standard deviation of the contour of a body of simple shapes where colours show it: on the balancing trial
        half of the contour is within 0.8 cm of it, once its girths are fitted.
    regions : RegionSettings, of colours inside and outside of a body
    outline : int [px]
        Longer side, about, of the image in which silhouettes are compared: at 320 a pixel is about 1 cm at the person.
        Contours are located to fractions of a pixel.
    angle : float [rad]
        Largest angle between the normals of two paired contour points.
    background : float [s]
        Time after which an object near the body that is no part of it counts as background; see `Background`.
        inf for moving depth cameras.
    through : float [px]
        Standard deviation, in cells of 1/160 of an image's width, of rows that pull surface out of observed free space
        to the nearest measurement; see `free_space_rows`. inf disables them.
    collision, flesh : float [m]
        Standard deviation of collision rows between body parts, and the penetration that they allow; see
        `collision_rows`.
    skin_shift, skin_turn : float [m], [rad]
        Standard deviations of a surface's offset and rotation about its bone: where points constrain the body too, they
        limit how well a surface constrains a joint; see `rows_of` in `kinefit.fitting.frame.fit`.
        Shift: with silhouettes of the balancing trial's first 30 frames, 0 left keypoints 1.25 times as far off as
        without silhouettes, 0.01 1.07 times, 0.02 1.02 times, on a trunk that lay 1 to 1.5 cm further forward than the
        catalogue's; on the catalogue's 0.02 leaves 1.03 times. Turn: not swept. 0 takes surfaces as exact.
    camera_std : (2,) [m] and [rad], or None; own_world : bool, see `CameraErrors`
        Prior standard deviations of each camera's calibrated position and direction; the take refines them. Of three
        cameras or more, one that is significantly more than three of them off is moved. None takes calibrations as
        exact.
    view_bias : bool
        Whether to estimate a detector's bias of each keypoint by side of view, see `ViewBias`. Needs three cameras that
        see a point, and keypoints alone: with other sensors the camera extrinsics are estimated, and the bias would
        absorb their errors.
    angle_acceleration, root_acceleration : float [rad/s²], [m/s²]
        Standard deviation of the process noise.
    velocity_memory : float [s]
        Time constant with which an unobserved velocity decays.
    loss : Loss of keypoints, in their standard deviations.
    marker_loss : Loss of markers, likewise.
    pause : float [s]
        A longer gap between frames resets the velocity; a clock that steps back further has been reset.
    search : bool
        Whether to search for what is lost: a limb takes 30 ms of one core, a whole body 1 s. Without it every frame
        takes the same time, and `start_at` is the only start.
    support : float in 0..1
        Agreeing share of the evidence below which a start from triangulated points is tried.
    poor : float in 0..1
        Mean quality of the observed segments below which the whole body counts as lost and is searched for.
    doubtful : float in 0..1
        Quality of a segment below which its limb is searched for together with a lost one.
    search_after, search_every : float [s]
        Time lost before the first search, and time between two searches.
    smooth_memory : float [s]
        Time constant of an unobserved velocity when a whole take is smoothed.
    acceleration_memory : float [s]
        Time constant of an acceleration when a whole take is smoothed.
    smooth_rounds : int
        Largest number of estimates of the process noise and the sensors' noise.
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
        """Standard deviations of the calibration; None if it is taken as exact."""
        return None if self.camera_std is None else CameraErrors(*self.camera_std, self.own_world)
