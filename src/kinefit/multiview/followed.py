"""Select the target person among the people in view, and describe the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kinefit.errors import TrackingError
from kinefit.geometry.camera import Rig
from kinefit.multiview.likeness import ImageSource
from kinefit.multiview.mirrors import mark_mirror_images
from kinefit.multiview.one_camera import only_lifted, people_of_one_camera
from kinefit.multiview.people import PersonTrack, may_be_several, people_of
from kinefit.observations import Keypoints
from kinefit.observations.person import FORMS, PersonChoice

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
