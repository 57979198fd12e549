"""Contract: plain text means what the core schema of YAML 1.2 says, JSON is read as JSON, and whatever else a text
holds is one message with file and line. Caught: yes and no as booleans, 010 as eight, 12:00:00 as a number of seconds,
a key that stood twice, a traceback from a deep file.
"""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drakerock.errors import InputError
from drakerock.yaml_reader import MAX_DEPTH, MAX_VALUES, YamlDocument


def read(text):
    return YamlDocument(text, "file.yaml").data


json_data = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


@given(json_data)
def test_json_is_read_as_json(data):
    text = json.dumps(data)
    assert read(text) == json.loads(text)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("true", True), ("False", False), ("TRUE", True), ("null", None), ("~", None), ("", None),
        ("yes", "yes"), ("no", "no"), ("on", "on"), ("Off", "Off"), ("y", "y"),
        ("010", 10), ("-007", -7), ("0o17", 15), ("0x1F", 31), ("1_000", "1_000"), ("0b11", "0b11"),
        ("12:00:00", "12:00:00"), ("2024-01-01", "2024-01-01"), ("1e-4", 1e-4), ("1.", 1.0), (".5", 0.5),
        ("+3", 3), ("1e3", 1000.0), (".inf", math.inf), ("-.INF", -math.inf), ("=", "="), ("'010'", "010"),
        ("<<", "<<"), ("a: &x [1]\nb: *x", {"a": [1], "b": [1]}), ("1: a\nyes: b", {"1": "a", "yes": "b"}),
        ("!!str 010", "010"),
    ],
)  # fmt: skip
def test_the_core_schema(text, value):
    found = read(text)
    assert found == value
    assert type(found) is type(value)
    assert math.isnan(read(".nan"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: 2\na: 3", "file.yaml:3: the key 'a' stands twice, first in line 1; remove one"),
        ("a:\n  b: 1\n  c: 2\n  b: 3", "file.yaml:4: the key 'b' stands twice, first in line 2; remove one"),
        ("[" * 200, f"file.yaml:1: not valid YAML: nested deeper than {MAX_DEPTH} levels"),
        ("\n" + "- " * 200 + "1", f"file.yaml:2: not valid YAML: nested deeper than {MAX_DEPTH} levels"),
        ("a: &x [*x]", f"file.yaml:1: nested deeper than {MAX_DEPTH} levels"),
        (
            "a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
            + "\n".join(f"a{i}: &a{i} [{', '.join(10 * [f'*a{i - 1}'])}]" for i in range(1, 7)),
            f"file.yaml:1: more than {MAX_VALUES} values",
        ),
        ("a: !!python/name:os.system", "file.yaml:1: the tag !!python/name:os.system is not allowed here"),
        ("a: !!int x", "file.yaml:1: the tag !!int is not allowed here"),
        ("a: !mine {b: 1}", "file.yaml:1: the tag !mine is not allowed"),
        ("a: 1\n? [1, 2]\n: 3", "file.yaml:2: a key must be a single word"),
        ("a: 1\n---\nb: 2", "file.yaml:2: not valid YAML: found a second document (---), expected one"),
        ("a: 1\nb: \x07", "file.yaml:2: not valid YAML: the character U+0007 is not allowed"),
        ("a: *x", "file.yaml:1: not valid YAML: found undefined alias 'x'"),
        ("a: " + 500 * "9", "file.yaml:1: a number of more than 400 digits"),
        ('a: "\\ud800"', "file.yaml:1: half of a surrogate pair is no character"),
    ],
)
def test_what_is_refused_is_one_message(text, message):
    with pytest.raises(InputError) as caught:
        read(text)
    assert str(caught.value) == message


@given(st.text(alphabet="a0:-[]{}&*!|>%@`'\"#?, \n\t\\=<~.\ud800\x00", max_size=40))
def test_any_text_is_data_or_one_message(text):
    message = ""
    try:
        read(text)
    except InputError as error:
        message = str(error)
    assert not message or (message.startswith("file.yaml") and "\n" not in message)


def test_lines_and_texts_of_keys():
    document = YamlDocument("a:\n  - b: 007\n  - c: x\nd: '1'\n", "file.yaml")
    assert document.find_line(("a", 0, "b")) == 2
    assert document.find_line(("a", 1, "nothing")) == 3
    assert document.find_line(("nothing",)) is None
    assert document.find_number_text(("a", 0, "b")) == "007"
    assert document.find_number_text(("a", 1, "c")) is None
    assert document.find_number_text(("d",)) is None
