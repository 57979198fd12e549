"""One reader for every YAML text: the core schema of YAML 1.2, and nothing that a person would not expect.

PyYAML parses; what plain text means is decided here. ``true`` and ``false`` are the only booleans (``yes``, ``on``
and ``off`` are text), ``010`` is ten, ``1e-4`` is a number, ``12:00:00`` and ``2024-01-01`` are text. A key may
stand once only, tags such as ``!!python/object`` are refused, and depth and size are bounded, so that no text can
exhaust the reader.
"""

from __future__ import annotations

import re
from typing import Any

import yaml

from drakerock.errors import InputError

Key = tuple[str | int, ...]

# No configuration comes near; a reader without bounds ends in a traceback or never.
MAX_DEPTH = 50
MAX_VALUES = 100_000

_TAG = "tag:yaml.org,2002:"
_PLAIN = {
    "null": (r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    "bool": (r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    "int": (r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", list("-+0123456789")),
    "float": (
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
}


class _Loader(yaml.SafeLoader):
    """PyYAML's parser with the core schema's plain scalars and a bounded depth."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 - PyYAML's own form
    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.MarkedYAMLError(problem=f"nested deeper than {MAX_DEPTH} levels", problem_mark=mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


for _name, (_pattern, _first) in _PLAIN.items():
    _Loader.add_implicit_resolver(_TAG + _name, re.compile(rf"(?:{_pattern})\Z"), _first)


class YamlDocument:
    """The data of a YAML text, and where in it each value stands.

    Attributes:
        data: None, booleans, numbers, text, lists and dicts with text as keys.
    """

    def __init__(self, text: str, source: str) -> None:
        """Read a text.

        Args:
            text: YAML; empty text is None.
            source: the name used in messages.

        Raises:
            InputError: not valid YAML, a key that stands twice, a tag, too deep or too large.
        """
        self._source = source
        try:
            self._root = yaml.compose(text, Loader=_Loader)
        except yaml.reader.ReaderError as error:
            line = text.count("\n", 0, error.position) + 1
            raise InputError(
                f"{source}:{line}: not valid YAML: the character U+{error.character:04X} is not allowed"
            ) from None
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            problem = error.problem or error.context
            if problem == "but found another document":
                problem = "found a second document (---), expected one"
            where = f"{source}:{mark.line + 1}" if mark else source
            raise InputError(f"{where}: not valid YAML: {problem}") from None
        self._n_values = 0
        self.data: Any = None if self._root is None else self._read(self._root, 0)

    def _read(self, node: yaml.Node, depth: int) -> Any:
        self._n_values += 1
        if depth > MAX_DEPTH:  # an anchor within itself
            raise self._refuse(node, f"nested deeper than {MAX_DEPTH} levels")
        if self._n_values > MAX_VALUES:  # anchors of anchors
            raise self._refuse(node, f"more than {MAX_VALUES} values")
        if isinstance(node, yaml.MappingNode) and node.tag == _TAG + "map":
            return self._read_mapping(node, depth)
        if isinstance(node, yaml.SequenceNode) and node.tag == _TAG + "seq":
            return [self._read(item, depth + 1) for item in node.value]
        if isinstance(node, yaml.ScalarNode):
            return self._read_scalar(node)
        raise self._refuse(node, f"the tag {node.tag.replace(_TAG, '!!')} is not allowed")

    def _read_mapping(self, node: yaml.MappingNode, depth: int) -> dict[str, Any]:
        lines: dict[str, int] = {}
        data = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise self._refuse(key, "a key must be a single word")
            name = self._read_text(key)
            if name in lines:
                raise self._refuse(
                    key, f"the key '{name}' stands twice, first in line {lines[name]}; remove one"
                )
            lines[name] = key.start_mark.line + 1
            data[name] = self._read(value, depth + 1)
        return data

    def _read_scalar(self, node: yaml.ScalarNode) -> Any:
        text, kind = node.value, node.tag.removeprefix(_TAG)
        if kind == "str":
            return self._read_text(node)
        if kind in _PLAIN and re.fullmatch(_PLAIN[kind][0], text):
            if kind == "null":
                return None
            if kind == "bool":
                return text.lower() == "true"
            if kind == "float":
                return float(re.sub(r"\.(inf|nan)", r"\1", text.lower()))
            if len(text) > 400:
                raise self._refuse(node, "a number of more than 400 digits")
            base = {"0o": 8, "0x": 16}.get(text[:2], 10)
            return int(text, base)
        raise self._refuse(node, f"the tag {node.tag.replace(_TAG, '!!')} is not allowed here")

    def _read_text(self, node: yaml.ScalarNode) -> str:
        text = str(node.value)
        if text.isascii():
            return text
        try:  # JSON escapes a character beyond U+FFFF as two halves
            return text.encode("utf-16-le", "surrogatepass").decode("utf-16-le")
        except UnicodeDecodeError:
            raise self._refuse(node, "half of a surrogate pair is no character") from None

    def _refuse(self, node: yaml.Node, message: str) -> InputError:
        return InputError(f"{self._source}:{node.start_mark.line + 1}: {message}")

    def find_line(self, key: Key) -> int | None:
        """Return the 1-based line of the deepest part of a key that stands in the text; None if nothing does."""
        return self._find(key)[0]

    def find_number_text(self, key: Key) -> str | None:
        """Return a number as it is written there, such as 007; None if that is no number or no such key."""
        _, node = self._find(key)
        if isinstance(node, yaml.ScalarNode) and node.tag in (_TAG + "int", _TAG + "float"):
            return str(node.value)
        return None

    def _find(self, key: Key) -> tuple[int | None, yaml.Node | None]:
        line, node = None, self._root
        for part in key:
            if isinstance(node, yaml.MappingNode):
                match = [(k, v) for k, v in node.value if k.value == str(part)]
                if not match:
                    return line, None
                line, node = match[0][0].start_mark.line + 1, match[0][1]
            elif isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
                node = node.value[part]
                line = node.start_mark.line + 1
            else:
                return line, None
        return line, node
