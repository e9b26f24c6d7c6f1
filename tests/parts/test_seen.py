import math

import pytest

from dopepp.core.errors import UserError
from dopepp.parts.seen import Seen, widest


def test_a_record_comes_back():
    seen = Seen(20.0, 90.5, 0.3, 0.8)
    assert Seen.parse(list(seen)) == seen


@pytest.mark.parametrize(
    "record",
    [None, 4, [1, 2, 3], [9.0, 2.0, 0.1, 0.2], [1, 2, 0.2, 0.1], [1, 2, 0, 1], [1, "2", 0.1, 0.2],
     [1, math.nan, 0.1, 0.2], [1, 2, 0.1, math.inf], [True, 2, 0.1, 0.2]],
)  # fmt: skip
def test_what_cannot_be_is_refused(record):
    with pytest.raises(UserError):
        Seen.parse(record)


def test_the_widest_range_holds_all():
    assert widest([Seen(30, 40, 0.2, 0.3), Seen(10, 35, 0.25, 0.9)]) == Seen(10, 40, 0.2, 0.9)
