"""Motion: the result of a fit over time, as arrays, with quality and uncertainty."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies.body import Body, PointSet
from kinefit.bodies.lasting_errors import LastingErrors
from kinefit.bodies.masses import segment_masses
from kinefit.bodies.tree import BodyState
from kinefit.errors import ExportError, ObservationError, check_choice
from kinefit.geometry import se3
from kinefit.geometry.force_plates import ForcePlate

UP_AXES = {
    "x": (1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-x": (-1.0, 0.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "-z": (0.0, 0.0, -1.0),
}


BELIEVED = 0.5  # share of what is seen of a segment that must speak for it: more for than against
_FRAMES_PER_BLOCK = 2000  # frames of which all segments' poses are made at once
ARRAYS = "times", "Ts_world_root", "angles", "dof_std", "joint_std", "quality", "segment_quality"
"""Of a motion, one entry a frame each."""

SHOWN_UNITS = {"px": (1.0, "px"), "m": (1000.0, "mm")}
"""Unit of residuals -> the factor and the unit in which they are shown."""

BRIEF_S = 0.1
"""[s] in which the correlation of errors that are not lasting falls to 1/e: smoothing spreads them over so much."""

OUTLIER_WEIGHT = 0.05
"""Robust weight below which a measurement had no say."""



def rotation_between_up(source: str, target: str) -> NDArray:
    """(3, 3) rotation that takes a world with vertical axis `source` to one with vertical axis `target`.

    It turns by the smallest angle, so a z-up world (x right, y away) becomes y-up (x right, z towards) and so on.
    Raises ObservationError for an axis of no such name.
    """
    for axis in (source, target):
        check_choice("vertical axis", axis, UP_AXES, ObservationError)
    a, b = np.array(UP_AXES[source]), np.array(UP_AXES[target])
    if a @ b < -0.5:  # opposite: half a turn about an axis at right angles to both
        return se3.exp_so3(np.pi * np.roll(np.abs(a), 1)).round(12) + 0.0
    return se3.exp_so3(np.cross(a, b) * (np.pi / 2)).round(12) + 0.0


@dataclass(frozen=True, eq=False)
class Residuals:
    """What one sensor's points left over after the fit.

    Parameters
    ----------
    names : (K,) of the points.
    segments : (K,) int, segment that each point belongs to.
    values : (F, K, N)
        Measured minus fitted: N = 2 [px] for a camera's keypoints, N = 3 [m] for markers; NaN where unseen.
    weights : (F, K)
        Robust weight in 0..1 with which the point took part; 0 for an outlier or an unseen point.
    unit : "px" or "m"
    measured : (F, K, N)
        The measurements as used (people chosen, left-right swaps corrected), same frame and unit as the values.
    swapped : (F,) bool
        Frames in which the detector took left for right.
    rms, count : (F, K), optional
        Of a surface's or an outline's residuals, segment by segment, of which `values` hold the signed median (N = 1).
    """

    names: tuple[str, ...]
    segments: NDArray
    values: NDArray
    weights: NDArray
    unit: str
    measured: NDArray
    swapped: NDArray
    rms: NDArray | None = None
    count: NDArray | None = None

    @property
    def of_points(self) -> bool:
        """Whether they are of single points; else of the surface of each segment."""
        return self.rms is None

    @property
    def norms(self) -> NDArray:
        """(F, K) length of each residual, NaN where unseen."""
        return np.linalg.norm(self.values, axis=-1)

    @property
    def rejected(self) -> NDArray:
        """(F, K) bool: points that were seen, but are outliers."""
        return np.isfinite(self.norms) & (np.asarray(self.weights) < OUTLIER_WEIGHT)

    def median_text(self, norms: NDArray | None = None) -> str:
        """The median of lengths (N,), by default all, in words: "2.1 px", "no data"."""
        factor, unit = SHOWN_UNITS[self.unit]
        median = factor * known_median(self.norms if norms is None else norms)
        return f"{median:.1f} {unit}" if np.isfinite(median) else "no data"


def known_median(values: NDArray) -> float:
    """Median of what is finite, NaN where nothing is."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan


def nearest_frame(times: NDArray, time: float, rate: float) -> int | None:
    """Frame nearest to a time [s], of frames at `times` (F,) [s]; None where there is none within one frame."""
    if not len(times):
        return None
    frame = int(np.argmin(np.abs(times - time)))
    return frame if abs(times[frame] - time) < 1.0 / rate else None


def turned_std(std: NDArray, R: NDArray, rays: NDArray | None = None) -> NDArray:
    """(..., 3) standard deviations along new axes; of errors along rays (..., 3) in the old ones, or along its axes."""
    var = np.square(std)
    finite = np.isfinite(var)
    var = np.where(finite, var, 0.0)
    if rays is None:
        out = var @ np.square(R).T
    else:
        across = var.min(axis=-1, keepdims=True)
        along = np.square(rays @ R.T) / np.sum(np.square(rays), axis=-1, keepdims=True)
        out = across + (var.sum(axis=-1, keepdims=True) - 3.0 * across) * along
    return np.where(finite.all(axis=-1, keepdims=True), np.sqrt(out), np.inf)


@dataclass(frozen=True)
class MarkerEvent:
    """An event marked in a recording, as a C3D has it.

    Parameters
    ----------
    label : str, such as "Foot Strike"
    time : float [s] on the recording's own clock, that of `Markers.times`
    context : str, such as "Left"; subject, description : str
    icon, flag : int, of ICON_IDS (of laboratories: 1 of a contact, 2 of a toe-off) and GENERIC_FLAGS
    source : str, name of the file that marks it
    """

    label: str
    time: float
    context: str = ""
    subject: str = ""
    description: str = ""
    icon: int = 0
    flag: int = 0
    source: str = ""


@dataclass(frozen=True, eq=False)
class Motion:
    """A body's motion.

    Parameters
    ----------
    body : Body
        Fitted: its lengths and points are those found for this subject.
    rate : float [Hz]
    times : (F,) [s]
    Ts_world_root : (F, 4, 4) [m]
    angles : (F, D) [rad] (prismatic coordinates [m])
    dof_std : (F, 6 + D) [m, rad]
        One standard deviation of the root's twist and of every coordinate; inf where nothing observes it.
    joint_std : (F, S, 3) [m]
        One standard deviation of every joint centre along the world's axes.
    quality : (F,) in 0..1
        Share of the body that its measurements support; 0 in a frame without tracking.
    segment_quality : (F, S) in 0..1
        Share of what was measured of a segment that speaks for it; 0 for one of which nothing was. See `lost`.
    residuals : sensor name -> Residuals
    up : str
        Vertical axis of the world: "x", "y", "z", "-x", "-y" or "-z".
    name : str
        Name of the take.
    provenance : Mapping
        What was done with which settings, in numbers, texts, lists and mappings (as JSON has them).
    lasting : LastingErrors
        Errors that frames have in common, see `std_of`; None where unknown.
    plates : force plates that were recorded with it, in its world and by its clock
    events : that files of the recording mark, by its clock
    """

    body: Body
    rate: float
    times: NDArray
    Ts_world_root: NDArray
    angles: NDArray
    dof_std: NDArray
    joint_std: NDArray
    quality: NDArray
    segment_quality: NDArray
    residuals: Mapping[str, Residuals] = field(default_factory=dict)
    up: str = "y"
    name: str = "motion"
    provenance: Mapping[str, Any] = field(default_factory=dict)
    lasting: LastingErrors | None = None
    plates: tuple[ForcePlate, ...] = ()
    events: tuple[MarkerEvent, ...] = ()

    def __post_init__(self) -> None:
        for name in ARRAYS:
            array = getattr(self, name)
            mine = isinstance(array, np.ndarray) and array.dtype == float and array.base is None
            if not mine or array.flags.writeable:
                try:
                    array = np.array(array, dtype=float)  # no one else holds it
                except (TypeError, ValueError) as error:
                    problem = f"{name} of a motion is a {type(array).__name__} that is not an array of numbers"
                    remedy = "Give arrays of as many frames as there are times."
                    raise ObservationError(problem, remedy=remedy) from error
                array.flags.writeable = False
            object.__setattr__(self, name, array)
        check_choice("vertical axis", self.up, UP_AXES, ObservationError)
        if not np.all(np.isfinite(self.Ts_world_root)) or not np.all(np.isfinite(self.angles)):
            raise ObservationError(
                "a motion holds poses that are not finite", remedy="Remove frames without a pose."
            )

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        return "\n".join(self._lines())

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        first, *rest = map(escape, self._lines())
        return f"<b>{first}</b><br>" + "<br>".join(rest)

    def _lines(self) -> list[str]:
        """Summary in five lines."""
        tree, worst = self.body.tree, int(np.argmin(self.quality)) if len(self) else 0
        stature = f", {self.body.stature:.2f} m tall" if self.body.stature else ""
        parts = [f"{name} ({r.median_text()})" for name, r in self.residuals.items()]
        sensors = ", ".join(parts[:6]) + (f" and {len(parts) - 6} more" if len(parts) > 6 else "")
        quality = f"{self.quality.mean():.2f} of 1 on average, lowest {self.quality[worst]:.2f} in frame {worst}"
        return [
            f"Motion {self.name}: {len(self)} frames at {self.rate:g} Hz ({len(self) / self.rate:.2f} s), {self.up} up",
            f"body {self.body.name}: {len(tree.segments)} segments, {len(tree.coordinates)} coordinates{stature}",
            f"sensors, with their median residual: {sensors or 'none'}",
            f"quality: {quality if len(self) else 'no frame'}",
            f"angles {self.angles.shape} [rad], joint_centres {self.joint_std.shape} [m], to_dataframe()",
        ]

    def parts(self, frames: int = _FRAMES_PER_BLOCK) -> Iterator[Motion]:
        """Its stretches of so many frames, without residuals: what is computed of one takes little memory."""
        for start in range(0, max(len(self), 1), frames):
            yield self.part(slice(start, start + frames))

    def part(self, frames: slice) -> Motion:
        """A stretch of its frames, without residuals."""
        arrays = {name: getattr(self, name)[frames] for name in ARRAYS}
        return replace(self, residuals={}, lasting=self.lasting and self.lasting.part(frames), **arrays)

    def frame_at(self, time: float) -> int | None:
        """Frame nearest to a time [s], None where there is none within one frame."""
        return nearest_frame(self.times, time, self.rate)

    def state(self, frame: int) -> BodyState:
        """State of the body in one frame."""
        return BodyState(self.Ts_world_root[frame], self.angles[frame])

    def segment_poses(self) -> NDArray:
        """T_world_segment (F, S, 4, 4); the translation is the joint centre [m]."""
        return self.body.tree.segment_poses(self.Ts_world_root, self.angles)

    @property
    def joint_centres(self) -> NDArray:
        """(F, S, 3) [m] joint centres in the world, in the order of `body.joints`; `joint_std` are their deviations."""
        return np.concatenate([part.segment_poses()[..., :3, 3].copy() for part in self.parts()])

    def with_mass(self, mass: float | None) -> Motion:
        """The same motion of a person of another mass [kg]; None: unchanged."""
        return self if mass is None else replace(self, body=replace(self.body, mass=mass))

    @property
    def centre_of_mass(self) -> NDArray:
        """(F, 3) [m] of the person in the world, without gear, by `segment_masses` of the body."""
        found = segment_masses(self.body)
        shares = found.masses / found.masses.sum()
        parts = (part.segment_poses() for part in self.parts())
        return np.concatenate([
            np.einsum("s,fsi->fi", shares, Ts[..., :3, 3] + np.einsum("fsij,sj->fsi", Ts[..., :3, :3], found.centres))
            for Ts in parts
        ])  # fmt: skip

    @property
    def centre_of_mass_std(self) -> NDArray:
        """(F, 3) [m] upper bound of its standard deviation along the world's axes, as if all joints erred together.

        What people differ from the table of masses is not in it.
        """
        masses = segment_masses(self.body).masses
        used = masses > 0.0
        return np.asarray(np.einsum("s,fsi->fi", masses[used] / masses.sum(), self.joint_std[:, used]))

    def to_dataframe(self) -> Any:
        """A pandas data frame of one row a frame: the columns of the tables `angles` and `joints`, and the quality.

        Angles are in degrees, lengths in metres, as the names of the columns tell; "inf" is the deviation of what
        nothing observed.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        ExportError
            pandas is not installed.
        """
        try:
            pandas = import_module("pandas")
        except ImportError as error:
            raise ExportError("pandas is not installed", remedy="Run: pip install pandas") from error
        columns = {"time [s]": self.times, **angle_columns(self), **joint_columns(self), "quality": self.quality}
        return pandas.DataFrame(columns, index=pandas.RangeIndex(len(self), name="frame"))

    def positions(self, points: PointSet | None = None) -> NDArray:
        """(F, K, 3) [m] points in the world; by default the body's landmarks."""
        points = self.body.landmarks if points is None else points
        parts = (slice(i, i + _FRAMES_PER_BLOCK) for i in range(0, max(len(self), 1), _FRAMES_PER_BLOCK))
        return np.concatenate([
            self.body.trajectories(self.Ts_world_root[part], self.angles[part], points) for part in parts
        ])  # fmt: skip

    @property
    def lost(self) -> NDArray:
        """(F, S) bool: segments that no measurement supports, or that more speaks against than for."""
        return np.asarray(self.segment_quality < BELIEVED)

    def std_of(self, frames: ArrayLike, coordinates: ArrayLike, weights: ArrayLike) -> float:
        """Standard deviation of a weighted sum of coordinates in some frames, such as one frame minus another.

        With x the coordinates and w the weights, σ² = Σ w_r w_q Cov(x_r, x_q). Cov is that of `LastingErrors`, plus,
        for one coordinate, what `dof_std`² is beyond it, which falls with exp(−|Δt| / 0.1 s). Where it is not known
        which errors frames have in common (`lasting` is None), they count as independent.

        Parameters
        ----------
        frames, coordinates : (R,) int; coordinates are numbered as in `dof_std`: the root's six, then the angles
        weights : (R,)

        Returns
        -------
        float [m, rad]; inf where a coordinate was not observed
        """
        f, c, w = np.asarray(frames), np.asarray(coordinates), np.asarray(weights, float)
        own = np.square(self.dof_std[f, c])
        if not np.all(np.isfinite(own)):
            return np.inf
        if self.lasting is None:
            return float(np.sqrt(w**2 @ own))
        constant, drift = self.lasting.at(f, c)
        brief = np.sqrt(np.maximum(own - np.square(constant).sum(axis=1) - np.square(drift).sum(axis=1), 0.0))
        apart = np.abs(self.times[f][:, None] - self.times[f])
        together = constant @ constant.T + np.exp(-apart / max(self.lasting.drift_time, 1e-9)) * (drift @ drift.T)
        together += (c[:, None] == c) * np.exp(-apart / BRIEF_S) * np.outer(brief, brief)
        return float(np.sqrt(max(w @ together @ w, 0.0)))

    def moved(self, T_new_world: NDArray, eye: NDArray | None = None) -> Motion:
        """The same motion in another world with the same vertical axis, such as one whose floor is level.

        Parameters
        ----------
        T_new_world : (4, 4) [m]
        eye : (3,) [m] in the old world, of a camera that is the only sensor: errors are taken to lie along its rays.
            Default: along the old axes.
        """
        R, rays = T_new_world[:3, :3], None if eye is None else self.joint_centres - eye
        shift = turned_std(self.dof_std[:, :3], R, None if rays is None else rays[:, 0])
        turn = turned_std(self.dof_std[:, 3:6], R)
        dof_std = np.concatenate([shift, turn, self.dof_std[:, 6:]], axis=1)
        return self._in_world(T_new_world, turned_std(self.joint_std, R, rays), dof_std)

    def turned(self, up: str) -> Motion:
        """The same motion in a world whose vertical axis is `up`."""
        if up == self.up:
            return self
        R = rotation_between_up(self.up, up)
        T = se3.transform(R, np.zeros(3))
        axis = np.argmax(np.abs(R), axis=1)  # R takes axes onto axes; a product with it would make NaN of ∞ · 0
        dof_std = self.dof_std[:, np.concatenate([axis, 3 + axis, np.arange(6, self.dof_std.shape[1])])]
        return replace(self._in_world(T, self.joint_std[..., axis], dof_std), up=up)

    def _in_world(self, T_new_world: NDArray, joint_std: NDArray, dof_std: NDArray) -> Motion:
        """The motion in another world (4, 4) [m], with the standard deviations there."""
        R = T_new_world[:3, :3]
        residuals = {
            name: replace(r, values=r.values @ R.T, measured=se3.apply(T_new_world, r.measured))
            if r.unit == "m" and r.of_points else r
            for name, r in self.residuals.items()
        }  # fmt: skip
        return replace(
            self, Ts_world_root=T_new_world @ self.Ts_world_root, residuals=residuals,
            lasting=self.lasting and self.lasting.turned(R), plates=tuple(p.moved(T_new_world) for p in self.plates),
            joint_std=joint_std, dof_std=dof_std,
        )  # fmt: skip


Columns = dict[str, NDArray]


def angle_columns(motion: Motion, factor: float = 1.0, unit: str = "m") -> Columns:
    """Every coordinate [deg] (sliding ones: length) with its standard deviation, and the root: place, unit quaternion.

    Parameters
    ----------
    factor, unit : of lengths, units in a metre and their name.
    """
    body = motion.body
    units = [unit] * 3 + ["deg"] * 3 + [unit if slides else "deg" for slides in body.tree.prismatic]
    factors = np.array([np.degrees(1.0) if u == "deg" else factor for u in units])
    stds, angles = motion.dof_std * factors, motion.angles * factors[6:]
    quaternions = continuous_quaternions(motion.Ts_world_root[:, :3, :3])
    out = {f"root_t{axis} [{unit}]": factor * motion.Ts_world_root[:, i, 3] for i, axis in enumerate("xyz")}
    out |= {f"root_q{part}": quaternions[:, i] for i, part in enumerate("wxyz")}
    out |= {f"{name} [{unit}]": angles[:, d] for d, (name, unit) in enumerate(zip(body.tree.coordinates, units[6:]))}
    return out | {f"{name} std [{unit}]": stds[:, d] for d, (name, unit) in enumerate(zip(body.dof_names, units))}


def joint_columns(
    motion: Motion, names: Sequence[str] | None = None, factor: float = 1.0, unit: str = "m"
) -> Columns:
    """Joint centres and the centre of mass, "com", with standard deviations along the world's axes.

    `names` default to the body's joints.
    """
    names = names or motion.body.joints
    joints = place_columns(names, factor * motion.joint_centres, unit)
    joints |= place_columns(names, factor * motion.joint_std, unit, " std")
    centre = place_columns(["com"], factor * motion.centre_of_mass[:, None], unit)
    return joints | centre | place_columns(["com"], factor * motion.centre_of_mass_std[:, None], unit, " std")


def place_columns(names: Sequence[str], positions: NDArray, unit: str, suffix: str = "") -> Columns:
    """Places (F, K, 3) of K names."""
    axes = list(enumerate("xyz"))
    return {f"{n} {axis}{suffix} [{unit}]": positions[:, k, i] for k, n in enumerate(names) for i, axis in axes}


def continuous_quaternions(rotations: NDArray, before: NDArray | None = None) -> NDArray:
    """Quaternions (F, ..., 4) as (w, x, y, z) of rotations (F, ..., 3, 3).

    Of the two signs the nearer to the frame before is taken; `before` (..., 4) is that of the frame before the first.
    """
    q = se3.quaternion(rotations)
    last = q[:1] if before is None else before[None]
    flips = np.sum(q * np.concatenate([last, q])[:-1], axis=-1) < 0
    q *= np.where(np.cumsum(flips, axis=0) % 2, -1.0, 1.0)[..., None]
    return q
