"""The pages' words: every language has the same keys, and the same values in each text."""

import string

import pytest

from kinefit.studio.app.pages.shell import LANGUAGES, Texts, preferred_language, words


def placeholders(text):
    return sorted(name for _, name, _, _ in string.Formatter().parse(text) if name is not None)


@pytest.mark.parametrize("language", LANGUAGES[1:])
def test_a_translation_has_all_texts_with_their_values(language):
    original, translated = words(LANGUAGES[0]), words(language)
    assert list(translated) == list(original)
    for key, text in original.items():
        assert placeholders(translated[key]) == placeholders(text), key


def test_the_browser_chooses_the_language():
    assert preferred_language("fr-FR,de-AT;q=0.9,en;q=0.8") == "de"
    assert preferred_language("fr") == preferred_language("") == "en"
    assert Texts("de")("people.choose", number=2) == "Person 2"
