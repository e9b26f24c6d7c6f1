"""The two ends of a run that are told in one line: a user's mistake, and a run that failed.

Choices that need a package of an extra are refused in one line where it is not installed.
"""

from __future__ import annotations

from importlib.machinery import ModuleSpec
from importlib.util import find_spec


class UserError(ValueError):
    """A mistake in an input, a file or an option that its user can correct.

    It states the value with its file and field, the allowed values, and the fix. Entry points print
    it as one line and exit with code 2.
    """

    def __init__(self, got: str, allowed: str, fix: str) -> None:
        self.got, self.allowed, self.fix = got, allowed, fix
        super().__init__(" ".join(f"got {got}; allowed: {allowed}; fix: {fix}".split()))

    def __reduce__(self) -> tuple[type[UserError], tuple[str, str, str]]:
        """Survive the pickling between a loader's worker and its parent."""
        return type(self), (self.got, self.allowed, self.fix)


class RunError(RuntimeError):
    """A run that cannot go on, through no mistake that could have been told at its start.

    Entry points print it as one line and exit with code 1.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(" ".join(reason.split()))


def require(package: str, choice: str, extra: str) -> ModuleSpec:
    """Look up the package that a choice needs; a :class:`UserError` where it is not installed."""
    spec = find_spec(package)
    if spec is None:
        raise UserError(
            f"{choice} without the package {package}",
            f"an installation with the extra {extra}",
            f"pip install 'dopepp[{extra}]', or leave {choice} out",
        )
    return spec
