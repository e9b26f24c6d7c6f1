"""Tests of docs/check_pages.py on all pages, and of the generated reference pages."""

import re
import runpy
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

DOCS = Path(__file__).parents[1] / "docs"
CHECK = runpy.run_path(str(DOCS / "check_pages.py"))


@pytest.mark.parametrize("page", CHECK["user_pages"](), ids=lambda page: page.name)
def test_a_user_page_keeps_the_rules(page):
    assert list(CHECK["problems"](page.read_text(encoding="utf-8"))) == []


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("line\n" * 121, "121 lines"),
        ("word " * 25 + ".", "a sentence of 26 words"),
        ("a" * 161, "a line of 161 characters"),
        ("| a | b | c | d | e | f | g |\n| --- |", "a table of 7 columns"),
        ("| a |\n| --- |\n" + "| b |\n" * 11, "a table of 11 rows"),
    ],
)
def test_a_broken_rule_is_found(text, problem):
    assert any(found.startswith(problem) for found in CHECK["problems"](text))


def test_the_generated_reference_is_up_to_date():
    reference = runpy.run_path(str(DOCS / "make_reference.py"))
    for name, page in (("cli.md", "cli_page"), ("options.md", "options_page")):
        written = (DOCS / "reference" / name).read_text(encoding="utf-8")
        assert written == reference[page](), "run python docs/make_reference.py"


def test_the_reference_lists_only_options_of_each_script():
    page = (DOCS / "reference" / "options.md").read_text(encoding="utf-8")
    conf = DOCS.parent / "conf"
    groups = {path.name for path in conf.iterdir() if path.is_dir()}
    for script, end in (("train", "### "), ("evaluate", "## ")):
        table = page.partition(f"## `{script}.py`\n")[2].partition(f"\n{end}")[0]
        with initialize_config_dir(str(conf), version_base="1.3"):
            typed = {*map(str, compose(script)), *groups}
        listed = set(re.findall(r"^\| `(\w+)`", table, re.MULTILINE))
        assert len(listed) > 15
        assert listed <= typed
