"""Options of an evaluation's protocols: parsed, sorted, and rejected in one line."""

import sys
from dataclasses import replace
from typing import Any

import pytest

from dopepp.core.errors import UserError
from dopepp.experiment.command_line import EVALUATION_SHORT_NAMES
from dopepp.experiment.config.run_config import Protocols
from dopepp.experiment.entries import entry

OPTIONS: dict[str, Any] = {"shading": None, "by": None, "num_bins": 5, "scale_factors": None}
SHARES = r"shading=.*; allowed: shares .* 0 to 1"
FACTORS = r"scale=.*; allowed: factors from 0\.05 to 20"


@pytest.mark.parametrize(
    ("option", "given", "message"),
    [
        ("by", ["distance", "colour"], r"by=\['distance', 'colour'\]; allowed: one or more of "
         r"distance, visibility, size, rotation"),
        *(("by", wrong, "by=.*; allowed") for wrong in ("sice", [], [["size"]])),
        *(("shading", wrong, SHARES)
          for wrong in ([0.2, 80], "20%", [True], [], [0], [float("nan")], {"a": 1})),
        *(("scale_factors", wrong, FACTORS)
          for wrong in (0, [0.5, 0], [-1], [float("nan")], [float("inf")], [21], [1], [], "big",
                        [True], {"a": 2})),
        ("num_bins", 0, "num_bins=0; allowed: an integer from 1"),
    ],
)  # fmt: skip
def test_wrong_options_are_reported_in_one_line(option, given, message):
    with pytest.raises(UserError, match=message) as error:
        Protocols.of({**OPTIONS, option: given})
    assert "\n" not in str(error.value)


def test_levels_are_sorted_and_unique():
    assert not Protocols.of(OPTIONS)
    given = Protocols.of({**OPTIONS, "shading": [0.8, 0, 0.2, 0.2, 1], "by": "size"})
    assert given == Protocols((0.2, 0.8, 1.0), by=("size",), num_bins=5)
    assert given
    assert Protocols.of({**OPTIONS, "shading": 0.4}).shading == (0.4,)
    assert Protocols.of({**OPTIONS, "scale_factors": 2}).scales == (2.0,)


def test_scale_is_a_short_name(composed, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "scale=[0.5,1,2]", "data.num_test=3"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    seen: list[str] = []
    entry(lambda: seen.extend(sys.argv[1:]), ["data"], EVALUATION_SHORT_NAMES)
    assert seen == ["scale_factors=[0.5,1,2]", "++data.num_test=3"]
    config = composed(seen[0], config="evaluate")
    assert Protocols.of(config) == Protocols(scales=(0.5, 2.0))
    assert not replace(Protocols.of(config), scales=())
    assert not Protocols.of(composed())  # a training has no such option
