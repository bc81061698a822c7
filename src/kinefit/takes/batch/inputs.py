"""What a motion was computed from, and whether that was changed since."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from kinefit.errors import KinefitError
from kinefit.readers.take.file import Take, read_take

OUTDATED = "The take was changed after this motion was computed: run kinefit track again"
"""What is said of a result for which `is_outdated` holds."""

_INPUTS = "inputs_sha256"  # key of `Motion.provenance`


def inputs_entry(take: Take) -> dict[str, str]:
    """Entry of `Motion.provenance`: what a motion is computed from that a user edits, wherever it lies.

    That are the take file, its clicks, its body and its T-pose take; changes of the calibration are noticed apart.
    """
    digest = hashlib.sha256(take.digest.encode())
    for file in (take.clicks, take.subject, Path(take.body)):
        if file is not None and file.is_absolute() and file.is_file():
            digest.update(hashlib.sha256(file.read_bytes()).digest())
    return {_INPUTS: digest.hexdigest()}


def is_outdated(provenance: Mapping[str, Any], take: Path) -> bool:
    """Whether a take was changed after a motion was computed from it, as far as the motion's provenance says."""
    if _INPUTS not in provenance or provenance.get("take") != take.name:
        return False
    try:
        return inputs_entry(_read(take, take.stat().st_mtime_ns))[_INPUTS] != provenance[_INPUTS]
    except (KinefitError, OSError):
        return False


@lru_cache(1024)
def _read(take: Path, changed: int) -> Take:
    """The take file of this change [ns]: the window's lists ask for the same ones every two seconds."""
    with warnings.catch_warnings(action="ignore", category=FutureWarning):  # old keys were reported when it was tracked
        return read_take(take)
