"""The synthetic take of the command's tests."""

from tests.cli.conftest import change, drawn_take, take

__all__ = ["change", "drawn_take", "take"]
