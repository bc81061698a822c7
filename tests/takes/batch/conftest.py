"""The synthetic take of the command's tests."""

from tests.cli.conftest import change, take

__all__ = ["change", "take"]
