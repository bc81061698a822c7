"""Fingers of a character: the turn from a body's finger to the bone of a character that rests in another pose."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.bodies.joint_names import DIGITS, SIDES
from kinefit.geometry import se3
from kinefit.readers.skeletons.characters import Character

_SHORTEST_BONE = 0.001  # [m] a nearer child has no direction


def common_knuckles(nodes: Container[str], side: str) -> list[str]:
    """Segments of a hand's fingers, from index to little finger, that begin at a knuckle and have a bone."""
    names = (f"{digit}_{bones[0]}_{side}" for digit, bones in DIGITS.items() if digit != "thumb")
    return [name for name in names if name in nodes]


def add_finger_axes(axes: dict[str, NDArray], character: Character, used: Mapping[str, int], body: Body) -> None:
    """Add the axes of each finger's segment in the character's world at rest.

    From the hand to the tip, a segment's axes are those of the one above it, turned the shortest way to where the
    character's bone points at rest. So a bone gets the tracked direction whatever its rest pose, and no twist about
    itself that the rest pose does not have.

    Parameters
    ----------
    axes : segment -> (3, 3) columns in the world; those of the hands are there
    character : Character
    used : segment -> node, of all that body and character share
    body : Body
        Its fingers are straight at rest.
    """
    tree = body.tree
    for side in SIDES:
        for digit, bones in DIGITS.items():
            chain = [name for bone in bones if (name := f"{digit}_{bone}_{side}") in used]
            above = f"hand_{side}"
            for name in chain if above in axes else ():
                s = tree.segment(name)
                own = tree.offsets[[*np.flatnonzero(tree.parents == s), s][0]]
                mine = _direction(character, [used[n] for n in (f"hand_{side}", *chain)], used[name])
                axes[name] = se3.shortest_turn(axes[above] @ own, mine) @ axes[above]
                above = name


def in_words(fingers: Sequence[str]) -> str:
    """Segments of fingers by hand: "both hands: ring, little, index distal"; a whole digit by its name alone."""
    hands = {}
    for side, words in SIDES.items():
        missing = []
        for digit, bones in DIGITS.items():
            lost = [bone for bone in bones if f"{digit}_{bone}_{side}" in fingers]
            missing += [digit] if len(lost) == len(bones) else [f"{digit} {bone}" for bone in lost]
        hands[f"{words['side']} hand"] = "all fingers" if missing == list(DIGITS) else ", ".join(missing)
    if len(set(hands.values())) == 1:
        hands = {"both hands": hands["left hand"]}
    return "; ".join(f"{hand}: {missing}" for hand, missing in hands.items() if missing)


def _direction(character: Character, chain: Sequence[int], node: int) -> NDArray:
    """(3,) [m] from a bone of a chain to the next; of the last to its farthest child, or on from the bone above."""
    x, after = character.positions, chain[chain.index(node) + 1 :]
    far = after[:1] or np.flatnonzero(character.parents == node)
    away = x[far] - x[node]
    if len(away) and (lengths := np.linalg.norm(away, axis=1)).max() > _SHORTEST_BONE:
        return np.asarray(away[np.argmax(lengths)])
    return np.asarray(x[node] - x[chain[chain.index(node) - 1]])
