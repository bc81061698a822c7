"""All words of the app's pages, in the languages that it speaks: `texts_en.toml` and its translations."""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path

LANGUAGES = ("en", "de")
"""Languages of the pages; the first is taken for a browser that asks for none of them."""


@cache
def words(language: str) -> dict[str, str]:
    """{"table.key": text} of a language."""
    tables = tomllib.loads(Path(__file__).with_name(f"texts_{language}.toml").read_text("utf-8"))
    return {f"{table}.{key}": text for table, texts in tables.items() for key, text in texts.items()}


class Texts:
    """The words of one language, called with a key and the values that stand in the text."""

    def __init__(self, language: str) -> None:
        self.language = language
        self._words = words(language)

    def __call__(self, key: str, **values: object) -> str:
        """A text, with its values put in."""
        return self._words[key].format(**values)

    def get(self, key: str) -> str | None:
        """A text without values; None if there is none of this key."""
        return self._words.get(key)


def preferred_language(accepted: str) -> str:
    """The first of LANGUAGES that a browser's header `Accept-Language` asks for, such as "de-AT,de;q=0.9,en;q=0.8"."""
    for part in accepted.split(","):
        language = part.split(";")[0].strip().lower().partition("-")[0]
        if language in LANGUAGES:
            return language
    return LANGUAGES[0]
