"""Reading YAML into the rooms' schemas, with errors that name file, line, key path and what is allowed.

Every room declares its part of the configuration as a `Config`; a scenario or a study is a `Config` made of
those. Configurations are frozen: change one with `model_copy(update=...)` or an override.
"""

from __future__ import annotations

import difflib
import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, get_args

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from drakerock.errors import InputError

Key = tuple[str | int, ...]


class Config(BaseModel):
    """Base of all schemas: unknown keys are errors, values are checked, instances are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def calc_config_hash(config: BaseModel, *extra: str) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of the resolved configuration.

    Args:
        config: any schema instance.
        extra: further strings that belong to the identity (a seed, a version).
    """
    text = json.dumps(config.model_dump(mode="json"), sort_keys=True) + "\0".join(extra)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def load_config[ConfigT: Config](
    path: str | Path,
    schema: type[ConfigT],
    overrides: Sequence[str] = (),
    complete: Callable[[dict[str, Any]], None] | None = None,
) -> ConfigT:
    """Read a YAML file into `schema`.

    Args:
        path: the YAML file; an empty file means all defaults.
        overrides: ``"dotted.key=value"`` strings, the value in YAML, applied on top of the file.
        complete: may alter the data before they are checked, such as by what another file holds.

    Raises:
        InputError: unreadable file, YAML syntax, unknown key, value out of range.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{path}: cannot be read: {reason}") from None
    return parse_config(text, schema, overrides, source=str(path), complete=complete)


def parse_config[ConfigT: Config](
    text: str,
    schema: type[ConfigT],
    overrides: Sequence[str] = (),
    source: str = "<text>",
    complete: Callable[[dict[str, Any]], None] | None = None,
) -> ConfigT:
    """Parse YAML text into `schema`; `source` is the name used in messages. Otherwise as `load_config`."""
    try:
        node = yaml.compose(text, Loader=yaml.SafeLoader)
        data = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{source}:{mark.line + 1}" if mark else source
        problem = getattr(error, "problem", None) or str(error)
        raise InputError(f"{where}: not valid YAML: {problem}") from None
    data = {} if data is None else data
    if not isinstance(data, dict):
        raise InputError(
            f"{source}: expected keys and values at the top level, found a {type(data).__name__}"
        )
    overridden = _apply_overrides(data, overrides)
    if complete:
        complete(data)
    try:
        return schema.model_validate(data)
    except ValidationError as error:
        lines = [_describe(item, schema, node, source, overridden) for item in error.errors()]
        raise InputError("\n".join(dict.fromkeys(lines))) from None


def _apply_overrides(data: dict[str, Any], overrides: Iterable[str]) -> list[Key]:
    keys: list[Key] = []
    for item in overrides:
        name, sep, value = item.partition("=")
        path = tuple(name.strip().split("."))
        if not sep or not all(path):
            raise InputError(
                f"--set {item}: expected key=value, for example --set loading.strategy.alpha=1.2"
            )
        try:
            parsed = yaml.safe_load(value)
        except yaml.YAMLError:
            raise InputError(f"--set {item}: the value is not valid YAML") from None
        target = data
        for part in path[:-1]:
            child = target.get(part)
            if not isinstance(child, dict):
                child = {}
                target[part] = child
            target = child
        target[path[-1]] = parsed
        keys.append(path)
    return keys


def _describe(
    item: Any, schema: type[BaseModel], node: yaml.Node | None, source: str, overridden: list[Key]
) -> str:
    loc: Key = tuple(part for part in item["loc"])
    dotted = ".".join(str(part) for part in loc) or "(top level)"
    line = _find_line(node, loc)
    # An unknown room that stands in no file came by an override of a key in it.
    made = any(key[: len(loc)] == loc for key in overridden) and line is None
    if made or any(loc[: len(key)] == key for key in overridden):
        where = "--set"
    else:
        where = f"{source}:{line}" if line else source
    if item["type"] == "extra_forbidden":
        allowed = _list_fields(schema, loc[:-1])
        near = difflib.get_close_matches(str(loc[-1]), allowed, n=1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        return f"{where}: unknown key '{dotted}'; {hint}allowed here: {', '.join(sorted(allowed))}"
    message = item["msg"].removeprefix("Value error, ")
    message = message[:1].lower() + message[1:]
    shown = "" if item["type"] == "missing" else f" (got {item['input']!r})"
    return f"{where}: {dotted}: {message}{shown if len(shown) < 120 else ''}"


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


def _find_line(node: yaml.Node | None, loc: Key) -> int | None:
    """Return the 1-based line of the deepest part of `loc` that stands in the file."""
    line = None
    for part in loc:
        if isinstance(node, yaml.MappingNode):
            match = [(k, v) for k, v in node.value if k.value == str(part)]
            if not match:
                break
            line, node = match[0][0].start_mark.line + 1, match[0][1]
        elif isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
            node = node.value[part]
            line = node.start_mark.line + 1
        else:
            break
    return line
