"""Choices that need a package of an extra are refused in one line where it is not installed."""

from __future__ import annotations

from importlib.util import find_spec

from dopepp.errors import UserError


def require(package: str, choice: str, extra: str) -> None:
    """Check that what a choice needs is installed.

    Raises:
        UserError: It is not.
    """
    if find_spec(package) is None:
        raise UserError(
            f"{choice} without the package {package}",
            f"an installation with the extra {extra}",
            f"pip install 'dopepp[{extra}]', or leave {choice} out",
        )
