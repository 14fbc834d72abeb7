"""`v3dg/_core.pyi` describes the compiled module: its names, properties, and parameters
in their order."""

import ast
import enum
import re
import types
from pathlib import Path
from typing import NamedTuple

import pytest

from v3dg import _core

ROOT = Path(__file__).parents[2]
SOURCE = (ROOT / "v3dg" / "_core.pyi").read_text(encoding="utf-8")
BINDINGS = "\n".join(p.read_text(encoding="utf-8") for p in (ROOT / "csrc" / "bindings").iterdir())

READ_ONLY, WRITABLE = "a property that is only read", "an attribute"


class Parameter(NamedTuple):
    name: str  # empty for a parameter that can be given by position only
    kind: str
    has_default: bool


def parameters_of(definition):
    """Return the parameters of a function without self."""
    given = definition.args
    places = [*given.posonlyargs, *given.args]
    defaults = [None] * (len(places) - len(given.defaults)) + given.defaults
    found = []
    for a, default in zip(places, defaults, strict=True):
        # pybind11 calls parameters without a name arg0, arg1 and so on.
        has_name = a not in given.posonlyargs and not re.fullmatch(r"arg\d+", a.arg)
        if a.arg != "self":
            found.append(Parameter(a.arg if has_name else "", "", default is not None))
    found += [Parameter(given.vararg.arg, "*", False)] if given.vararg else []
    found += [
        Parameter(a.arg, "keyword", d is not None)
        for a, d in zip(given.kwonlyargs, given.kw_defaults, strict=True)
    ]
    found += [Parameter(given.kwarg.arg, "**", False)] if given.kwarg else []
    return tuple(found)


def signatures_in_docstring(name, text):
    """Return the parameters of each overload, from the first lines of a docstring of
    pybind11."""
    overloads = re.findall(rf"^\d+\. {name}(\(.*)$", text, re.MULTILINE)
    lines = overloads or re.findall(rf"\A{name}(\(.*)", text)
    assert lines, f"{name}: expected a docstring with a signature, got {text!r}"
    # Python has no literal for some defaults, which are written as <...>.
    definitions = [f"def {name}{re.sub(r'= <[^>]*>', '= ...', line)}: ..." for line in lines]
    return {parameters_of(ast.parse(definition).body[0]) for definition in definitions}


def members_of_module(owner):
    """Return the members of a module or class by name: signatures, the members of a
    class, or the kind of attribute."""
    if isinstance(owner, enum.EnumMeta):
        return dict.fromkeys(owner.__members__, WRITABLE)
    found = {}
    for name, value in vars(owner).items():
        if isinstance(value, type):
            found[name] = members_of_module(value)
        elif isinstance(value, property):
            found[name] = READ_ONLY if value.fset is None else WRITABLE
        elif not callable(value):
            found[name] = WRITABLE
        # Every class inherits this one from object.
        elif is_compared(name) and not isinstance(value, types.WrapperDescriptorType):
            found[name] = signatures_in_docstring(name, getattr(owner, name).__doc__)
    return public(found)


def members_of_stub(body):
    found = {}
    for node in body:
        if isinstance(node, ast.ClassDef):
            found[node.name] = members_of_stub(node.body)
        elif isinstance(node, ast.AnnAssign) and ast.unparse(node.annotation) != "TypeAlias":
            found[node.target.id] = WRITABLE
        elif isinstance(node, ast.Assign):  # values of an enum
            found |= {target.id: WRITABLE for target in node.targets}
        elif isinstance(node, ast.FunctionDef):
            decorators = {ast.unparse(decorator) for decorator in node.decorator_list}
            if decorators <= {"overload", "staticmethod"}:
                found.setdefault(node.name, set()).add(parameters_of(node))
            else:
                found[node.name] = READ_ONLY if "property" in decorators else WRITABLE
    return public(found)


def is_compared(name):
    return name == "__init__" or not name.startswith("_")


def public(members):
    """Return the public members. A constructor without parameters is left out, because
    a stub may omit it."""
    return {
        name: member
        for name, member in members.items()
        if is_compared(name) and not (name == "__init__" and member == {()})
    }


def as_built(stub, module):
    """Return the part of the stub that the module must have: without CUDA, it has no
    bindings for CUDA."""
    if _core.has_cuda or not (isinstance(stub, dict) and isinstance(module, dict)):
        return stub
    return {
        name: as_built(member, module.get(name))
        for name, member in stub.items()
        if name in module or f'"{name}"' not in BINDINGS
    }


MODULE = members_of_module(_core)
STUB = as_built(members_of_stub(ast.parse(SOURCE).body), MODULE)


@pytest.mark.parametrize("name", sorted(MODULE.keys() | STUB.keys()))
def test_stub_says_what_the_module_has(name):
    assert STUB.get(name) == MODULE.get(name)
