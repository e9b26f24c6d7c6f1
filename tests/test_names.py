"""Public classes and modules of the package have distinct names."""

import re
from collections import defaultdict
from pathlib import Path

import dopepp

PACKAGE = Path(dopepp.__file__).parent


def collisions(places):
    """Return public names that are defined in several modules."""
    public = {name: paths for name, paths in places.items() if name and name[0] != "_"}
    return {name: paths for name, paths in public.items() if len(paths) > 1}


def test_modules_and_classes_have_distinct_names():
    modules, classes = defaultdict(list), defaultdict(list)
    for path in sorted(PACKAGE.rglob("*.py")):
        # A package counts by its folder's name.
        modules[path.parent.name if path.stem == "__init__" else path.stem].append(str(path))
        for name in re.findall(r"^class (\w+)", path.read_text(), re.MULTILINE):
            classes[name].append(str(path))
    assert len(classes) > 100
    assert collisions(modules) == collisions(classes) == {}
