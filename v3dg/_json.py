"""Reads and writes strict JSON. Values are stored with their location in the file, for
error messages."""

from __future__ import annotations

import codecs
import json
import math
import os
import unicodedata
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn, TypeAlias, TypeVar

from v3dg import _files

T = TypeVar("T")

Json: TypeAlias = Any
"""A JSON value. The type is not a union, which would make every use of a field a type
error. `Node` checks values that are read from a file."""

JsonObject: TypeAlias = dict[str, Json]

_LARGEST_SIDE = 1 << 20  # Maximum side of a picture, px.
_BYTE_ORDER_MARK = "\ufeff"
_UTF16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def parse_json(text: str | bytes) -> Json:
    """Parse strict JSON, with or without a byte order mark. Raise ValueError for
    invalid JSON, NaN, repeated keys, and deep nesting."""
    if isinstance(text, bytes):
        text = text.decode("utf-8")
    try:
        return json.loads(
            text.removeprefix(_BYTE_ORDER_MARK),
            object_pairs_hook=_unique_keys,
            parse_constant=_refuse_constant,
        )
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _unique_keys(pairs: list[tuple[str, object]]) -> dict[str, object]:
    fields: dict[str, object] = {}
    for key, value in pairs:
        if key in fields:
            raise ValueError(f"the key {json_text(key)} occurs twice in an object")
        fields[key] = value
    return fields


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a JSON number")


def json_text(value: object) -> str:
    """Return a JSON value as short text for a one-line message."""
    if isinstance(value, dict) and len(value) > 8:
        return f"an object of {len(value)} values"
    if isinstance(value, list) and len(value) > 8:
        return f"an array of {len(value)} values"
    try:
        text = json.dumps(value)
    except RecursionError:
        return "a deeply nested value"
    if len(text) > 60:
        return text[:57] + "..."
    return text


def is_one_line(text: str) -> bool:
    """Return whether a text fits in one line of a message. It must not have control
    characters or unpaired surrogates."""
    return not any(unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") for c in text)


def read_json(path: str | os.PathLike[str]) -> Node:
    """Read a JSON file. Raise ValueError unless it is a regular file with strict JSON
    in UTF-8."""
    path = Path(path)
    with _files.naming_errors(path), open(_files.open_regular(path), "rb") as file:
        content = file.read()
    try:
        if content.startswith(_UTF16_MARKS):
            raise ValueError("the file is in UTF-16; save it as UTF-8")
        return Node(parse_json(content), path.name, "")
    except ValueError as error:
        raise ValueError(
            f"{path.name}: expected JSON, got a file that does not parse: {error}"
        ) from error


def write_json(path: str | os.PathLike[str], document: object) -> None:
    """Write a JSON file. An existing file is replaced when the new one is complete."""
    with _files.replacing(path) as temporary:
        Path(temporary).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


class Node:
    """A JSON value with its location: the name of the file, and the path of the value
    in the document."""

    def __init__(self, value: Json, file: str, path: str) -> None:
        self.value = value
        self.file = file
        self.path = path

    def problem(self, text: str) -> ValueError:
        """Return an error whose message begins with the location."""
        return ValueError(f"{self.file}: {self.path or 'top level'}: {text}")

    def error(self, expected: str, advice: str = "") -> ValueError:
        text = f"expected {expected}, got {json_text(self.value)}"
        if advice:
            text = f"{text}; {advice}"
        return self.problem(text)

    def attempt(self, make: Callable[[], T]) -> T:
        """Return the result of ``make``. A ValueError of ``make`` begins with the name
        of a field; add the location of this value in front of it."""
        try:
            return make()
        except ValueError as error:
            place = ""
            if self.path:
                place = f"{self.path}."
            raise ValueError(f"{self.file}: {place}{error}") from error

    def field(self, key: str) -> Node:
        """Return a field of an object."""
        if not isinstance(self.value, dict):
            raise self.error("an object")
        if key not in self.value:
            raise self.problem(f"expected the field {key}, got an object without it")
        path = key
        if not is_one_line(key) or len(key) > 60:
            path = json_text(key)
        if self.path:
            path = f"{self.path}.{path}"
        return Node(self.value[key], self.file, path)

    def has(self, key: str) -> bool:
        return isinstance(self.value, dict) and key in self.value

    def items(
        self, expected: str = "an array", min_length: int = 0, max_length: float = math.inf
    ) -> Iterator[Node]:
        """Return an iterator over the values of an array. For a large array, a list of
        nodes would need far more memory than the file."""
        if not isinstance(self.value, list) or not min_length <= len(self.value) <= max_length:
            raise self.error(expected)
        return (Node(value, self.file, f"{self.path}[{i}]") for i, value in enumerate(self.value))

    def some_fields(self, required: tuple[str, ...]) -> dict[str, Node]:
        """Return the fields of an object.

        Raise an error if a required field is missing.
        """
        if not isinstance(self.value, dict):
            raise self.error("an object")
        return {key: self.field(key) for key in dict.fromkeys((*required, *self.value))}

    def fields(self, required: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, Node]:
        """Return the fields of an object. Raise an error if a required field is
        missing, or if there is an unknown field."""
        fields = self.some_fields(required)
        for key, node in fields.items():
            if key not in required and key not in optional:
                allowed = ", ".join((*required, *optional))
                raise node.problem(f"expected one of {allowed}, got an unknown field")
        return fields

    def text(self) -> str:
        if not isinstance(self.value, str) or not self.value:
            raise self.error("a string")
        if not is_one_line(self.value):
            raise self.error("a string without control characters")
        return self.value

    def number(
        self,
        expected: str = "a finite number",
        lower_bound: float = -math.inf,
        upper_bound: float = math.inf,
    ) -> float:
        """Return a number strictly between two bounds."""
        if isinstance(self.value, bool) or not isinstance(self.value, int | float):
            raise self.error("a number")
        try:
            number = float(self.value)
        except OverflowError:
            number = math.inf
        if not lower_bound < number < upper_bound:
            raise self.error(expected)
        return number

    def positive(self) -> float:
        return self.number("a positive number", 0)

    def field_of_view(self) -> float:
        return self.number("radians between 0 and pi", 0, math.pi)

    def size(self) -> int:
        """Return the width or height of a picture in px. Values such as 1920.0 are
        accepted, because some programs write them."""
        side = self.number()
        if side != int(side) or side <= 0:
            raise self.error("a positive whole number")
        if side > _LARGEST_SIDE:
            raise self.error(f"at most {_LARGEST_SIDE} px")
        return int(side)

    def vector(self, length: int) -> list[float]:
        return [item.number() for item in self.items(f"{length} numbers", length, length)]

    def matrix(self, num_rows: int, num_columns: int) -> list[list[float]]:
        expected = f"{num_rows} rows of {num_columns} numbers"
        return [row.vector(num_columns) for row in self.items(expected, num_rows, num_rows)]
