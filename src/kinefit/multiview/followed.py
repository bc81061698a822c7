"""Who of the people in view is followed, and what there is to tell of the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kinefit.errors import TrackingError
from kinefit.geometry.camera import Rig
from kinefit.multiview.likeness import Pictures
from kinefit.multiview.mirrors import with_images
from kinefit.multiview.one_camera import lifted_alone, people_before
from kinefit.multiview.people import PersonTrack, may_be_several, people_of
from kinefit.observations import Keypoints
from kinefit.observations.person import FORMS, PersonChoice

PEOPLE = "people"
"""Where `Motion.provenance` has who is in view."""


@dataclass(frozen=True, eq=False)
class PersonKeypoints:
    """One person's keypoints.

    Parameters
    ----------
    keypoints : records; of this person alone where there are others
    people : everybody in view, the one of whom most is seen first; empty where nobody but one was ever detected
    number : of the person, from 1
    rate : float [Hz] of the records
    """

    keypoints: tuple[Keypoints, ...]
    people: tuple[PersonTrack, ...] = ()
    number: int = 1
    rate: float = 1.0

    def as_told(self) -> dict[str, Any]:
        """For `Motion.provenance`: nothing where there is one person."""
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
    people: Sequence[PersonTrack] | None = None, pictures: Pictures | None = None,
) -> PersonKeypoints:  # fmt: skip
    """The keypoints of one of the people in view.

    Parameters
    ----------
    rig : Rig
    keypoints : records of the same number of frames and the same rate, each of one or several people.
    person : "first" (default), "moving", "largest", "nearest X Y Z" [m], or a number from 1
    people : everybody in view, where `follow` has found them in these keypoints before
    pictures : of the cameras, by whose colours those who come back are known again

    Raises
    ------
    ObservationError
        A person in none of these forms.
    TrackingError
        A number that is more than there are people.
    """
    PersonChoice.of(person)
    if people is None:
        lifted = lifted_alone(keypoints)
        if not may_be_several(keypoints):
            people = ()
        elif lifted is not None:
            people = people_before(rig, keypoints, lifted)
        else:
            people = with_images(rig, keypoints, people_of(rig, keypoints, pictures))
    people = tuple(people)
    number = choose(people, person)
    if len(people) < 2:
        return PersonKeypoints(tuple(keypoints), people)
    own = tuple(k.of_one(chosen) for k, chosen in zip(keypoints, people[number].chosen))
    return PersonKeypoints(own, people, number + 1, keypoints[0].rate)


def choose(people: Sequence[PersonTrack], person: int | str | None) -> int:
    """Which of the people in view is meant, from 0; errors and forms as of `follow`."""
    wanted = PersonChoice.of(person)
    if wanted.way == "number" and wanted.number > max(len(people), 1):
        there = f"{len(people)} people are" if len(people) > 1 else "one person is"
        raise TrackingError(f"person {wanted.number}, but {there} in view", remedy=f"Give {FORMS}.")
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
    """Who is in view and who is followed; nothing where there is one person. `asked`: somebody chose the person."""
    told = provenance.get(PEOPLE)
    if not told:
        return []
    listed = "; ".join(
        f"{k} near ({', '.join(f'{v:.1f}' for v in one['place_m'])}) m moves {one['speed_m_s']:.2f} m/s, "
        f"{one['height_px']:.0f} px tall" for k, one in enumerate(told["each"], start=1)
    )  # fmt: skip
    why = "" if asked else ", of whom most is seen"
    said = [f"{told['in view']} people are in view, person {told['followed']} is followed{why} ({listed})"]
    for k, one in enumerate(told["each"], start=1):
        for back in one.get("returns", ()):
            said.append(
                f"person {k} leaves at {back['left_s']:.1f} s, and who comes at {back['came_s']:.1f} s is taken for "
                f"the same, by {', '.join(back['by'])} (odds {min(back['odds'], 1000):.0f} to 1)"
            )
        if one.get("maybe"):
            others = " or ".join(map(str, one["maybe"]))
            said.append(f"person {k} may be person {others}, who left before: what was seen leaves it open")
        if one.get("image_of"):
            said.append(f"person {k} is person {one['image_of']} in a mirror")
    return said
