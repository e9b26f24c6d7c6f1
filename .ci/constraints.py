"""Print the installed version of every package that ``pip install -e ".[dev]"`` brings.

``python .ci/constraints.py > constraints.txt`` after a green test suite renews the file.
"""

from importlib.metadata import PackageNotFoundError, distribution

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


def installed(requirement: Requirement, versions: dict[str, str], seen: set[str]) -> None:
    """Add the versions of a requirement and of everything that it needs."""
    for extra in ("", *requirement.extras):
        key = f"{canonicalize_name(requirement.name)}[{extra}]"
        if key in seen:
            continue
        seen.add(key)
        try:
            package = distribution(requirement.name)
        except PackageNotFoundError:  # of another platform
            return
        # A local version such as 2.13.0+cpu exists on one index only.
        versions[canonicalize_name(requirement.name)] = package.version.partition("+")[0]
        for text in package.requires or ():
            needed = Requirement(text)
            if needed.marker is None or needed.marker.evaluate({"extra": extra}):
                installed(needed, versions, seen)


if __name__ == "__main__":
    found: dict[str, str] = {}
    installed(Requirement("dopepp[dev]"), found, set())
    del found["dopepp"]
    print("# Versions that the test suite passed with: pip install -c constraints.txt -e '.[dev]'")
    print("\n".join(f"{name}=={version}" for name, version in sorted(found.items())))
