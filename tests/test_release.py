"""What a release says of itself agrees with itself."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import kinefit

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PINNED = dict(
    line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")
)
VERSIONS = {canonicalize_name(name): version for name, version in PINNED.items()}


def test_all_places_tell_one_version():
    assert kinefit.__version__ == PROJECT["version"]
    released = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - \d{4}-\d\d-\d\d$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert released[0] == PROJECT["version"]
    assert f"\nversion: {PROJECT['version']}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"tests of version {PROJECT['version']} " in (ROOT / "constraints.txt").read_text()


@pytest.mark.parametrize("extra", ["", "test", "docs", "parquet", "rerun"])
def test_pinned_versions_are_those_that_the_project_allows(extra):
    wanted = PROJECT["optional-dependencies"][extra] if extra else PROJECT["dependencies"]
    for one in map(Requirement, wanted):
        assert VERSIONS[canonicalize_name(one.name)] in one.specifier
