"""Read what a client asks of a session: flat JSON objects of bounded size, each with one wish."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any

import msgspec

from kinefit.errors import ObservationError

Answer = Callable[[Mapping[str, Any]], None]
"""Takes the answer to a wish, from any thread."""

MAX_WISH_BYTES = 4096
"""Of a wish as JSON: those that a session fulfils have less than 300."""

_Name = Annotated[str, msgspec.Meta(max_length=200)]
_FORM = 'Ask for {"sensor": ..., "use": true or false}, {"sensor": ..., "sigma": ...}, {"body": ...} or {"stop": true}.'


class Wish(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """One wish; the fields of others are None.

    Parameters
    ----------
    sensor : name of the sensor that `use` or `sigma` is of
    use : whether the sensor takes part
    sigma : standard deviation of the sensor, [px] or [m]
    body : name of a body of the catalogue
    stop : True to end the session
    """

    sensor: _Name | None = None
    use: bool | None = None
    sigma: float | None = None
    body: _Name | None = None
    stop: bool | None = None


def read_wish(given: bytes | Mapping[str, Any]) -> Wish:
    """The wish of a JSON text or of a mapping.

    The record has no nested part, so that no depth of brackets is ever followed.

    Raises
    ------
    ObservationError
        Too long, no JSON, not of the form of a wish, or of two wishes at once.
    """
    try:
        if isinstance(given, Mapping):
            wish = msgspec.convert(dict(given), Wish)
        elif len(given) > MAX_WISH_BYTES:
            raise ObservationError(f"a wish of {len(given)} bytes, more than {MAX_WISH_BYTES}", remedy=_FORM)
        else:
            wish = msgspec.json.decode(given, type=Wish)
    except msgspec.DecodeError as error:
        raise ObservationError(f"no wish: {error}", remedy=_FORM) from error
    asked = {name for name in wish.__struct_fields__ if getattr(wish, name) is not None}
    if asked not in ({"sensor", "use"}, {"sensor", "sigma"}, {"body"}, {"stop"}) or wish.stop is False:
        raise ObservationError(f"a message with {', '.join(sorted(asked)) or 'nothing'} is no wish", remedy=_FORM)
    return wish
