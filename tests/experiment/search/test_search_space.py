"""Hydra's sweeps as Optuna's distributions."""

import pytest

pytest.importorskip("optuna")
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.utils import create_config_search_path
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from dopepp.core.errors import UserError
from dopepp.experiment.search import chosen, examples, overrides, read_space


@pytest.fixture(scope="module")
def loader():
    return ConfigLoaderImpl(create_config_search_path(None))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("interval(0, 1)", FloatDistribution(0, 1)),
        ("interval(1e-4, 0.5)", FloatDistribution(1e-4, 0.5)),
        ("tag(log, interval(1e-4, 1))", FloatDistribution(1e-4, 1, log=True)),
        ("int(interval(8, 64))", IntDistribution(8, 64)),
        ("tag(log, int(interval(8, 64)))", IntDistribution(8, 64, log=True)),
        ("range(1, 10, 4)", IntDistribution(1, 9, step=4)),
        ("range(3)", IntDistribution(0, 2)),
        ("range(9, 0, -3)", IntDistribution(3, 9, step=3)),
        ("range(0.0, 0.5, 0.25)", CategoricalDistribution(["0.0", "0.25"])),
        ("choice(a, 3, true)", CategoricalDistribution(["a", "3", "True"])),
        ("a,b", CategoricalDistribution(["a", "b"])),
    ],
)
def test_every_form(text, expected, loader):
    space = read_space(loader, [f"x.y={text}"], [])
    assert space.varied == {"x.y": expected}
    assert space.texts == {"x.y": text}


def test_the_command_line_adds_replaces_and_fixes(loader):
    listed = ["a=interval(0, 1)", "b=choice(1, 2)", "c=interval(0, 1)"]
    space = read_space(loader, listed, ["model=dope", "b=7", "c=interval(0, 9)", "+d=x,y"])
    assert list(space.varied) == ["a", "c", "+d"]
    assert space.varied["c"] == FloatDistribution(0, 9)
    assert space.fixed == ["model=dope", "b=7"]
    assert overrides(space, {"a": 0.123456789, "+d": "x"}) == [
        "model=dope", "b=7", "a=0.1235", "+d=x",
    ]  # fmt: skip


def test_every_choice_is_tried_before_the_search(loader):
    space = read_space(loader, ["a=choice(1, 2)", "b=interval(0, 1)", "c=choice(x, y)"], [])
    assert examples(space) == [
        ["a=1", "b=0", "c=x"], ["a=2", "b=0", "c=x"], ["a=1", "b=0", "c=y"],
    ]  # fmt: skip


@pytest.mark.parametrize("bad", ["a=1", "a=", "a=interval(1,", "a=interval(2, 1)", "a"])
def test_what_is_no_range_is_refused(bad, loader):
    with pytest.raises(UserError, match=r"search\.space with .*allowed: interval\(low, high\)"):
        read_space(loader, [bad], [])


def test_numbers_are_written_as_they_are_run():
    assert chosen({"lr": 1.23456e-4, "n": 123456, "m": "cbam"}) == [
        "lr=0.0001235", "n=123456", "m=cbam",
    ]  # fmt: skip
