"""Read the requests ("wishes") of a client to a session: flat JSON objects of limited size, one request each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any

import msgspec

from kinefit.errors import ObservationError

Answer = Callable[[Mapping[str, Any]], None]
"""Callback for the answer to a wish, called from any thread."""

MAX_WISH_BYTES = 4096
"""Largest size of a wish as JSON; valid ones have less than 300 bytes."""

_Name = Annotated[str, msgspec.Meta(max_length=200)]
_FORM = (
    'Send {"sensor": ..., "use": true or false}, {"sensor": ..., "sigma": ...}, {"body": ...}, {"person": ...}, '
    '{"pause": true or false} or {"stop": true}.'
)
_SINGLE_FIELDS = "body", "person", "pause", "stop"


class Wish(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """One request; the fields of other requests are None.

    Parameters
    ----------
    sensor : name of the sensor of `use` or `sigma`
    use : whether the session uses the sensor
    sigma : standard deviation of the sensor, [px] or [m]
    body : name of a body in the catalogue
    person : number of the person to track from now on, counted as in `LivePerson.people`, from 1
    pause : whether the session ignores what its sensors see
    stop : True to end the session
    """

    sensor: _Name | None = None
    use: bool | None = None
    sigma: float | None = None
    body: _Name | None = None
    person: int | None = None
    pause: bool | None = None
    stop: bool | None = None


def read_wish(given: bytes | Mapping[str, Any]) -> Wish:
    """Parse a wish from a JSON text or a mapping.

    The record has no nested fields, so deep nesting in the input has no effect.

    Raises
    ------
    ObservationError
        Too long, no JSON, no valid wish, or two wishes at once.
    """
    try:
        if isinstance(given, Mapping):
            wish = msgspec.convert(dict(given), Wish)
        elif len(given) > MAX_WISH_BYTES:
            raise ObservationError(f"the request has {len(given)} bytes, more than {MAX_WISH_BYTES}", remedy=_FORM)
        else:
            wish = msgspec.json.decode(given, type=Wish)
    except msgspec.DecodeError as error:
        raise ObservationError(f"not a request: {error}", remedy=_FORM) from error
    asked = {name for name in wish.__struct_fields__ if getattr(wish, name) is not None}
    if asked not in ({"sensor", "use"}, {"sensor", "sigma"}, *({one} for one in _SINGLE_FIELDS)) or wish.stop is False:
        raise ObservationError(f"a message with {', '.join(sorted(asked)) or 'nothing'} is not a request", remedy=_FORM)
    return wish
