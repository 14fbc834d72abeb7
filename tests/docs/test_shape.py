"""Limits for the shape of the code in v3dg/, counted in its syntax tree; the counts may
only fall.

A limit on the number of lines can be met by packing code, which makes it harder to
read. Each of these counts only falls if code is unpacked. `LIMITS` has the present
counts of each package. The test fails if a count is above its limit, and also if it is
well below, so that the limit is lowered.

`python tests/docs/test_shape.py` prints the counts of all packages. With files as
arguments, it prints each counted place.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TypeAlias

import pytest

ROOT = Path(__file__).parents[2]
LIBRARY = ROOT / "v3dg"
TOP = "v3dg"

MOST_LINES_A_FUNCTION = 40
MOST_POSITIONAL = 6

# Words that relate the parts of a phrase and do not say what a value is. Such a name
# says nothing away from the line that binds it, and a search does not find it. Words
# that also name a thing are left out if they have that meaning here: `left` and `right`
# (sides), `now` (a time), `first`, `last`, `start` and `end` (positions).
_PREPOSITIONS_AND_ADVERBS = """
    of by at in to from for with without over under above below about around after before behind
    beside between beyond inside outside into onto per since until till through toward towards
    upon via within along among against here there where elsewhere then once yet already still
    meanwhile apart away together ahead
"""
_CONJUNCTIONS_AND_QUESTIONS = """
    and or not if so as that than because unless while whether how why when who whom whose what
    which like unlike alike else also too only just even both either neither
"""
_PRONOUNS_AND_DETERMINERS = """
    it its is this these those they them their he she we us our you your one ones other others
    another each every all any some none same such own more most less few fewer many much
    several rest
"""
_PARTICIPLES_AND_VERBS = """
    found told given kept known taken made done seen asked wanted meant held shown chosen gone
    got had said was are be been has have does do did can may must will would
"""
FUNCTION_WORDS = frozenset(
    (
        _PREPOSITIONS_AND_ADVERBS
        + _CONJUNCTIONS_AND_QUESTIONS
        + _PRONOUNS_AND_DETERMINERS
        + _PARTICIPLES_AND_VERBS
    ).split()
)

Function: TypeAlias = ast.FunctionDef | ast.AsyncFunctionDef


class Place(NamedTuple):
    """A place in the code that is counted."""

    kind: str
    line: int
    text: str


# The counted kinds, by their headings in the table.
KINDS = {
    "code": "lines that are neither blank nor a comment nor a docstring",
    "packed": "several values assigned to several targets, and several statements on a line",
    "conditional": "`a if b else c`",
    "comprehensions": "printed, not limited",
    "names": "bindings of variables, loop targets, parameters and attributes",
    "words": "bindings of names in FUNCTION_WORDS",
    "Any": "`Any` in types",
    "**Any": "functions with `**options: Any`",
    "long": f"functions of more than {MOST_LINES_A_FUNCTION} lines of code",
    "positional": f"functions with more than {MOST_POSITIONAL} positional parameters",
}
LIMITED = ("packed", "conditional", "words", "Any", "**Any", "long", "positional")


def lines_of_code(text: str) -> set[int]:
    """Return the numbers of the lines with code. Docstrings, comments and blank lines
    have none."""
    nothing = {"COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT", "ENDMARKER"}
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if tokenize.tok_name[token.type] not in nothing:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if (
            isinstance(node, ast.Module | ast.ClassDef | Function)
            and ast.get_docstring(node) is not None
        ):
            docstring = node.body[0]
            lines.difference_update(range(docstring.lineno, docstring.end_lineno + 1))
    return lines


def is_packed(node: ast.AST) -> bool:
    """Return whether an assignment binds several targets, and neither unpacks one value
    nor swaps values."""
    if not isinstance(node, ast.Assign):
        return False
    if len(node.targets) > 1:
        return True
    target = node.targets[0]
    value = node.value
    if not isinstance(target, ast.Tuple) or not isinstance(value, ast.Tuple):
        return False
    is_swap = sorted(map(ast.unparse, target.elts)) == sorted(map(ast.unparse, value.elts))
    return not is_swap


def crowded_lines(tree: ast.AST) -> Iterator[int]:
    """Return the lines on which a statement follows another statement or the header of
    its block."""
    for node in ast.walk(tree):
        for name in ("body", "orelse", "finalbody"):
            block = getattr(node, name, None)
            if not isinstance(block, list):
                continue
            previous = node.lineno if name == "body" and isinstance(node, ast.stmt) else None
            for statement in block:
                is_ellipsis = isinstance(statement, ast.Expr) and isinstance(
                    statement.value, ast.Constant
                )
                if statement.lineno == previous and not is_ellipsis:
                    yield statement.lineno
                previous = statement.end_lineno


def bound_name(node: ast.AST) -> str | None:
    """Return the name that a node binds: of a variable, a loop target, a parameter, an
    attribute or an exception."""
    match node:
        case ast.Name(id=name, ctx=ast.Store()):
            return name
        case ast.Attribute(attr=name, ctx=ast.Store()):
            return name
        case ast.arg(arg=name):
            return name
        case ast.ExceptHandler(name=name):
            return name
    return None


def is_any(node: ast.AST | None) -> bool:
    match node:
        case ast.Name(id="Any") | ast.Attribute(attr="Any") | ast.Constant(value="Any"):
            return True
    return False


COUNTED_NODES = {
    "packed": is_packed,
    "conditional": lambda node: isinstance(node, ast.IfExp),
    "comprehensions": lambda node: isinstance(
        node, ast.ListComp | ast.SetComp | ast.DictComp | ast.GeneratorExp
    ),
    "Any": is_any,
}


def places(text: str) -> Iterator[Place]:
    """Return all counted places in a file."""
    tree = ast.parse(text)
    code = lines_of_code(text)
    for line in code:
        yield Place("code", line, "")
    for line in crowded_lines(tree):
        yield Place("packed", line, text.splitlines()[line - 1].strip())
    for node in ast.walk(tree):
        for kind, is_counted in COUNTED_NODES.items():
            if is_counted(node):
                yield Place(kind, node.lineno, ast.unparse(node))
        name = bound_name(node)
        if name is not None:
            yield Place("names", node.lineno, name)
            if name.strip("_") in FUNCTION_WORDS and not name.startswith("__"):
                yield Place("words", node.lineno, name)
        if isinstance(node, Function):
            yield from places_of_function(node, code)


def places_of_function(function: Function, code: set[int]) -> Iterator[Place]:
    arguments = function.args
    if arguments.kwarg is not None and is_any(arguments.kwarg.annotation):
        yield Place("**Any", function.lineno, function.name)
    # The lines of a long signature count, but not those of a docstring.
    num_lines = len(code.intersection(range(function.lineno, function.end_lineno + 1)))
    if num_lines > MOST_LINES_A_FUNCTION:
        yield Place("long", function.lineno, f"{function.name}: {num_lines} lines")
    positional = [argument.arg for argument in (*arguments.posonlyargs, *arguments.args)]
    num_positional = len(positional) - (positional[:1] in (["self"], ["cls"]))
    if num_positional > MOST_POSITIONAL:
        yield Place("positional", function.lineno, f"{function.name}: {num_positional} parameters")


def counts_of_file(path: Path) -> Counter[str]:
    return Counter(place.kind for place in places(path.read_text(encoding="utf-8")))


def counts_of_packages() -> dict[str, Counter[str]]:
    result: dict[str, Counter[str]] = {}
    for path in sorted(LIBRARY.rglob("*.py")):
        parts = path.relative_to(LIBRARY).parts
        package = TOP if len(parts) == 1 else parts[0]
        result.setdefault(package, Counter()).update(counts_of_file(path))
    return result


def table(packages: dict[str, Counter[str]]) -> str:
    """Return a table of the counts. In brackets it has the counts per thousand lines of
    code, or the share of all names."""
    total: Counter[str] = Counter()
    for counts in packages.values():
        total.update(counts)
    rows = [["", *KINDS]]
    for name, counts in {**packages, "all": total}.items():
        row = [name]
        for kind in KINDS:
            text = str(counts[kind])
            if kind in ("packed", "conditional", "comprehensions"):
                text += f" ({1000 * counts[kind] / counts['code']:.1f})"
            if kind == "words":
                text += f" ({100 * counts['words'] / counts['names']:.1f} %)"
            row.append(text)
        rows.append(row)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(map(str.rjust, row, widths)) for row in rows)


# The limits of each package, in the order of LIMITED.
LIMITS = {
    "v3dg": (0, 0, 0, 5, 0, 0, 0),
    "_urls": (0, 0, 0, 0, 0, 0, 0),
    "levels": (0, 0, 0, 0, 0, 0, 0),
    "bundle": (0, 0, 0, 1, 0, 0, 0),
    "cli": (0, 0, 2, 1, 0, 0, 0),
    "compat": (0, 0, 0, 1, 0, 0, 1),
    "export": (0, 0, 0, 0, 0, 0, 0),
    "formats": (0, 0, 0, 1, 0, 0, 0),
    "render": (0, 0, 0, 0, 0, 0, 0),
    "scene": (0, 0, 0, 0, 0, 0, 0),
    "simulators": (0, 0, 0, 0, 0, 0, 0),
    "viewer": (0, 0, 0, 0, 0, 0, 0),
}


@pytest.fixture(scope="module")
def packages() -> dict[str, Counter[str]]:
    return counts_of_packages()


def test_every_package_has_its_limits(packages):
    assert sorted(packages) == sorted(LIMITS)


@pytest.mark.parametrize("package", LIMITS)
def test_packing_may_only_fall(packages, package):
    for kind, limit in zip(LIMITED, LIMITS[package], strict=True):
        count = packages[package][kind]
        advice = "`python tests/docs/test_shape.py FILES` lists them"
        assert count <= limit, (
            f"{package}: {count} of {kind} ({KINDS[kind]}), at most {limit}; {advice}"
        )
        slack = max(2, limit // 10)
        assert count >= limit - slack, (
            f"{package}: only {count} of {kind} are left, lower its limit of {limit}"
        )


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("a, b = x, y", 1),
        ("a, (b, c) = x, y", 1),
        ("self.a, *b = x, y, *z", 1),
        ("a = b = x", 1),
        ("a = x; b = y", 1),
        ("if a: b = x", 1),
        ("for a in x: b(a)", 1),
        ("if a:\n    b = x\nelse: c = y; d = y", 1),
        ("a, b = x", 0),
        ("a, b = b, a", 0),
        ("a[0], a[1] = a[1], a[0]", 0),
        ("a = x, y", 0),
        ("class A:\n    def f(self) -> int: ...", 0),
    ],
)
def test_packed_assignments_are_counted(text, count):
    assert [place.kind for place in places(text)].count("packed") == count


def test_what_is_counted_of_a_function():
    text = """
def f(of, a: Any, b: "Any", c, d, e, g, *, h=1, **options: Any):
    '''A docstring of
    two lines.'''
    # A comment.
    for where in (x if y else z for _ in a):
        self.how = where
"""
    counts = Counter(place.kind for place in places(text))
    expected = {
        "code": 3,
        "packed": 0,
        "conditional": 1,
        "comprehensions": 1,
        "names": 12,
        "words": 3,
    }
    expected |= {"Any": 3, "**Any": 1, "long": 0, "positional": 1}
    assert {kind: counts[kind] for kind in KINDS} == expected


def test_long_functions_are_counted_without_their_docstring():
    def function(num_statements):
        return '"""Doc.\n    """\n    '.join(
            ["def f():\n    ", "\n    ".join(["x()"] * num_statements)]
        )

    def is_long(text):
        return any(place.kind == "long" for place in places(text))

    assert not is_long(function(MOST_LINES_A_FUNCTION - 1))
    assert is_long(function(MOST_LINES_A_FUNCTION))


def main() -> None:
    if len(sys.argv) == 1:
        print(table(counts_of_packages()))
    for path in sys.argv[1:]:
        for place in sorted(
            places(Path(path).read_text(encoding="utf-8")), key=lambda place: place.line
        ):
            if place.kind in LIMITED:
                print(f"{path}:{place.line}: {place.kind}: {place.text}")


if __name__ == "__main__":
    main()
