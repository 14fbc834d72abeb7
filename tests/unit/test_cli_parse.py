"""Tests the parser of the command line: mistakes of users, and options that every
command has."""

import pytest

from v3dg import cli
from v3dg.cli._common import UsageError


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        ("rendr a.v3dg", "perhaps you meant render; run v3dg --help"),
        ("render a.v3dg --tolerence 3", "perhaps you meant --tolerance; run v3dg"),
        ("build a.ply --cluster-sise 3", "perhaps you meant --cluster-size; run v3dg"),
        ("build --cluster-sise 3 a.ply", "--cluster-sise: expected an option of v3dg build"),
        ("render --toleranze=3 a.v3dg", "perhaps you meant --tolerance; run v3dg render"),
        ("render --quite a.v3dg", "perhaps you meant --quiet; run v3dg render"),
        ("export a.json --out site", "perhaps you meant --output; run v3dg export"),
    ],
)
def test_slips_on_the_command_line_are_told_what_may_be_meant(typed, message):
    with pytest.raises(UsageError, match=message):
        cli.parse(typed.split())


def test_nothing_is_guessed_where_nothing_is_alike():
    with pytest.raises(UsageError) as error:
        cli.parse(["xyzzy"])
    assert "perhaps" not in str(error.value)
    with pytest.raises(
        UsageError, match="--steps: expected an option of v3dg build, got none; run"
    ):
        cli.parse(["build", "a.ply", "--steps", "3"])


@pytest.mark.parametrize("command", [name for name in cli.COMMANDS if name != "completion"])
def test_every_command_can_be_quiet_and_print_json(command):
    options = cli.COMMANDS[command][0].__dataclass_fields__
    assert {"quiet", "json"} <= options.keys()
