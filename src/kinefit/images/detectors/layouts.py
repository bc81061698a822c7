"""What a landmark network gives: names of its points, the crop that it looks at, limits of its scores."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property

from kinefit.observations import MEDIAPIPE_33
from kinefit.observations.recordings import mirror_name

HEAD_POINTS = re.compile(r"nose|eye|(^[lr]?|_)ear|mouth|head")
"""In the names of points of the head, in lower case."""

SIZE = 256
"""[px] side of the crop of the built-in network, and of masks in a region."""

_MIRRORED_FACE = (  # first and last of the 68 points of a face whose numbers and partners' add up to the third
    (0, 16, 16), (17, 26, 43), (31, 35, 66), (36, 39, 81), (42, 45, 81), (40, 41, 87), (46, 47, 87), (48, 54, 102),
    (55, 59, 114), (60, 64, 124), (65, 67, 132),
)  # fmt: skip


@dataclass(frozen=True)
class PointLayout:
    """Points of a landmark network and the crop in which it finds them.

    Parameters
    ----------
    keypoint_set : str
        Set that the names are of; "" for landmarks of the body.
    names : (K,) str
    size : (width, height) [px] of the crop
    limits, search_limits : (score of a person in a region, mean confidence of the points in the image)
        Least values of somebody followed or found in the image; of somebody found in its tiles, where there are more
        false positives.
    has_masks : bool
        Whether it also gives a mask of the person, and points in space.
    """

    keypoint_set: str
    names: tuple[str, ...]
    size: tuple[int, int]
    limits: tuple[float, float] = (0.3, 0.3)  # that of MMPose's demonstrations, of boxes and of points
    search_limits: tuple[float, float] = (0.5, 0.5)
    has_masks: bool = False

    @cached_property
    def mirror(self) -> list[int]:
        """(K,) for each point the one on the other side, itself in the middle."""
        return [self.names.index(m) if (m := _mirrored(n)) in self.names else k for k, n in enumerate(self.names)]

    @cached_property
    def head(self) -> list[int]:
        """Points of nose, eyes, ears and mouth; all points where there are none."""
        return self._matching(HEAD_POINTS) or list(range(len(self.names)))

    @cached_property
    def eyes(self) -> list[int]:
        """Points of the eyes: of their middles, where there are more."""
        return self._matching(re.compile(r"^([lr]|left_|right_)eye$"))

    @cached_property
    def below_eyes(self) -> list[int]:
        """Points of the mouth, else of the shoulders: the head is upright over them."""
        return self._matching(re.compile("^mouth")) or self._matching(re.compile("shoulder"))

    def sides(self, part: str) -> list[int]:
        """Points of the left and the right of a part, as "wrist"; empty if it has not both."""
        spelt = re.compile(rf"^(l|l_|left_){part}$")
        return [k for left in self._matching(spelt) for k in (left, self.mirror[left]) if self.mirror[left] != left]

    def _matching(self, pattern: re.Pattern[str]) -> list[int]:
        return [k for k, name in enumerate(self.names) if pattern.search(name.lower())]


def _mirrored(name: str) -> str:
    """As `mirror_name`, for landmarks of bodies and the 68 points of a face, too."""
    if name[:2] in ("l_", "r_"):
        return ("r_" if name[0] == "l" else "l_") + name[2:]
    if face := re.fullmatch(r"Face(\d+)", name):
        k = int(face[1])
        return f"Face{next((total - k for first, last, total in _MIRRORED_FACE if first <= k <= last), k)}"
    return mirror_name(name)


BLAZEPOSE = PointLayout(
    "MEDIAPIPE_33", MEDIAPIPE_33, (SIZE, SIZE), limits=(0.5, 0.65),  # people 0.71 and more, a pile of boxes 0.62
    search_limits=(0.9, 0.75), has_masks=True,  # small people 0.78, machines 0.71
)  # fmt: skip
"""The built-in network, and others with its tensors."""
