"""Content security policies of pages that kinefit writes: their own scripts and styles run, and nothing else."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable

APP_PAGES = "http://localhost:* http://127.0.0.1:*"
"""Pages of `kinefit app`, whose port is not known, as the policies `frame-src` and `frame-ancestors` have them."""


def inline_policy(scripts: Iterable[str], styles: Iterable[str], more: str = "") -> str:
    """A policy under which a page runs exactly these inline scripts and styles, by their hashes, and fetches nothing.

    Parameters
    ----------
    scripts, styles : texts of the elements, to the letter
    more : further directives, such as "img-src data:"
    """
    hashes = [" ".join(_hash(text) for text in texts) or "'none'" for texts in (scripts, styles)]
    rules = ["default-src 'none'", f"script-src {hashes[0]}", f"style-src {hashes[1]}"]
    return "; ".join([*rules, *([more] if more else []), "base-uri 'none'", "form-action 'none'"])


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
