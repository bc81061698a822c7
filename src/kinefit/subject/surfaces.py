"""Parameters of a body's surface: girths or whole cylinders, or the shape of an Anny body."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.bodies.anny import AnnyFamily, AnnyModel
from kinefit.bodies.flesh import with_flesh
from kinefit.bodies.surfaces import Metaballs, Surface, TaperedCylinder
from kinefit.errors import BodyError
from kinefit.subject.metaballs import MetaballShape
from kinefit.subject.parameters import Parameters, World

GIRTH, OFFSET = 0.2, 0.015
"""Standard deviations between people: of the logarithm of a half axis (ANSUR II: girths by 10 %; a body of cylinders
differs from a person's by as much again), and of where a surface lies about its bone [m]."""

_KINDS = ("start a", "start b", "end a", "end b", "start offset", "end offset")
_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class CylinderShape:
    """Half axes (logarithms) and forward offsets [m] of tapered cylinders; left and right alike.

    Parameters
    ----------
    body : Body with cylinders.
    girth, offset : standard deviation of the logarithm of a half axis, and of an offset [m].

    Raises
    ------
    BodyError
        A body without cylinders.
    """

    body: Body
    girth: float = GIRTH
    offset: float = OFFSET

    def __post_init__(self) -> None:
        if not any(isinstance(s, TaperedCylinder) for s in self.body.surfaces):
            raise BodyError(f"body '{self.body.name}' has no cylinders", remedy="Give its segments a `surface`.")

    @cached_property
    def _groups(self) -> tuple[tuple[str, ...], tuple[int, ...]]:
        """Names of what left and right share, and the group of each surface (-1 for a mesh)."""
        names: dict[str, int] = {}
        count = [0] * len(self.body.tree.segments)
        of = []
        for s in self.body.surfaces:
            own = self.body.tree.segments[s.segment].removesuffix("_r").removesuffix("_l")
            key = f"{own} {count[s.segment]}".removesuffix(" 0")
            count[s.segment] += 1
            of.append(names.setdefault(key, len(names)) if isinstance(s, TaperedCylinder) else -1)
        return tuple(names), tuple(of)

    @property
    def names(self) -> tuple[str, ...]:
        """(6 C,)."""
        return tuple(f"{name} {kind}" for name in self._groups[0] for kind in _KINDS)

    @property
    def touches(self) -> tuple[frozenset[int], ...]:
        """Of each parameter the segments that it changes."""
        names, of = self._groups
        on = [frozenset(s.segment for s, g in zip(self.body.surfaces, of) if g == k) for k in range(len(names))]
        return tuple(segments for segments in on for _ in _KINDS)

    @property
    def mean(self) -> NDArray:
        """(6 C,) zero."""
        return np.zeros(len(self.names))

    @property
    def information(self) -> NDArray:
        """(6 C, 6 C)."""
        return np.diag(np.tile([self.girth] * 4 + [self.offset] * 2, len(self._groups[0])) ** -2.0)

    @property
    def step(self) -> NDArray:
        """(6 C,) of logarithms, and a tenth of that in metres."""
        return np.tile([_STEP] * 4 + [0.1 * _STEP] * 2, len(self._groups[0]))

    def apply(self, world: World, values: NDArray) -> World:
        """The body with these cylinders."""
        sizes = np.asarray(values, float).reshape(-1, 6).tolist()
        surfaces = tuple(
            _shaped(s, tuple(sizes[g])) if isinstance(s, TaperedCylinder) else s
            for s, g in zip(world.body.surfaces, self._groups[1], strict=True)
        )
        return replace(world, body=replace(world.body, surfaces=surfaces))


@dataclass(frozen=True, eq=False)
class Girths:
    """Logarithms of the girths of a body's cylinders along both half axes, one pair for each of its scale groups.

    Who is thick is so all over: half of the variance is common to all girths. A few frames tell these, where they leave
    the many numbers of a `CylinderShape` to its prior.

    Parameters
    ----------
    body : Body with cylinders.
    girth : standard deviation of each.

    Raises
    ------
    BodyError
        A body without cylinders.
    """

    body: Body
    girth: float = GIRTH

    def __post_init__(self) -> None:
        if not self._groups:
            raise BodyError(f"body '{self.body.name}' has no cylinders", remedy="Give its segments a `surface`.")

    @cached_property
    def _groups(self) -> tuple[int, ...]:
        """Scale groups that have cylinders."""
        of = self.body.segment_scale
        return tuple(sorted({int(of[s.segment]) for s in self.body.surfaces if isinstance(s, TaperedCylinder)}))

    @property
    def names(self) -> tuple[str, ...]:
        """(2 G,)."""
        return tuple(f"girth {self.body.scale_groups[g]} {axis}" for g in self._groups for axis in "ab")

    @property
    def touches(self) -> tuple[frozenset[int], ...]:
        """Of each parameter the segments that it changes."""
        on = [frozenset(np.flatnonzero(self.body.segment_scale == g).tolist()) for g in self._groups]
        return tuple(segments for segments in on for _ in "ab")

    @property
    def mean(self) -> NDArray:
        """(2 G,) zero."""
        return np.zeros(len(self.names))

    @property
    def information(self) -> NDArray:
        """(2 G, 2 G)."""
        return np.linalg.inv(self.girth**2 * (0.5 * np.eye(len(self.names)) + 0.5))

    @property
    def step(self) -> NDArray:
        """(2 G,)."""
        return np.full(len(self.names), _STEP)

    def apply(self, world: World, values: NDArray) -> World:
        """The body with these girths."""
        size = np.zeros((len(self.body.scale_groups), 6))
        size[list(self._groups), :4] = np.tile(np.reshape(values, (-1, 2)), 2)
        sizes = [tuple(one) for one in size.tolist()]
        surfaces = tuple(
            _shaped(s, sizes[self.body.segment_scale[s.segment]]) if isinstance(s, TaperedCylinder) else s
            for s in world.body.surfaces
        )
        return replace(world, body=replace(world.body, surfaces=surfaces))


@lru_cache(maxsize=4096)  # of two worlds that differ in one parameter, most surfaces are the same
def _shaped(surface: TaperedCylinder, size: tuple[float, ...]) -> Surface:
    (a0, b0), (a1, b1) = (np.exp(np.reshape(size[:4], (2, 2))) * surface.radii).tolist()
    a = surface.axes[0]
    start, end = (np.add(at, shift * a) for at, shift in zip((surface.start, surface.end), size[4:]))
    return replace(
        surface, start=tuple(start.tolist()), end=tuple(end.tolist()), radii=((a0, b0), (a1, b1)),
        side=tuple(a.tolist()),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class AnnyShape:
    """Sex, muscle, weight, height and proportions of an Anny body, as logits over 4 about a mean shape.

    By itself it makes the body anew, so it goes before all other parameters; lengths beside the shape's are
    `SegmentScales` after it, and the body that is fitted is one of the model's. With `flesh` it leaves bones and points
    as it finds them, and changes what lies on them.

    Parameters
    ----------
    model : AnnyModel
    usual : (6,) shape parameters at zero.
    std : standard deviation of each: about a quarter of its range.
    flesh : whether bones and points stay.
    """

    model: AnnyModel
    usual: NDArray
    std: float = 0.25
    flesh: bool = False

    @cached_property
    def _family(self) -> AnnyFamily:
        return AnnyFamily(self.model, np.asarray(self.usual, float))

    @cached_property
    def _made(self) -> Callable[[bytes], Body]:
        return lru_cache(maxsize=16)(lambda values: self._family.at(np.frombuffer(values)))

    def __getstate__(self) -> dict[str, Any]:
        """Without the bodies that were made, which are made again."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_made", "_family")}

    @property
    def names(self) -> tuple[str, ...]:
        """(5,)."""
        return tuple(f"anny {name}" for name in self._family.names)

    @property
    def mean(self) -> NDArray:
        """(5,) zero."""
        return np.zeros(len(self.names))

    @property
    def information(self) -> NDArray:
        """(5, 5)."""
        return np.eye(len(self.names)) / self.std**2

    @property
    def step(self) -> NDArray:
        """(5,)."""
        return np.full(len(self.names), _STEP)

    def apply(self, world: World, values: NDArray) -> World:
        """The world with a body of this shape."""
        made, usual = (self._made(np.asarray(v, float).tobytes()) for v in (values, self.mean))
        return replace(world, body=with_flesh(world.body, made, usual) if self.flesh else made)


def shape_of(body: Body) -> list[Parameters]:
    """What a take with surfaces tells of a body beside its lengths: Anny's shape, girths, radii of metaballs.

    A mesh, or a skin of another make, is taken as it is.
    """
    family = body.family
    if isinstance(family, AnnyFamily) and family.model.segments == body.tree.segments:
        return [AnnyShape(family.model, family.usual, flesh=True)]
    cylinders = any(isinstance(s, TaperedCylinder) for s in body.surfaces)
    out: list[Parameters] = [CylinderShape(body)] if cylinders and not body.skin else []
    return [*out, MetaballShape(body)] if any(isinstance(s, Metaballs) for s in body.surfaces) else out
