import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dopepp.core.errors import UserError
from dopepp.core.json import MAX_DEPTH, parse_json, read_json

SCALARS = st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.text()


PLAIN = st.recursive(
    SCALARS | st.floats(allow_nan=False, allow_infinity=False),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


@given(PLAIN, st.booleans(), st.sampled_from([None, 1]))
def test_parses_like_the_json_module(value, ascii_only, indent):
    text = json.dumps(value, ensure_ascii=ascii_only, indent=indent)
    text = text.encode("utf-8", "surrogatepass").decode("utf-8", "replace")
    assert parse_json(text, "here") == json.loads(text)
    assert parse_json(b"\xef\xbb\xbf" + text.encode(), "here") == json.loads(text)


@pytest.mark.parametrize(("text", "message"), [
    ('{"a":\n [1, NaN]}', "'NaN', not a finite number"),
    ('["NaN Infinity", -Infinity]', "'-Infinity', not"),
    ("[1.0, 1e308, 1e999]", "'1e999', not"),
    ("[" + "9" * 400 + ".5]", "999, not"),
    ("[" + "9" * 250 + "e99]", "999, not"),
    ("[-1E+400]", "'-1E+400', not"),
    ('{"12": 1, "2": {"x": 1, "12": 2, "x": 3}}', "key 'x' twice"),
    ('{"a": 1, "a": 1}', "key 'a' twice"),
    ('{"a": 1', "line 1, column 8"),
    ("", "line 1, column 1"),
    (b'{"a": "\xff"}', "byte 7 is not UTF-8"),
    ("{'a': 1}", "line 1, column 2"),
    ("[" * 200_000, "more than 64 levels"),
    ("[" * (MAX_DEPTH + 1) + "]" * (MAX_DEPTH + 1), "more than 64 levels"),
    ('["]]]]", ' * 70 + "1" + "]" * 70, "more than 64 levels"),
    ("9" * 5000, "digit"),
    ('"' + '\\"' * 300_000, "line 1"),
], ids=lambda value: repr(value)[:20])  # fmt: skip
def test_invalid_json_is_refused(text, message):
    with pytest.raises(UserError) as caught:
        parse_json(text, "some/file.json")
    assert "some/file.json" in str(caught.value)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_brackets_in_strings_do_not_count_as_nesting():
    value = {"a": "[" * 500 + '\\"{{' * 50, "b": ["}"] * 3}
    assert parse_json(json.dumps(value), "here") == value
    deepest = "[" * MAX_DEPTH + "]" * MAX_DEPTH
    assert parse_json(deepest, "here") == json.loads(deepest)


@given(st.binary(max_size=60) | st.text("[]{}\":,\\ntrue1.e-NaInfy 'u", max_size=60))
def test_any_bytes_give_a_value_or_a_user_error(content):
    try:
        value = parse_json(content, "here")
    except UserError:
        return
    assert value == json.loads(content)


def test_read_names_the_file_and_bounds_its_size(tmp_path):
    path = tmp_path / "scene_gt.json"
    with pytest.raises(UserError, match=r"scene_gt\.json, no such file"):
        read_json(path)
    with pytest.raises(UserError, match="no such file"):
        read_json(tmp_path)
    path.write_text('{"0": [1, 2.5]}')
    assert read_json(path) == {"0": [1, 2.5]}
    assert read_json(path, max_bytes=15) == {"0": [1, 2.5]}
    with pytest.raises(UserError, match=r"scene_gt\.json: more than .* MB; .* at most 1.4e-05 MB"):
        read_json(path, max_bytes=14)
