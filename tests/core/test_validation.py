"""Plain values are converted to typed objects; a mistake gives one line with its name."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest

from dopepp.core.errors import UserError
from dopepp.core.validation import STRICT, Checked, Range, Span, check, parse


@dataclass(frozen=True, kw_only=True)
class Inner:
    __pydantic_config__ = STRICT
    share: Annotated[float, Range(0, 1, "part")] = 0.5
    count: Annotated[int, Range(1, 9)] = 1


@dataclass(frozen=True, kw_only=True)
class Outer:
    __pydantic_config__ = STRICT
    number: int
    path: Path | None = None
    inner: Inner = field(default_factory=Inner)
    either: float | tuple[float, ...] = 1.0
    node: Mapping[str, Any] = field(default_factory=dict)
    choice: Literal["a", "b"] = "a"
    many: tuple[Inner, ...] = ()


def test_plain_values_are_converted():
    given = {"number": 1, "path": "x/y", "inner": {"share": 1}, "either": [1, 2.5], "many": [{}]}
    outer = parse(Outer, given)
    assert outer == Outer(
        number=1, path=Path("x/y"), inner=Inner(share=1.0), either=(1.0, 2.5), many=(Inner(),)
    )


SHARE = "a number from 0 to 1 (part)"


@pytest.mark.parametrize(
    ("given", "got", "allowed"),
    [
        ({}, "no root.number", "root.number=…"),
        ({"number": "1"}, "root.number='1'", "an integer"),
        ({"number": True}, "root.number=True", "an integer"),
        ({"number": 1, "inner": {"share": 2}}, "root.inner.share=2", SHARE),
        ({"number": 1, "inner": {"share": math.nan}}, "root.inner.share=nan", SHARE),
        ({"number": 1, "inner": {"count": 10}}, "root.inner.count=10", "an integer from 1 to 9"),
        ({"number": 1, "inner": {"shar": 1}}, "root.inner.shar=1", "share, count"),
        ({"number": 1, "many": [{}, {"no": 1}]}, "root.many[1].no=1", "share, count"),
        ({"number": 1, "either": "x"}, "root.either='x'", "a finite number or a list"),
        ({"number": 1, "choice": "c"}, "root.choice='c'", "a, b"),
        ({"number": 1, "node": 3}, "root.node=3", "a mapping"),
        ({"number": 1, "path": 3}, "root.path=3", "text"),
        (3, "root=3", "a mapping"),
    ],
)
def test_a_mistake_names_field_value_and_choices(given, got, allowed):
    with pytest.raises(UserError) as caught:
        parse(Outer, given, "root")
    assert (caught.value.got, caught.value.allowed) == (got, allowed)


@pytest.mark.parametrize("value", [{1, 2}, 10**5000, float], ids=["set", "endless", "class"])
def test_values_that_json_cannot_represent_are_refused(value):
    with pytest.raises(UserError):
        parse(Outer, {"number": value}, "root")


PAIR = tuple[float, float]


@pytest.mark.parametrize(
    ("value", "kind", "limits", "typed"),
    [
        (True, bool, None, True),
        (9, int, Range(1, 9), 9),
        (1, float, Range(0, 1), 1.0),
        ([1, 9], tuple[int, int], Range(1, 9), (1, 9)),
        ((0, 0.5), PAIR, Span(0, 1), (0.0, 0.5)),
    ],
)
def test_an_argument_is_converted(value, kind, limits, typed):
    checked = check("name", value, kind, limits)
    assert (checked, type(checked)) == (typed, type(typed))


@pytest.mark.parametrize(
    ("value", "kind", "limits", "message"),
    [
        (1, bool, None, "got name=1; allowed: true or false; fix: set name to an allowed value"),
        (True, int, Range(1, 9), "got name=True; allowed: an integer from 1 to 9;"),
        (1.0, int, Range(1, 10**6), "got name=1.0; allowed: an integer from 1 to 1000000;"),
        ("1", float, Range(0, 1, "share"), "got name='1'; allowed: a number from 0 to 1 (share);"),
        (math.inf, float, Range(0, 1), "got name=inf; allowed: a number from 0 to 1;"),
        (math.nan, float, Range(0, 1), "got name=nan; allowed: a number from 0 to 1;"),
        (True, float, Range(0, 1), "got name=True; allowed: a number from 0 to 1;"),
        ([1], tuple[int, int], Range(1, 9), "allowed: a list of 2 integers from 1 to 9;"),
        ([0, 1], tuple[int, int], Range(1, 9), "got name=[0, 1]; allowed: a list of 2 integers"),
        ((1, 0), PAIR, Span(0, 1, "m"), "with 0 <= smallest <= largest <= 1 (m);"),
        ((0, math.nan), PAIR, Span(0, 1), "got name=(0, nan);"),
        (3, PAIR, Span(0, 1), "got name=3; allowed: (smallest, largest) with 0 <="),
        pytest.param(10**5000, int, Range(1, 9), "got name", id="endless"),
        (object(), int, Range(1, 9), "got name"),
    ],
)
def test_an_argument_of_another_kind_is_refused(value, kind, limits, message):
    with pytest.raises(UserError) as caught:
        check("name", value, kind, limits)
    assert message in str(caught.value)


def test_a_dataclass_checks_its_own_fields():
    @dataclass(frozen=True)
    class Own(Checked):
        share: Annotated[float, Range(0, 1)] = 0.5

    Own()
    with pytest.raises(UserError, match="got share=2 of Own; allowed: a number from 0 to 1;"):
        Own(share=2)
