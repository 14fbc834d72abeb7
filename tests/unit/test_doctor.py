"""The command `v3dg doctor`."""

import json

import v3dg
from v3dg import _extras, cli


def test_doctor_says_what_is_there_and_how_to_get_the_rest(monkeypatch, capsys, tmp_path):
    compiler = tmp_path / "c++"
    compiler.write_text("#!/bin/sh\necho g++ 99.1\n")
    compiler.chmod(0o755)
    for name in ("CXX", "CUDACXX"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setitem(_extras.EXTRAS, "nowhere", _extras.Extra("nowhere-at-all>=7", "nothing"))
    assert cli.main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    told = dict(line.split("  ", 1) for line in lines)
    assert told["compiler"].strip() == "g++ 99.1"
    assert told["GPU, driver"].strip().startswith("missing, to draw and build with CUDA")
    assert told["nowhere-at-all"].strip() == "missing, for nothing: pip install 'nowhere-at-all>=7'"
    assert v3dg.__version__ in told["v3dg"]


def test_doctor_prints_json(capsys):
    assert cli.main(["doctor", "--json"]) == 0
    parts = json.loads(capsys.readouterr().out)["parts"]
    assert all(
        (part["found"] is None) == (part["missing"] is not None)
        for part in parts
        if part["part"] != "CUDA"
    )
    assert {"v3dg", "Python", "compiler", "CUDA", "torch", "web browser"} <= {
        part["part"] for part in parts
    }
