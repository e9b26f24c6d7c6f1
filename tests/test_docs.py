"""Links, commands, options and config keys in the documentation exist."""

import re
import shlex
from dataclasses import fields, is_dataclass
from itertools import pairwise
from pathlib import Path

import pytest
import typer.main
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import OverrideParseException

from dopepp.cli import app
from dopepp.experiment.command_line import EVALUATION_SHORT_NAMES, SHORT_NAMES
from dopepp.virtual.presets import PRESETS

ROOT = Path(__file__).parents[1]
CONF = ROOT / "conf"
DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])

FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
SPAN = re.compile(r"`([^`\n]+)`")
LINK = re.compile(r"\]\(([^)\s]+)\)")
OTHER_TOOLS = {"--cfg"}
"""Hydra's options that documents name without a command."""

USAGE_ERROR = typer.BadParameter.__mro__[1]
"""The usage error of the click version that Typer uses."""
APP = typer.main.get_command(app)
APP_OPTIONS = {text for parameter in APP.params for text in parameter.opts}
COMMANDS = APP.commands
OPTIONS = {
    name: {
        text
        for subcommand in (command, *getattr(command, "commands", {}).values())
        for parameter in subcommand.params
        for text in parameter.opts
    }
    | {"--help"}
    for name, command in COMMANDS.items()
}


ENTRIES = {
    ("python", "train.py"): SHORT_NAMES,
    ("dopepp", "train"): SHORT_NAMES,
    ("python", "evaluate.py"): EVALUATION_SHORT_NAMES,
    ("dopepp", "evaluate"): EVALUATION_SHORT_NAMES,
}
"""Programs that accept Hydra's overrides, with their short option names."""


def fenced(text, language):
    return [content for name, content in FENCE.findall(text) if name == language]


def typed_commands(text):
    """Yield the words of every shell command in a document's fenced blocks."""
    for content in fenced(text, "bash"):
        yield from words_of(content.replace("\\\n", " ").splitlines())


def commands(text):
    """Yield the words of every shell command in a document's fenced blocks and code spans."""
    yield from typed_commands(text)
    yield from words_of(SPAN.findall(FENCE.sub("", text)))


def words_of(lines):
    for line in lines:
        for command in line.split("&&"):
            try:
                words = shlex.split(command, comments=True)
            except ValueError:  # an apostrophe in a span that is not a command
                continue
            if words:
                yield words


def slug(heading):
    return re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")


def config_keys():
    """Return every key of every file in conf/, from the root of the composed configuration."""
    keys = set()
    for path in CONF.rglob("*.yaml"):
        text = path.read_text()
        folders = path.parent.relative_to(CONF).parts
        in_root = not folders or "@package _global_" in text
        collect(yaml.safe_load(text), "" if in_root else ".".join(folders), keys)
    return keys


def collect(node, start, keys):
    keys.add(start)
    if isinstance(node, dict):
        for key, value in node.items():
            collect(value, f"{start}.{key}".lstrip("."), keys)


def is_preset_field(path):
    """Return whether any preset has a field, given by its path."""

    def has(value, names):
        if not names:
            return True
        existing = {entry.name for entry in fields(value)} if is_dataclass(value) else ()
        return names[0] in existing and has(getattr(value, names[0]), names[1:])

    return any(has(preset, path) for preset in PRESETS.values())


KEYS = config_keys()


def option_problem(override):
    """Return the problem of an override ``key=value`` or ``group=file``, or None."""
    key, _, value = override.partition("=")
    key = key.lstrip("+")
    if key.startswith("virtual.scene."):
        return None if is_preset_field(key.split(".")[2:]) else f"no preset has {key}"
    if not (CONF / key).is_dir():
        return None if key in KEYS or key.startswith("hydra.") else f"no option {key}"
    files = [f"conf/{key}/{name}.yaml" for name in value.split(",") if name != "…"]
    return next((f"no {file}" for file in files if not (ROOT / file).is_file()), None)


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_linked_files_and_headings_exist(path):
    bad = []
    for target in LINK.findall(FENCE.sub("", path.read_text())):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        file = (path.parent / name) if name else path
        headings = re.findall(r"^#+ (.+)$", file.read_text(), re.MULTILINE) if anchor else []
        if not file.exists() or (anchor and anchor not in map(slug, headings)):
            bad.append(target)
    assert not bad


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_console_commands_and_their_options_exist(path):
    bad = []
    for words in commands(path.read_text()):
        if words[0] == "dopepp" and tuple(words[:2]) not in ENTRIES and len(words) > 1:
            if words[1] in APP_OPTIONS:
                continue
            if words[1] not in COMMANDS:
                bad.append(" ".join(words))
                continue
            named = [word.partition("=")[0] for word in words[2:] if re.match(r"--?[a-zA-Z]", word)]
            bad += [f"{words[1]} {option}" for option in named if option not in OPTIONS[words[1]]]
            bad += preset_problems(words)
        elif words[0].startswith("--") and words[0] not in OTHER_TOOLS.union(*OPTIONS.values()):
            bad.append(words[0])
    assert not bad


def preset_problems(words):
    """Return the ``--set`` and ``--preset`` of a command that name no field or preset."""
    pairs = list(pairwise(words))
    changes = [value.partition("=")[0] for option, value in pairs if option == "--set"]
    bad = [change for change in changes if not is_preset_field(change.split("."))]
    return bad + [value for option, value in pairs if option == "--preset" and value not in PRESETS]


GUIDES = [path for path in DOCUMENTS if path.name not in {"CHANGELOG.md", "options.md"}]
"""The changelog also names removed options, and options.md is generated from the code."""


@pytest.mark.parametrize("path", GUIDES, ids=lambda path: path.name)
def test_options_of_training_and_evaluation_exist(path):
    groups = {key.split(".")[0] for key in KEYS if "." in key}
    text, bad = path.read_text(), []
    for words in commands(text):
        entry = tuple(words[:2]) in ENTRIES
        # A span without a command: data/test=photoreal, virtual.backgrounds=DIR, data.cache_dir.
        alone = re.match(r"(\w+)(/\w+)*=|(\w+)\.[\w.]+(=|$)", words[0])
        if entry:
            overrides = [word for word in words[2:] if "=" in word and not word.startswith("-")]
        elif alone and (alone[1] or alone[3]) in groups:
            overrides = [word for word in words if re.match(r"[\w./]+(=|$)", word)]
        else:
            continue
        short = ENTRIES.get(tuple(words[:2]), SHORT_NAMES)
        overrides = [re.sub(r"^\w+", lambda key, short=short: short.get(key[0], key[0]), override)
                     for override in overrides]  # fmt: skip
        problems = [problem for override in overrides if (problem := option_problem(override))]
        # The reader of a guide may be asked to write the file.
        bad += [problem for problem in problems if f"`{problem.removeprefix('no ')}`" not in text]
    assert not bad


@pytest.mark.parametrize("path", GUIDES, ids=lambda path: path.name)
def test_fenced_commands_are_accepted_by_their_parsers(path):
    results = {" ".join(words): parse_problem(words) for words in typed_commands(path.read_text())}
    assert not {command: problem for command, problem in results.items() if problem}


def parse_problem(words):
    """Parse a command without running it; return the parser's error message, or None."""
    program, arguments = tuple(words[:2]), words[2:]
    try:
        if program in ENTRIES:
            plain = [re.sub("…|<.*?>", "x", word) for word in arguments]
            overrides = [word for word in plain if "=" in word and not word.startswith("-")]
            OverridesParser.create().parse_overrides(overrides)
        elif words[0] == "dopepp" and program[1] in COMMANDS:
            command = COMMANDS[program[1]]
            if arguments and arguments[0] in getattr(command, "commands", {}):
                name, *arguments = arguments
                command = command.commands[name]
            command.make_context(program[1], arguments)
    except (OverrideParseException, USAGE_ERROR) as error:
        return str(error)
    return None


@pytest.mark.parametrize("path", GUIDES, ids=lambda path: path.name)
def test_python_of_the_pages_compiles(path):
    for number, code in enumerate(fenced(path.read_text(), "python")):
        lines = f"{{{code}}}" if re.match(r'"\w', code) else code  # lines to put into a dictionary
        compile(lines, f"{path.name}, block {number}", "exec")


def test_the_checks_detect_missing_options():
    """Guard against checks that pass because they find no commands."""
    assert option_problem("data=cbp") == "no conf/data/cbp.yaml"
    assert option_problem("data.preset=paper") == "no option data.preset"
    assert option_problem("virtual.scene.lighting.lamps=3") is not None
    assert option_problem("virtual.scene.table.tilt_deg=[0,5]") is None
    assert parse_problem(["dopepp", "train", "model=[a"]) is not None
    assert parse_problem(["dopepp", "predict", "a.ckpt", "a.png", "--K", "1", "2", "x", "4"])
    assert parse_problem(["dopepp", "predict"]) is not None
    starts = [words[:2] for words in commands((ROOT / "README.md").read_text())]
    assert ["dopepp", "render"] in starts
    assert ["python", "train.py"] in starts
    assert "--unit" in OPTIONS["render"]
