"""Select the target person among the people in view, and describe the others.

Detect people that are mirror images of others.

Cameras see a mirror image as one more person, behind the glass and with sides swapped. It is detected by one plane that
mirrors the other person in all frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import TrackingError
from kinefit.fitting.multiview.association import confidences, heights, medians
from kinefit.fitting.multiview.likeness import ImageSource
from kinefit.fitting.multiview.people import SPEED_INTERVAL_S, PersonTrack, may_be_several, min_person_frames, people_of
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.lines import placed, triangulate_robust
from kinefit.observations import Keypoints
from kinefit.observations.recordings import FORMS, PersonChoice, mirror_name

_MAX_FRAMES = 40  # of those in which both are visible
_MIN_FRAMES = 10
_MAX_MIRROR_ERROR = 0.07  # [m] median error of the mirrored points: detections have errors of 3 to 5 cm each
_MIN_MOTION = 0.1  # [m] median motion of a person's points: two who stand still may be symmetric by chance
_MIN_CONFIDENCE = 0.1  # of points that are used
_MAX_ERROR = 0.08  # reprojection error of a point relative to the person's height


def mark_mirror_images(rig: Rig, keypoints: Sequence[Keypoints], people: Sequence[PersonTrack]) -> list[PersonTrack]:
    """Set `image_of` of people that are mirror images of others, and move them to the end of the list.

    Parameters
    ----------
    rig : Rig
    keypoints : the records in which the people were found
    people : seen by several cameras, in order of decreasing confidence
    """
    source_of: dict[int, int] = {}
    for i, one in enumerate(people):
        for j, other in enumerate(people[:i]):
            if not {i, j} & source_of.keys() and (image := _is_mirror_image(rig, keypoints, one, other)) is not None:
                source_of |= {i: j} if image else {j: i}
    order = sorted(range(len(people)), key=lambda k: k in source_of)
    return [
        replace(
            people[k], image_of=order.index(source_of[k]) if k in source_of else None,
            maybe=tuple(sorted(order.index(m) for m in people[k].maybe)),
        ) for k in order
    ]  # fmt: skip


def _is_mirror_image(rig: Rig, keypoints: Sequence[Keypoints], one: PersonTrack, other: PersonTrack) -> bool | None:
    """Whether the first of two people is the second's mirror image (True), or the reverse (False); None: neither."""
    both = np.flatnonzero((one.views > 1) & (other.views > 1))
    names = keypoints[0].names
    if len(both) < _MIN_FRAMES or any(k.names != names for k in keypoints):
        return None
    frames = both[np.unique(np.linspace(0, len(both) - 1, _MAX_FRAMES).astype(int))]
    swapped_columns = [names.index(m) if (m := mirror_name(name)) in names else k for k, name in enumerate(names)]
    a, b = (_points(rig, keypoints, person, frames) for person in (one, other))
    b = b[:, swapped_columns]
    visible = np.isfinite(a).all(axis=2) & np.isfinite(b).all(axis=2)
    if np.count_nonzero(visible.any(axis=1)) < _MIN_FRAMES:
        return None
    across, middle = (b - a)[visible], 0.5 * (a + b)[visible]
    normal = np.linalg.svd(across, full_matrices=False)[2][0]
    offsets = middle @ normal
    plane = float(np.median(offsets))
    miss = np.linalg.norm(across - np.outer(across @ normal, normal), axis=1) + 2.0 * np.abs(offsets - plane)
    motion = np.linalg.norm(a - medians(np.moveaxis(a, 0, -1)), axis=2)[visible]
    if np.median(miss) > _MAX_MIRROR_ERROR or np.median(motion) < _MIN_MOTION:
        return None
    cameras = np.median([camera.centre_world @ normal for camera in rig]) - plane
    return bool(np.median(a[visible] @ normal - plane) * cameras < 0.0)


def _points(rig: Rig, keypoints: Sequence[Keypoints], person: PersonTrack, frames: NDArray) -> NDArray:
    """(n, K, 3) [m] triangulated points of a person in some frames; NaN with fewer than two cameras."""
    chosen = [k.of_one(which) for k, which in zip(keypoints, person.chosen)]
    uv = np.stack(
        [np.where((k.confidence[frames, 0] > _MIN_CONFIDENCE)[..., None], k.points[frames, 0], np.nan) for k in chosen],
        axis=2,
    )
    height = float(medians(heights(np.moveaxis(uv, 1, 2)).ravel()))
    own = rig.select(tuple(k.camera for k in keypoints))
    x, _, _ = triangulate_robust(own, uv.reshape(-1, *uv.shape[2:]), max_residual_px=max(1.0, _MAX_ERROR * height))
    return x.reshape(*uv.shape[:2], 3)


PEOPLE = "people"
"""Key of `Motion.provenance` for the people in view."""


@dataclass(frozen=True, eq=False)
class PersonKeypoints:
    """The keypoints of the target person.

    Parameters
    ----------
    keypoints : records, reduced to this person if there are others
    people : all people in view in order of decreasing confidence; empty if there is never more than one detection
    number : of the target person, from 1
    rate : [Hz] of the records
    """

    keypoints: tuple[Keypoints, ...]
    people: tuple[PersonTrack, ...] = ()
    number: int = 1
    rate: float = 1.0

    def as_record(self) -> dict[str, Any]:
        """Entry of `Motion.provenance`: people in view and their returns; empty with a single person."""
        if len(self.people) < 2:
            return {}
        return {PEOPLE: {
            "in view": len(self.people), "followed": self.number,
            "each": [{
                "frames": int(np.sum(one.views > 0)), "views": round(float(one.views.mean()), 2),
                "speed_m_s": round(one.speed, 3), "height_px": round(one.size, 1),
                "place_m": [round(float(v), 2) for v in one.place],
                "returns": [{
                    "left_s": round(r.left / self.rate, 2), "came_s": round(r.came / self.rate, 2),
                    "odds": round(r.odds, 1), "by": list(r.by),
                } for r in one.returns],
                "maybe": [k + 1 for k in one.maybe], "image_of": None if one.image_of is None else one.image_of + 1,
            } for one in self.people],
        }}  # fmt: skip


def follow(
    rig: Rig, keypoints: Sequence[Keypoints], person: int | str | None = None,
    people: Sequence[PersonTrack] | None = None, images: ImageSource | None = None,
) -> PersonKeypoints:  # fmt: skip
    """Select the keypoints of one of the people in view.

    Parameters
    ----------
    rig : of the cameras
    keypoints : records with the same number of frames and rate, each of one or several people
    person : "first" (default, the largest sum of confidences), "moving", "largest", "nearest X Y Z" [m], or a number
        from 1
    people : result of a former call with these keypoints; default: found here
    images : of the cameras, for re-identification by colour; default: by size only

    Raises
    ------
    ObservationError
        `person` has none of these forms.
    TrackingError
        The number exceeds that of the people.
    """
    PersonChoice.of(person)
    if people is None:
        lifted = only_lifted(keypoints)
        if not may_be_several(keypoints):
            people = ()
        elif lifted is not None:
            people = people_of_one_camera(rig, keypoints, lifted)
        else:
            people = mark_mirror_images(rig, keypoints, people_of(rig, keypoints, images))
    people = tuple(people)
    number = choose(people, person)
    if len(people) < 2:
        return PersonKeypoints(tuple(keypoints), people)
    own = tuple(k.of_one(chosen) for k, chosen in zip(keypoints, people[number].chosen))
    return PersonKeypoints(own, people, number + 1, keypoints[0].rate)


def choose(people: Sequence[PersonTrack], person: int | str | None) -> int:
    """Index of the target person, from 0.

    Raises
    ------
    ObservationError, TrackingError
        As `follow`.
    """
    wanted = PersonChoice.of(person)
    if wanted.way == "number" and wanted.number > max(len(people), 1):
        count = f"{len(people)} people are" if len(people) > 1 else "one person is"
        raise TrackingError(f"no person {wanted.number}: {count} in view", remedy=f"Give {FORMS}.")
    if not people:
        return 0
    if wanted.way == "moving":
        return int(np.argmax([one.speed for one in people]))
    if wanted.way == "largest":
        return int(np.argmax([one.size for one in people]))
    if wanted.place is not None:
        return int(np.argmin([np.linalg.norm(one.place - wanted.place) for one in people]))
    return wanted.number - 1


def sentences(provenance: Mapping[str, Any], *, asked: bool) -> list[str]:
    """Sentences on the people in view and the target person; empty with one person. asked: whether the user chose."""
    entry = provenance.get(PEOPLE)
    if not entry:
        return []
    listed = "; ".join(
        f"{k} near ({', '.join(f'{v:.1f}' for v in one['place_m'])}) m moves {one['speed_m_s']:.2f} m/s, "
        f"{one['height_px']:.0f} px tall" for k, one in enumerate(entry["each"], start=1)
    )  # fmt: skip
    why = "" if asked else ", as the most visible"
    out = [f"{entry['in view']} people are in view; person {entry['followed']} is tracked{why} ({listed})"]
    for k, one in enumerate(entry["each"], start=1):
        for away in one.get("returns", ()):
            out.append(
                f"person {k} leaves at {away['left_s']:.1f} s and is re-identified at {away['came_s']:.1f} s by "
                f"{', '.join(away['by'])} (odds {min(away['odds'], 1000):.0f} to 1)"
            )
        if one.get("maybe"):
            others = " or ".join(map(str, one["maybe"]))
            out.append(f"person {k} may be person {others}, who left before: re-identification is undecided")
        if one.get("image_of"):
            out.append(f"person {k} is the mirror image of person {one['image_of']}")
    return out


def only_lifted(keypoints: Sequence[Keypoints]) -> Keypoints | None:
    """The keypoints lifted to space by a network, if there is only one camera; None otherwise."""
    of_one = len({k.camera for k in keypoints}) == 1
    return next((k for k in keypoints if k.lifted is not None), None) if of_one else None


def people_of_one_camera(rig: Rig, keypoints: Sequence[Keypoints], record: Keypoints) -> list[PersonTrack]:
    """People visible for a second in one camera, in order of decreasing confidence.

    Each column of the record is a person, as tracked by the built-in detector. Positions hold for people of the size
    that the network assumes.

    Parameters
    ----------
    keypoints : records of the camera
    record : the lifted one of them
    """
    frames = len(record)
    confidence, people = confidences(record, frames), []
    for column in range(record.points.shape[1]):
        visible = confidence[:, column] > 0
        if visible.sum() < max(min_person_frames([record], frames), 1):
            continue
        chosen = np.where(visible, column, -1)
        x = _points_world(rig[record.camera], record, column)
        speed, size = _speed(x, record.rate), np.nanmean(heights(record.points[visible, column]))
        place = np.nanmedian(np.nanmean(x[visible], axis=1), axis=0)
        choices = tuple(chosen if k is record else np.full(frames, -1) for k in keypoints)
        total = float(confidence[:, column].sum())
        people.append(PersonTrack(choices, visible.astype(int), total, speed, float(size), place))
    return sorted(people, key=lambda one: -one.confidence)


def _points_world(camera: Camera, record: Keypoints, column: int) -> NDArray:
    """(F, K, 3) [m] points of one person in the world frame."""
    assert record.lifted is not None
    return placed(camera, record.lifted[:, column], record.points[:, column])


def _speed(x: NDArray, rate: float) -> float:
    """[m/s] speed of points (F, K, 3) [m]: mean over time of their median; 0 if visible too briefly."""
    interval = max(round(SPEED_INTERVAL_S * rate), 1)
    moved = np.linalg.norm(x[interval:] - x[:-interval], axis=2)
    middles = medians(moved)
    known = np.isfinite(middles)
    return float(middles[known].mean() * rate / interval) if known.any() else 0.0
