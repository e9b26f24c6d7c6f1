"""Names in the package: distinct public classes and modules, few placeholders for nouns."""

import ast
from collections import defaultdict
from pathlib import Path

import dopepp

PACKAGE = Path(dopepp.__file__).parent
SOURCES = {path.relative_to(PACKAGE): path.read_text() for path in sorted(PACKAGE.rglob("*.py"))}
TREES = {path: ast.parse(text) for path, text in SOURCES.items()}
MAX_ONE = 20
MAX_FMT_SKIP = 40


def module_name(path):
    """Return a module's name; a package counts by its folder's name."""
    return path.parent.name if path.stem == "__init__" else path.stem


def collisions(places):
    """Return public names that are defined in several modules."""
    public = {name: paths for name, paths in places.items() if name and name[0] != "_"}
    return {name: paths for name, paths in public.items() if len(paths) > 1}


def test_modules_have_distinct_names():
    modules = defaultdict(list)
    for path in SOURCES:
        modules[module_name(path)].append(str(path))
    assert collisions(modules) == {}


def test_public_classes_have_distinct_names():
    classes = defaultdict(list)
    for path, tree in TREES.items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef):
                classes[node.name].append(str(path))
    assert collisions(classes) == {}


def test_variables_are_rarely_called_one():
    nodes = [(path, node) for path, tree in TREES.items() for node in ast.walk(tree)]
    bound = [
        f"{path}:{node.lineno}"
        for path, node in nodes
        if (isinstance(node, ast.arg) and node.arg == "one")
        or (isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id == "one")
    ]
    assert len(bound) <= MAX_ONE, bound


def test_formatter_is_rarely_overridden():
    skips = {str(path): text.count("# fmt: skip") for path, text in SOURCES.items()}
    assert sum(skips.values()) <= MAX_FMT_SKIP, {path: num for path, num in skips.items() if num}
