"""Joint names of other programs' skeletons, mapped to segments: for recorded motions and for characters."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

from kinefit.bodies.body import Body
from kinefit.bodies.limbs import FACE
from kinefit.bodies.toml.bodies import read_toml_body
from kinefit.errors import BodyError, ObservationError, choices

SIDES = {
    "l": {"s": "l", "S": "L", "Side": "Left", "side": "left"},
    "r": {"s": "r", "S": "R", "Side": "Right", "side": "right"},
}
"""Values of {s}, {S}, {Side} and {side} in a name."""

LIMBS = ("thigh", "shank", "foot", "toes", "upperarm", "forearm", "hand")
"""Segments of both sides, with their joints hip, knee, ankle, ball of the foot, shoulder, elbow, wrist."""

SEGMENTS = ("pelvis", "abdomen", "thorax", "neck", "head") + tuple(
    f"{name}_{side}" for name in ("clavicle", *LIMBS) for side in SIDES
)
"""Segments of the humanoid, and the neck, that a joint may be mapped to."""

DIGITS = {
    "thumb": ("metacarpal", "proximal", "distal"),
    **dict.fromkeys(("index", "middle", "ring", "little"), ("proximal", "middle", "distal")),
}
"""Digits of a hand -> its bones, from the palm to the tip."""

FINGERS = tuple(f"{digit}_{bone}_{side}" for side in SIDES for digit, bones in DIGITS.items() for bone in bones)
"""Segments of the fingers of `humanoid_hands`, from the palm to the tip; a character may have none."""

ENDS = ("head_top",) + tuple(f"{name}_{side}" for name in ("toe_end", "knuckle") for side in SIDES)
"""Ends of bones that a table of names may also contain."""

_NEEDED = ("pelvis", "head") + tuple(
    f"{name}_{side}" for name in ("thigh", "shank", "foot", "upperarm", "forearm", "hand") for side in SIDES
)


@dataclass(frozen=True, eq=False)
class NamingConvention:
    """Joint names of one family of skeletons; {s}, {S}, {Side}, {side} are replaced by l, L, Left, left.

    Parameters
    ----------
    name : str
    trunk : segment of `SEGMENTS` without a side -> name; "clavicle" with one.
    limbs : names of hip, knee, ankle, ball of the foot, shoulder, elbow, wrist.
    spine : of recorded motions, names of the joints at the sacrum, a third of the way up the spine, at the root of the
        neck, in the head; default those of abdomen, thorax, neck, head.
    knuckle, toe_end : names of a finger's first joint, of the tip of the toes; None: the first child of hand and toes.
    hand : name of the joint whose frame rotates with the hand (at rest the thumbs point forward), or of two joints, the
        second one on the thumb's side; default the wrist.
    head_top : name of the top of the head; None: the eyes give the orientation of the head, else the head's child.
    eyes : name of the eyes, or None.
    upright : (forward, up) of the bones "pelvis", "abdomen", "thorax", "head" of an upright person; None if the rest
        pose of the file is upright.
    """

    name: str
    trunk: Mapping[str, str]
    limbs: tuple[str, ...]
    spine: tuple[str, ...] = ()
    knuckle: str | None = None
    toe_end: str | None = None
    hand: tuple[str, ...] = ()
    head_top: str | None = None
    eyes: str | None = None
    upright: tuple[tuple[float, float], ...] | None = None

    @property
    def joints(self) -> dict[str, str]:
        """Segment of `SEGMENTS` -> name of the joint that moves it."""
        out = {segment: name for segment, name in self.trunk.items() if segment != "clavicle"}
        for side, words in SIDES.items():
            out |= {f"{limb}_{side}": name.format(**words) for limb, name in zip(LIMBS, self.limbs)}
            if "clavicle" in self.trunk:
                out[f"clavicle_{side}"] = self.trunk["clavicle"].format(**words)
        return out

    @property
    def recorded(self) -> dict[str, str]:
        """Role of a joint, see `Recorded` -> its name, in recorded motions."""
        spine = self.spine or tuple(self.trunk[segment] for segment in ("abdomen", "thorax", "neck", "head"))
        out = dict(zip(("sacrum", "spine", "neck", "head"), spine))
        ends = {"knuckle": self.knuckle, "toe_end": self.toe_end, "eye": self.eyes}
        sides = {**dict(zip(LIMBS, self.limbs)), **ends, **dict(zip(("palm", "thumb"), self.hand))}
        for side, words in SIDES.items():
            out |= {f"{role}_{side}": name.format(**words) for role, name in sides.items() if name}
        return out | ({"head_top": self.head_top} if self.head_top else {})


def _trunk(*names: str) -> dict[str, str]:
    """Names of pelvis, abdomen, thorax, neck, head, clavicle; "" for none."""
    return {segment: name for segment, name in zip((*SEGMENTS[:5], "clavicle"), names) if name}


_LIMBS_BVH = ("{Side}UpLeg", "{Side}Leg", "{Side}Foot", "{Side}ToeBase", "{Side}Arm", "{Side}ForeArm", "{Side}Hand")

FAMILIES = (
    NamingConvention(
        "Mixamo", _trunk("Hips", "Spine", "Spine2", "Neck", "Head", "{Side}Shoulder"), _LIMBS_BVH,
        knuckle="{Side}HandMiddle1", toe_end="{Side}Toe_End", head_top="HeadTop_End",
    ),
    NamingConvention(
        "Acclaim (CMU)", _trunk("root", "lowerback", "thorax", "lowerneck", "head", "{s}clavicle"),
        ("{s}femur", "{s}tibia", "{s}foot", "{s}toes", "{s}humerus", "{s}radius", "{s}wrist"),
        ("root", "upperback", "lowerneck", "head"), "{s}fingers", "{s}toes_end", ("{s}hand",), "head_end",
    ),
    NamingConvention(
        "MotionBuilder (CMU)", _trunk("Hips", "LowerBack", "Spine1", "Neck", "Head", "{Side}Shoulder"), _LIMBS_BVH,
        ("Hips", "Spine", "Neck", "Head"), "{Side}HandIndex1", "{Side}ToeBase_end", ("{Side}FingerBase",), "Head_end",
    ),
    NamingConvention(
        "hip and knee (CMU)", _trunk("Hips", "", "Chest", "lowerneck", "Head", "{Side}Collar"),
        ("{Side}Hip", "{Side}Knee", "{Side}Ankle", "{Side}Toe", "{Side}Shoulder", "{Side}Elbow", "{Side}Wrist"),
        ("Hips", "Chest", "lowerneck", "Head"), "{S}Fingers", "{Side}Toe_end", ("{s}hand",), "Head_end",
    ),
    NamingConvention(
        "AnimatedDrawings", _trunk("Hips", "Spine", "Spine1", "Neck", "Head", "{Side}Shoulder"), _LIMBS_BVH,
        ("Hips", "Spine1", "Neck", "Head"), "{Side}HandEnd", "{Side}ToeBase_end", ("{Side}Hand",), "Head_end",
    ),
    NamingConvention(
        "iClone", _trunk("CC_Base_Hip", "CC_Base_Waist", "CC_Base_Spine02", "CC_Base_NeckTwist01", "CC_Base_Head",
                         "CC_Base_{S}_Clavicle"),
        ("CC_Base_{S}_Thigh", "CC_Base_{S}_Calf", "CC_Base_{S}_Foot", "CC_Base_{S}_ToeBase", "CC_Base_{S}_Upperarm",
         "CC_Base_{S}_Forearm", "CC_Base_{S}_Hand"),
        ("CC_Base_Waist", "CC_Base_Spine01", "CC_Base_NeckTwist01", "CC_Base_Head"), "CC_Base_{S}_Mid1",
        "CC_Base_{S}_MidToe1", ("CC_Base_{S}_Pinky1", "CC_Base_{S}_Index1"), eyes="CC_Base_{S}_Eye",
        upright=((0.17, 0.985), (0.588, 0.809), (-0.19, 0.982), (0.543, 0.84)),
    ),
    NamingConvention(
        "VRM, Unity", _trunk("hips", "spine", "chest", "neck", "head", "{side}Shoulder"),
        ("{side}UpperLeg", "{side}LowerLeg", "{side}Foot", "{side}Toes", "{side}UpperArm", "{side}LowerArm",
         "{side}Hand"), knuckle="{side}MiddleProximal",
    ),
    NamingConvention(
        "Unreal", _trunk("pelvis", "spine_01", "spine_03", "neck_01", "head", "clavicle_{s}"),
        ("thigh_{s}", "calf_{s}", "foot_{s}", "ball_{s}", "upperarm_{s}", "lowerarm_{s}", "hand_{s}"),
        knuckle="middle_01_{s}",
    ),
    NamingConvention(
        "Rokoko", _trunk("Hips", "Spine1", "Spine4", "Neck", "Head", "{Side}Shoulder"),
        ("{Side}Thigh", "{Side}Shin", "{Side}Foot", "{Side}Toe", "{Side}Arm", "{Side}ForeArm", "{Side}Hand"),
        knuckle="{Side}Finger3Metacarpal",
    ),
    NamingConvention(
        "Biped", _trunk("Pelvis", "Spine", "Spine2", "Neck", "Head", "{S} Clavicle"),
        ("{S} Thigh", "{S} Calf", "{S} Foot", "{S} Toe0", "{S} UpperArm", "{S} Forearm", "{S} Hand"),
        knuckle="{S} Finger2",
    ),
    NamingConvention(
        "SMPL", _trunk("Pelvis", "Spine1", "Spine3", "Neck", "Head", "{S}_Collar"),
        ("{S}_Hip", "{S}_Knee", "{S}_Ankle", "{S}_Foot", "{S}_Shoulder", "{S}_Elbow", "{S}_Wrist"),
        knuckle="{S}_Hand",
    ),
    NamingConvention(
        "Rigify", _trunk("spine", "spine.001", "spine.003", "spine.004", "spine.006", "shoulder.{S}"),
        ("thigh.{S}", "shin.{S}", "foot.{S}", "toe.{S}", "upper_arm.{S}", "forearm.{S}", "hand.{S}"),
        knuckle="f_middle.01.{S}",
    ),
)  # fmt: skip
"""Known families; `conventions` adds those of the body files."""


def _fingers(pattern: str, digits: str, bones: str = "1 2 3", thumb: str = "") -> dict[str, str]:
    """Segment of `FINGERS` -> name, from a pattern with * for the digit and # for its bone."""
    out = dict[str, str]()
    for (digit, segments), word in zip(DIGITS.items(), digits.split()):
        for segment, number in zip(segments, (thumb if thumb and digit == "thumb" else bones).split(" ")):
            name = pattern.replace("*", word).replace("#", number)
            out |= {f"{digit}_{segment}_{side}": name.format(**words) for side, words in SIDES.items()}
    return out


_UNITY = "Proximal Intermediate Distal"
VRM0_FINGERS = _fingers("{side}*#", "Thumb Index Middle Ring Little", _UNITY)
"""Names of VRM 0 and of Unity's humanoid, in which "proximal" is the thumb's metacarpal."""
VRM1_FINGERS = _fingers("{side}*#", "Thumb Index Middle Ring Little", _UNITY, "Metacarpal Proximal Distal")
"""Names of VRM 1."""
_UNREAL_FINGERS = _fingers("*_0#_{s}", "thumb index middle ring pinky")

_FINGER_NAMES = (
    _fingers("{Side}Hand*#", "Thumb Index Middle Ring Pinky"),  # Mixamo, MotionBuilder
    VRM1_FINGERS,
    VRM0_FINGERS,
    _UNREAL_FINGERS,
    _fingers("*.0#.{S}", "thumb f_index f_middle f_ring f_pinky"),  # Rigify
    _fingers("CC_Base_{S}_*#", "Thumb Index Mid Ring Pinky"),  # iClone
    _fingers("{S} Finger*#", "0 1 2 3 4", " 1 2"),  # Biped
    _fingers("{side}_*#", "thumb index middle ring pinky"),  # SMPL-H, SMPL-X
)


def _bones(family: str) -> dict[str, str]:
    return next(known.joints for known in FAMILIES if known.name == family)


_VRM_BONES = _bones("VRM, Unity") | {segment: names[0] for segment, names in FACE.items()}

CHARACTER_BONES = {
    "vrm": _VRM_BONES | VRM1_FINGERS,
    "unity": {segment: name[0].upper() + name[1:] for segment, name in (_VRM_BONES | VRM0_FINGERS).items()},
    "unreal": _bones("Unreal") | _UNREAL_FINGERS,
}
"""Convention -> segment of the humanoid -> bone: VRM 1, HumanBodyBones of Unity, the mannequin of Unreal."""


@cache
def conventions() -> tuple[NamingConvention, ...]:
    """`FAMILIES`, and the conventions in which motions are exported ("mixamo", "hanim", ...)."""
    out = list(FAMILIES)
    body = read_toml_body("humanoid_hands")
    for name, names in {**body.aliases, **CHARACTER_BONES, "kinefit": {s: s for s in body.tree.segments}}.items():
        out.append(_ExplicitNaming(name, names))
    return tuple(out)


def humanoid_segments(body: Body) -> dict[str, str]:
    """Segment of a body -> its name in the humanoid, by the body's names for BVH; without one its own name."""
    segments = {bone: segment for segment, bone in read_toml_body("humanoid_hands").aliases["bvh"].items()}
    return {segment: segments.get(body.alias("bvh", segment), segment) for segment in body.tree.segments}


def segment_names(body: Body, convention: str) -> dict[str, str]:
    """Segment of a body -> its name in a convention: as the body file states, else as in `CHARACTER_BONES`."""
    bones = CHARACTER_BONES.get(convention, {})
    found = {own: bones[segment] for own, segment in humanoid_segments(body).items() if segment in bones}
    return found | dict(body.aliases.get(convention, {}))


@dataclass(frozen=True, eq=False)
class _ExplicitNaming(NamingConvention):
    """A family whose `trunk` contains the joints of limbs too."""

    limbs: tuple[str, ...] = ()

    @property
    def joints(self) -> dict[str, str]:
        return {segment: name for segment, name in self.trunk.items() if segment in SEGMENTS}

    @property
    def recorded(self) -> dict[str, str]:
        """Roles in kinefit's exports: the head's joint is at the root of the neck, and bones have no end points."""
        out = {"sacrum": "abdomen", "spine": "thorax", "neck": "head", "head": "head"}
        out |= {segment: segment for segment in self.joints if segment.rpartition("_")[0] in LIMBS}
        return {role: self.trunk[segment] for role, segment in out.items()}


@cache  # characters have up to 20,000 nodes, each compared with some 800 names
def plain(name: str) -> str:
    """Normalise a name: no namespace, program's prefix, capitals, separators; "mixamorig1:LeftArm" is "leftarm"."""
    last = re.split(r"[:|]", name)[-1]
    last = re.sub(r"(?i)^(mixamorig\d*|bip0*1|def)[ _\-]", "", last)
    return re.sub(r"[\s_.\-]+", "", last).lower()


def find(names: Sequence[str], name: str) -> int | None:
    """Index of the joint of that name, or the first that differs only in prefix, capitals or separators; else None."""
    if name in names:
        return list(names).index(name)
    key = plain(name)
    return next((i for i, other in enumerate(names) if plain(other) == key), None)


def joint_map(names: Sequence[str], table: Mapping[str, str] | None = None, *, source: str = "") -> dict[str, int]:
    """Map the joints of a character to segments by their names.

    Parameters
    ----------
    names : (J,) of the joints.
    table : segment of `SEGMENTS`, `FINGERS` or `FACE` -> name of a joint, optional
        Overrides the conventions.
    source : str
        File of the character, for messages.

    Returns
    -------
    segment -> index of the joint
        `FINGERS` follow the convention with most matches, whatever the convention of the other joints.

    Raises
    ------
    BodyError
        A table with an unknown joint, a joint named twice, or a skeleton without the required joints.
    """
    explicit_joints = {}
    for segment, name in (table or {}).items():
        index = find(names, name)
        if index is None:
            raise BodyError(choices("joint", name, names), file=source or None, place=f"table of names, {segment}")
        if segment in (*SEGMENTS, *FINGERS, *FACE):
            explicit_joints[segment] = index
    found = [
        (family, {s: i for s, n in family.joints.items() if (i := find(names, n)) is not None} | explicit_joints)
        for family in conventions()
    ]
    family, best = max(found, key=lambda pair: (-len(lacking(pair[1])), len(pair[1])))
    if missing := lacking(best):
        wanted = [f"{segment} ('{family.joints[segment]}' in {family.name})" if segment in family.joints else segment
                  for segment in missing]  # fmt: skip
        known = ", ".join(family.name for family in FAMILIES)
        remedy = f"Name its joints by a table (--names-table), or as one of: {known}. It has: {', '.join(names)}"
        raise BodyError(f"the character has no joint for {', '.join(wanted)}", file=source or None, remedy=remedy)
    if twice := [names[i] for i in set(best.values()) if list(best.values()).count(i) > 1]:
        raise BodyError(f"the joint '{twice[0]}' is assigned to two segments", file=source or None)
    explicit = ({s: n for s, n in f.trunk.items() if s in FINGERS} for f in conventions() if f not in FAMILIES)
    fingers = [
        {s: i for s, n in table.items() if (i := find(names, n)) is not None and i not in best.values()}
        for table in (*_FINGER_NAMES, *explicit)
    ]
    face = {s: i for s, known in FACE.items() for n in known if (i := find(names, n)) is not None}
    return {s: i for s, i in face.items() if i not in best.values()} | max(fingers, key=len) | best


def lacking(segments: Iterable[str]) -> list[str]:
    """Required segments that are missing."""
    there = set(segments)
    return [segment for segment in _NEEDED if segment not in there]


@dataclass(frozen=True)
class Recorded:
    """Joints of a recorded skeleton.

    Parameters
    ----------
    family : str
    joints : role of a joint -> its index
        "sacrum", "spine", "neck", "head", of both sides `LIMBS`; optional "head_top", "knuckle_l", "toe_end_l",
        "eye_l", "palm_l" (its frame rotates with the hand), "thumb_l" (then "palm_l" is on the other side).
    upright : see `NamingConvention`.
    """

    family: str
    joints: Mapping[str, int]
    upright: tuple[tuple[float, float], ...] | None = None


def recorded_joints(names: Sequence[str], table: Mapping[str, str] | None = None, *, source: str = "") -> Recorded:
    """Map the joints of a recorded skeleton to their roles by their names, or by a table alone if given.

    Names are those of `FAMILIES`, or of a convention in which kinefit exports.

    Parameters
    ----------
    names : (J,) of the joints.
    table : segment of `SEGMENTS`, or one of `ENDS` -> name of a joint, optional
    source : str
        File of the skeleton, for messages.

    Raises
    ------
    ObservationError
        No family fits; the message names the joints missing for the nearest one.
    """
    if table:
        family = NamingConvention("table of names", {}, ())
        wanted = {"sacrum": table.get("abdomen", table.get("pelvis", "")), "spine": table.get("thorax", ""), **table}
        known = ("sacrum", "spine", "neck", "head", *(f"{limb}_{side}" for limb in LIMBS for side in SIDES), *ENDS)
        wanted = {role: wanted.get(role, "") for role in known if role not in ENDS or role in wanted}
    else:
        short = {family: [n for n in family.recorded.values() if find(names, n) is None] for family in FAMILIES}
        spelled = {family: sum(n not in names for n in family.recorded.values()) for family in conventions()}
        family = min(FAMILIES, key=lambda f: (len(short[f]) / len(f.recorded), spelled[f]))
        exported = (f for f in conventions() if isinstance(f, _ExplicitNaming))
        own = (f for f in exported if all(find(names, n) is not None for n in f.recorded.values()))
        family = min(own, key=lambda f: spelled[f], default=family) if short[family] else family
        wanted = family.recorded
    missing = {role: name for role, name in wanted.items() if find(names, name) is None}
    if missing:
        of = f"of no known family ({', '.join(f.name for f in FAMILIES)}); for '{family.name}' it"
        words = [f"{name or 'no name'} ({role})" if table else name for role, name in missing.items()]
        lacks = ", ".join(dict.fromkeys(words))
        remedy = "Rename its joints to those of a known family, or name them by --names-table."
        problem = f"the skeleton is {of} lacks: {lacks}" if not table else f"for the table of names it lacks: {lacks}"
        raise ObservationError(problem, file=source or None, remedy=remedy)
    return Recorded(family.name, {role: find(names, name) or 0 for role, name in wanted.items()}, family.upright)
