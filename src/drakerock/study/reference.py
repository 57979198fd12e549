"""The reference page of every key, made from the schemas."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from drakerock.config import Config, make_json_schema


def make_reference(schema: type[Config], kind: str) -> str:
    """Return a Markdown page: a table of keys, units, defaults and what is allowed for each part of the files.

    Args:
        schema: such as `Scenario`.
        kind: what its files are called.
    """
    body = make_json_schema(schema, f"drakerock {kind}")
    lines = [
        f"# Keys of a {kind} file",
        "",
        f"Made from the schema (`drakerock schema {kind}` prints it for editors): `python docs/make_reference.py`.",
        "Every key may be left out; an unknown one is an error. `--set KEY=VALUE` overrides one, with its dotted name.",
    ]
    for name, part, where in _walk(body, body, ""):
        lines += ["", f"## {name or 'Top level'}", ""]
        if where:
            lines += [where.split("\n\n")[0].replace("\n", " "), ""]
        lines += ["| key | default | allowed | what |", "|---|---|---|---|"]
        for key, item in part.get("properties", {}).items():
            plain = _resolve(body, item)
            shown = "see below" if _find_part(body, item) else f"`{_show(item.get('default'))}`"
            lines.append(f"| `{key}` | {shown} | {_allow(body, item)} | {_say(item, plain)} |")
    return "\n".join(lines) + "\n"


def _walk(body: dict[str, Any], part: dict[str, Any], name: str) -> Iterator[tuple[str, dict[str, Any], str]]:
    yield name, part, part.get("description", "")
    for key, item in part.get("properties", {}).items():
        inner = _find_part(body, item)
        if inner:
            yield from _walk(body, inner, f"{name}.{key}".lstrip("."))


def _find_part(body: dict[str, Any], item: dict[str, Any]) -> dict[str, Any] | None:
    """Return what is below a key, if it is a room of keys or a list of them."""
    for choice in (item, *item.get("allOf", ()), *item.get("anyOf", ()), item.get("items", {})):
        plain = _resolve(body, choice) if isinstance(choice, dict) else {}
        if plain.get("properties"):
            return plain
    return None


def _resolve(body: dict[str, Any], item: dict[str, Any]) -> dict[str, Any]:
    if "$ref" in item:
        found: dict[str, Any] = body["$defs"][item["$ref"].rsplit("/", 1)[-1]]
        return found
    return item


def _allow(body: dict[str, Any], item: dict[str, Any]) -> str:
    """Return in words what a value may be."""
    choices = [_resolve(body, choice) for choice in item.get("anyOf", [item])]
    words = [_allow_one(body, choice) for choice in choices]
    return ", or ".join(dict.fromkeys(word for word in words if word))


def _allow_one(body: dict[str, Any], item: dict[str, Any]) -> str:
    if "enum" in item:
        return ", ".join(f"`{value}`" for value in item["enum"])
    if "const" in item:
        return f"`{item['const']}`"
    kind = item.get("type", "")
    if isinstance(kind, list):
        kind = "string"
    if kind == "array":
        inner = item.get("items")
        return f"list of {_allow(body, inner)}" if isinstance(inner, dict) else "list"
    word = {"number": "number", "integer": "whole number", "string": "text", "boolean": "true, false"}.get(
        kind, kind
    )
    word = {"object": "keys and values", "null": "null"}.get(kind, word)
    signs = (("exclusiveMinimum", ">"), ("minimum", ">="), ("exclusiveMaximum", "<"), ("maximum", "<="))
    bounds = [f"{sign} {item[key]:g}" for key, sign in signs if key in item]
    return " ".join([word, *[", ".join(bounds)]]).strip()


def _say(item: dict[str, Any], plain: dict[str, Any]) -> str:
    text: str = item.get("description") or plain.get("description") or ""
    return text.split("\n\n")[0].replace("\n", " ").replace("|", "\\|")


def _show(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:g}"
    return str(value).replace("|", "\\|")
