"""Generates the TypeScript types of the viewer's page from the messages in Python.

`python tests/support/page_protocol.py` writes `v3dg/viewer/page/protocol.d.ts`. A test
compares that file with the messages.
"""

from __future__ import annotations

import inspect
import typing
from pathlib import Path
from typing import Any

import msgspec

from v3dg.viewer import answers, messages

FILE = Path(answers.__file__).parent / "page" / "protocol.d.ts"
HEAD = """\
// What the viewer's page and its server say to each other.
// Made by tests/support/page_protocol.py; do not edit.
"""
MOST_COLUMNS = 100
SIMPLE_TYPES = {
    "string": "string",
    "number": "number",
    "integer": "number",
    "boolean": "boolean",
    "null": "null",
}


def protocol() -> str:
    """Return the text of the file."""
    said = typing.get_args(messages.Message)
    told = typing.get_args(answers.Answer)
    # `_View` and `_Settings` are `View` and `Settings` with bounds. The documented
    # versions come later and replace them.
    _, schemas = msgspec.json.schema_components([*said, *told], ref_template="{name}")
    named = {public_name(name): schema for name, schema in sorted(schemas.items(), reverse=True)}
    parts = [HEAD, shows_type()]
    parts += [interface(name, schema) for name, schema in sorted(named.items())]
    parts.append(union("FromPage", names_of(said), "What the page says."))
    parts.append(union("FromViewer", names_of(told), "What the viewer says."))
    return "\n".join(parts)


def public_name(name: str) -> str:
    return name.rpartition(".")[2].lstrip("_")


def shows_type() -> str:
    modes = [f'"{mode}"' for mode in typing.get_args(answers.Shows)]
    return union("Shows", modes, "The modes of a picture.")


def union(name: str, members: list[str], comment: str) -> str:
    line = f"export type {name} = {' | '.join(members)};"
    if len(line) > MOST_COLUMNS:
        line = "\n  | ".join([f"export type {name} =", *members]) + ";"
    return f"/** {comment} */\n{line}\n"


def names_of(structs: tuple[type, ...]) -> list[str]:
    return [struct.__name__ for struct in structs]


def interface(name: str, schema: dict[str, Any]) -> str:
    lines = comment_lines(schema.get("description", ""))
    lines.append(f"export interface {name} {{")
    required = schema.get("required", [])
    for field, field_schema in schema["properties"].items():
        # A field with a default may be omitted; settings are always sent completely.
        mark = "" if field in required or field == "type" or name == "Settings" else "?"
        lines.append(f"  {field}{mark}: {type_text(field_schema)};")
    lines.append("}\n")
    return "\n".join(lines)


def comment_lines(docstring: str) -> list[str]:
    """Return a docstring as a comment."""
    lines = inspect.cleandoc(docstring).splitlines()
    if len(lines) == 1:
        return [f"/** {lines[0]} */"]
    return ["/**", *(f" * {line}".rstrip() for line in lines), " */"]


def type_text(schema: dict[str, Any]) -> str:
    if "$ref" in schema:
        return public_name(schema["$ref"])
    if "anyOf" in schema:
        return " | ".join(type_text(part) for part in schema["anyOf"])
    if "enum" in schema:
        if set(schema["enum"]) == set(typing.get_args(answers.Shows)):
            return "Shows"
        return " | ".join(f'"{value}"' for value in schema["enum"])
    if schema.get("type") == "array":
        return array_text(schema)
    return SIMPLE_TYPES[schema["type"]]


def array_text(schema: dict[str, Any]) -> str:
    if "prefixItems" in schema:
        return f"[{', '.join(type_text(item) for item in schema['prefixItems'])}]"
    item = type_text(schema["items"])
    if " | " in item:
        item = f"({item})"
    return f"{item}[]"


if __name__ == "__main__":
    FILE.write_text(protocol(), encoding="utf-8")
