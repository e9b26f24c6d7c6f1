"""Resuming, evaluating and comparing untrusted run folders."""

import pytest

from dopepp.core.yaml import read_yaml
from dopepp.experiment.run.resume import read_overrides
from tests.security.conftest import bounded, refused

pytestmark = pytest.mark.timeout(120)


@pytest.fixture
def told(call, tmp_path, monkeypatch):
    """Run ``train.py`` or ``evaluate.py``, and return its error of one line."""
    monkeypatch.chdir(tmp_path)

    def run(script, *arguments):
        with bounded():
            return call(script, *arguments).line

    return run


@pytest.fixture
def stored(tmp_path):
    """The file of a run's overrides."""
    (tmp_path / ".hydra").mkdir()
    return tmp_path / ".hydra" / "overrides.yaml"


def laughs() -> str:
    lines = ["a0: &a0 [ha, ha]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 12)]
    return "\n".join(lines)


TEXTS = {
    "a Python call": "- !!python/object/apply:os.system ['touch canary']",
    "a Python name": "- !!python/name:os.system",
    "a tag of one's own": "- !evil x",
    "a billion laughs": laughs(),
    "laughs in a list": "- &a [x]\n- [*a, *a]",
    "a merge": "x: &a {b: 1}\ny: {<<: *a}",
    "nested brackets": "[" * 100_000,
    "nested blocks": "\n".join(" " * n + "a:" for n in range(1000)),
    "an endless anchor": "&a [*a]",
    "a mapping": "seed: 1",
    "a number": "1",
    "nothing": "",
    "a list in the list": "- [seed=1]",
    "a whole number": "- 1",
    "a huge whole number": "- " + "9" * 100_000,
    "two documents": "- seed=1\n---\n- seed=2",
    "no YAML": "- 'seed=1\n- {",
    "megabytes": "- seed=1\n" * 300_000,
    "no text": "- \x00",
    "a surrogate": '- "\\ud800"',
}


@pytest.mark.parametrize("name", TEXTS)
def test_overrides_other_than_a_list_of_text(name, stored, tmp_path):
    stored.write_text(TEXTS[name])
    with refused(r"overrides\.yaml"):
        read_overrides(tmp_path)


def test_the_files_that_hydra_writes_are_read(stored, tmp_path):
    overrides = ["model=dopepp", "data.parts=[a, b]", "++virtual.scene.x={a: 1}", "~logger"]
    stored.write_text(
        "- model=dopepp\n- data.parts=[a, b]\n- '++virtual.scene.x={a: 1}'\n- ~logger\n"
    )
    assert read_overrides(tmp_path) == overrides
    stored.write_text("a: {b: [1, 2.5, null, true]}\nc: 'x'\n")
    assert read_yaml(stored) == {"a": {"b": [1, 2.5, None, True]}, "c": "x"}


def test_overrides_that_are_not_a_text_file(stored, good, told, tmp_path):
    (tmp_path / "checkpoints").mkdir()
    good.rename(tmp_path / "checkpoints" / "last.ckpt")
    stored.write_bytes(b"\xff\xfe\x00")
    assert "overrides.yaml" in told("train.py", f"resume={tmp_path}")


STORED = {
    "nothing": None,
    "text": "os.system",
    "an empty mapping": {},
    "a format that is none": {"name": "x", "format": "os.system", "root": "/"},
    "a folder that is none": {"name": "x", "format": "bop", "root": "/proc/self/mem"},
    "numbers for text": {"name": 1, "format": 2, "root": 3},
    "only its name": {"name": "virtual"},
}


@pytest.mark.parametrize("name", STORED)
def test_a_checkpoint_with_invalid_data_settings(name, saved, told, tmp_path):
    """``evaluate.py`` reads the data settings of the checkpoint; wrong settings give one line."""
    data = {"name": "x", "seed": 0, "config": STORED[name]}
    path = saved(lambda content: content["dopepp"].update(data=data))
    told("evaluate.py", f"ckpt_path={path}", f"output_dir={tmp_path / 'o'}")
