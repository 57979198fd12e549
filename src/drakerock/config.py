"""Schemas: every room declares its part of the configuration as a `Config`, a scenario or a study is made of those.

A configuration is read from YAML, with errors that name file, line, key and what is allowed. It is frozen, and every
way to change one checks it: an override on top of the file, or `Config.replace`.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, ClassVar, Self, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError, ValidationInfo, field_validator

from drakerock.errors import InputError
from drakerock.files import read_text
from drakerock.resources import find_study_file
from drakerock.yaml_reader import Key, YamlDocument


class Config(BaseModel):
    """Base of all schemas: unknown keys are errors, values are checked, instances are frozen.

    Numbers are no booleans, and booleans nothing but true and false.

    Attributes:
        file_fields: fields that name data files; a file's content, not its name, is what results depend on.
    """

    file_fields: ClassVar[tuple[str, ...]] = ()

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _tell_booleans_apart(cls, value: Any, info: ValidationInfo) -> Any:
        kinds = list_types(cls.model_fields[info.field_name or ""].annotation, with_items=True)
        if bool in kinds and str not in kinds and not isinstance(value, bool | None):
            raise ValueError("must be true or false")
        if bool not in kinds and kinds & {int, float} and _holds_boolean(value):
            raise ValueError("must be a number, not true or false")
        return value

    def replace(self, **changes: Any) -> Self:
        """Return this configuration with some keys changed, checked like one that is read from a file.

        Args:
            changes: values by key, ``config.replace(seed=3)``; keys may be dotted,
                ``scenario.replace(**{"loading.strategy.alpha": 1.3})``.

        Raises:
            InputError: an unknown key, or a value that is not allowed.
        """
        data = {name: getattr(self, name) for name in self.model_fields_set}
        nested: dict[str, dict[str, Any]] = {}
        for key, value in changes.items():
            name, _, rest = key.partition(".")
            if rest:
                nested.setdefault(name, {})[rest] = value
            else:
                data[name] = value
        for name, values in nested.items():
            part = data.get(name, getattr(self, name, None))
            if not isinstance(part, Config):
                raise InputError(
                    f"{type(self).__name__}: unknown key '{name}.{next(iter(values))}': "
                    f"{f'there is nothing below {name}' if hasattr(self, name) else 'there is no ' + name}"
                )
            data[name] = part.replace(**values)
        return validate(type(self), data, type(self).__name__)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """As in pydantic, but changes are checked: `replace`."""
        return self.replace(**update) if update else super().model_copy(deep=deep)


def load_config[ConfigT: Config](
    path: str | Path,
    schema: type[ConfigT],
    overrides: Sequence[str] = (),
    complete: Callable[[dict[str, Any]], None] | None = None,
) -> ConfigT:
    """Read a YAML file into `schema`. A file that it names is looked for beside it first, then from where one works.

    Args:
        path: the YAML file; an empty file means all defaults. ``studies/...``, if not there, is the shipped one.
        overrides: ``"dotted.key=value"`` strings, the value in YAML, applied on top of the file.
        complete: may alter the data before they are checked, such as by what another file holds.

    Raises:
        InputError: unreadable file, YAML syntax, unknown key, value out of range.
    """
    path = find_study_file(Path(path))
    text = read_text(path)
    return parse_config(text, schema, overrides, source=str(path), complete=complete, folder=path.parent)


def parse_config[ConfigT: Config](
    text: str,
    schema: type[ConfigT],
    overrides: Sequence[str] = (),
    source: str = "<text>",
    complete: Callable[[dict[str, Any]], None] | None = None,
    folder: Path | None = None,
) -> ConfigT:
    """Parse YAML text into `schema`; `source` is the name used in messages, `folder` where files are looked for first.

    Otherwise as `load_config`.
    """
    document = YamlDocument(text, source)
    data = {} if document.data is None else document.data
    if not isinstance(data, dict):
        raise InputError(
            f"{source}: expected keys and values at the top level, found a {type(data).__name__}"
        )
    if folder is not None:
        _find_files_beside(data, schema, folder)
    changes = _apply_overrides(data, overrides)
    if complete:
        complete(data)
    return validate(schema, data, source, document, changes)


def validate[ConfigT: Config](
    schema: type[ConfigT],
    data: Any,
    source: str,
    document: YamlDocument | None = None,
    overrides: Mapping[Key, YamlDocument] | None = None,
) -> ConfigT:
    """Return data as a checked configuration.

    Where text is expected, a number is taken as it is written: an account 007 is no 7.

    Args:
        schema: what to make.
        data: keys and values.
        source: the name used in messages.
        document: where the data were read from.
        overrides: what has been put on top, by key.

    Raises:
        InputError: an unknown key, or a value that is not allowed; one line for each.
    """
    origin = _Origin(source, document, overrides or {})
    try:
        return schema.model_validate(data)
    except ValidationError as error:
        items = error.errors()
        restored = [origin.restore_text(data, item["loc"]) for item in items if item["type"] == "string_type"]
        if any(restored):
            return validate(schema, data, source, document, overrides)
        lines = [_describe(item, schema, origin) for item in items]
        raise InputError("\n".join(dict.fromkeys(lines))) from None


def _apply_overrides(data: dict[str, Any], overrides: Sequence[str]) -> dict[Key, YamlDocument]:
    """Put overrides on top of the data; return what was put where."""
    documents: dict[Key, YamlDocument] = {}
    for item in overrides:
        name, sep, value = item.partition("=")
        path = tuple(name.strip().split("."))
        if not sep or not all(path):
            raise InputError(f"override '{item}': expected key=value, such as loading.strategy.alpha=1.2")
        document = YamlDocument(value, f"override '{item}'")
        target = data
        for part in path[:-1]:
            child = target.get(part)
            if not isinstance(child, dict):
                child = {}
                target[part] = child
            target = child
        target[path[-1]] = document.data
        # A later override of a key or of what it is part of replaces it.
        documents = {key: known for key, known in documents.items() if key[: len(path)] != path}
        documents[path] = document
    return documents


def _find_files_beside(data: Any, schema: type[BaseModel], folder: Path) -> None:
    """Put whole paths in place of the names of files that lie in `folder`."""
    if not isinstance(data, dict) or not issubclass(schema, Config):
        return
    for key, value in data.items():
        if key in schema.file_fields:
            data[key] = (
                [_find_beside(v, folder) for v in value]
                if isinstance(value, list)
                else _find_beside(value, folder)
            )
        elif key in schema.model_fields:
            for inner in _find_schemas(schema.model_fields[key].annotation):
                for item in value if isinstance(value, list) else [value]:
                    _find_files_beside(item, inner, folder)


def _find_beside(name: Any, folder: Path) -> Any:
    if not isinstance(name, str) or "://" in name:
        return name
    # A function in a file is named ``file.py:function``.
    file, colon, function = name.rpartition(".py:")
    path = folder / (f"{file}.py" if colon else name)
    try:
        found = path.is_file()
    except (OSError, ValueError):
        return name
    return f"{path.resolve()}{colon and ':' + function}" if found else name


class _Origin:
    """Where the values of a configuration stand: in a file, or in overrides."""

    def __init__(
        self, source: str, document: YamlDocument | None, overrides: Mapping[Key, YamlDocument]
    ) -> None:
        self._source, self._document, self._overrides = source, document, overrides

    def describe(self, key: Key) -> str:
        """Return the name of the place, with a line where there is one."""
        if self._find_override(key):
            return "override"
        line = self._document.find_line(key) if self._document else None
        # An unknown room that stands in no file came by an override of a key in it.
        if line is None and any(path[: len(key)] == key for path in self._overrides):
            return "override"
        return f"{self._source}:{line}" if line else self._source

    def restore_text(self, data: Any, key: Key) -> bool:
        """Put a number back as the text it was written as; return whether there was one."""
        document, rest = self._find_override(key) or (self._document, key)
        text = document.find_number_text(rest) if document else None
        if text is None:
            return False
        for part in key[:-1]:
            data = data[part]
        if isinstance(data[key[-1]], str):
            return False
        data[key[-1]] = text
        return True

    def _find_override(self, key: Key) -> tuple[YamlDocument, Key] | None:
        for path, document in reversed(list(self._overrides.items())):
            if key[: len(path)] == path:
                return document, key[len(path) :]
        return None


def _describe(item: Any, schema: type[BaseModel], origin: _Origin) -> str:
    loc: Key = tuple(item["loc"])
    dotted = ".".join(str(part) for part in loc)
    where = origin.describe(loc)
    if item["type"] == "extra_forbidden":
        allowed = _list_fields(schema, loc[:-1])
        near = difflib.get_close_matches(str(loc[-1]), allowed, n=1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        return f"{where}: unknown key '{dotted}'; {hint}allowed here: {', '.join(sorted(allowed))}"
    message = item["msg"].removeprefix("Value error, ")
    message = message[:1].lower() + message[1:]
    if item["type"] == "string_type" and isinstance(item["input"], bool | int | float):
        message += "; quote it"
    # Of a whole room, the message itself says what is wrong with it.
    shown = "" if isinstance(item["input"], dict | Config) else f" (got {item['input']!r})"
    name = f"{dotted}: " if dotted else ""
    return f"{where}: {name}{message}{shown if len(shown) < 120 else ''}"


def make_json_schema(schema: type[Config], title: str) -> dict[str, Any]:
    """Return the JSON Schema of a schema's YAML files, for editors.

    Args:
        schema: such as `Scenario`.
        title: what to call it.
    """
    from pydantic.json_schema import GenerateJsonSchema  # takes a while to import, and few want it

    class Generator(GenerateJsonSchema):
        def str_schema(self, schema: Any) -> dict[str, Any]:
            # As `validate` does: digits are text where text is expected.
            return super().str_schema(schema) | {"type": ["string", "number"]}

    body = schema.model_json_schema(schema_generator=Generator)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **body, "title": title}


def list_types(annotation: Any, with_items: bool = False) -> set[Any]:
    """Return the types that a field may hold; with `with_items` also those of a tuple's items."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return list_types(arguments[0], with_items)
    if origin in (Union, UnionType) or (with_items and origin is tuple):
        return {kind for argument in arguments for kind in list_types(argument, with_items)}
    return {annotation}


def _holds_boolean(value: Any) -> bool:
    return isinstance(value, bool) or (isinstance(value, list | tuple) and any(map(_holds_boolean, value)))


def _list_fields(schema: type[BaseModel], loc: Key) -> list[str]:
    """Return the field names valid at a location, following nested schemas, lists and optional fields."""
    current: set[type[BaseModel]] = {schema}
    for part in loc:
        found: set[type[BaseModel]] = set()
        for model in current:
            if isinstance(part, str) and part in model.model_fields:
                found |= _find_schemas(model.model_fields[part].annotation)
            elif isinstance(part, int) or part not in model.model_fields:
                found.add(model)
        current = found
    return [name for model in current for name in model.model_fields]


def _find_schemas(annotation: Any) -> set[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return {annotation}
    return {schema for arg in get_args(annotation) for schema in _find_schemas(arg)}
