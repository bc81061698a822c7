"""The page on conformal geometric algebra says what happens: all of its examples are run."""

import doctest
import re

from tests.docs.blocks import PAGES, part_text

PAGE = PAGES["printed-cga"]


def test_every_example_of_the_page():
    blocks = re.findall(r"```python\n(.*?)```", part_text("printed-cga"), re.S)
    test = doctest.DocTestParser().get_doctest("".join(blocks), {}, PAGE.name, str(PAGE), 0)
    assert len(test.examples) > 40
    told: list[str] = []
    result = doctest.DocTestRunner(verbose=False).run(test, out=told.append)
    assert result.failed == 0, "".join(told)
