"""The viewer's page: its types agree with the messages, and its modules keep their
structure."""

import re
import shutil
import subprocess
from dataclasses import asdict, fields

import pytest

from v3dg.viewer.frame import Settings
from v3dg.viewer.view import View

msgspec = pytest.importorskip("msgspec")
page_protocol = pytest.importorskip("page_protocol")
answers = pytest.importorskip("v3dg.viewer.answers")
messages = pytest.importorskip("v3dg.viewer.messages")

PAGE = page_protocol.FILE.parent
MODULES = sorted(PAGE.glob("*.js"))
MOST_LINES = 300
TSC = shutil.which("tsc")
LOOK = {
    "type": "look",
    "view": {"wxyz": (1, 0, 0, 0), "position": (0, 0, 0), "fov_y": 1, "aspect": 1},
    "size": (4, 4),
}


def test_types_of_the_page_are_those_of_the_messages():
    """After a change of the messages, run python tests/support/page_protocol.py."""
    assert page_protocol.FILE.read_text(encoding="utf-8") == page_protocol.protocol()


@pytest.mark.parametrize(
    ("checked", "value"), [(messages._View, View), (messages._Settings, Settings)]
)
def test_checked_messages_have_the_fields_of_their_values(checked, value):
    assert list(checked.__struct_fields__) == [field.name for field in fields(value)]


def test_settings_that_are_not_said_are_the_defaults():
    look = messages.read_message(msgspec.json.encode(LOOK))
    assert asdict(look.request().settings) == asdict(Settings())


def test_limits_are_those_of_the_messages():
    limits = messages.LIMITS
    bounds = {"tolerance": limits.tolerance, "budget": limits.budget, "gain": limits.gain}
    for name, (low, high) in bounds.items():
        for value in (low, high):
            messages.read_message(msgspec.json.encode(LOOK | {"settings": {name: value}}))
        for value in (low - 1, high + 1):
            message = msgspec.json.encode(LOOK | {"settings": {name: value}})
            with pytest.raises(msgspec.ValidationError, match=name):
                messages.read_message(message)


@pytest.mark.parametrize("module", MODULES, ids=lambda path: path.name)
def test_modules_of_the_page_declare_their_fields(module):
    """Fields are declared in the class or in its constructor, each with its own
    statement."""
    text = module.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= MOST_LINES
    for name, body in re.findall(r"^(?:export )?class (\w+) \{\n(.*?)^\}", text, re.M | re.S):
        constructor = re.search(r"^  constructor\(.*?^  \}$", body, re.M | re.S)
        declared = {*re.findall(r"^  (\w+) = ", body, re.M)}
        declared.update(assigned(constructor[0] if constructor else ""))
        assert assigned(body) <= declared, name
        assert not re.search(r"\[this\.\w+[^\]]*\] = ", body), name


def assigned(text):
    """Return the names of the fields to which the code of a class assigns."""
    return {*re.findall(r"\bthis\.(\w+) [-+*/]?= ", text)}


@pytest.mark.witness
@pytest.mark.skipif(TSC is None, reason="tsc, the compiler of TypeScript, is not installed")
def test_types_of_the_page_are_right():
    subprocess.run([TSC, "-p", PAGE / "jsconfig.json"], check=True)
