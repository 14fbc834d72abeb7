"""The command line. Each command has a module that defines its options, calls the
library and prints the result.

Exit codes are 0 for success, 1 for failure, 2 for wrong usage, and 130 for an
interrupt. Errors are one line on stderr, and results go to stdout.
"""

from v3dg.cli import (
    build,
    compare,
    completion,
    convert,
    demo,
    doctor,
    export,
    info,
    refine,
    render,
    view,
)
from v3dg.cli._program import Commands, Program

COMMANDS: Commands = {
    "build": (build.Build, build.run),
    "refine": (refine.Refine, refine.run),
    "info": (info.Info, info.run),
    "render": (render.Render, render.run),
    "view": (view.View, view.run),
    "compare": (compare.Compare, compare.run),
    "convert": (convert.Convert, convert.run),
    "export": (export.Export, export.run),
    "demo": (demo.Demo, demo.run),
    "doctor": (doctor.Doctor, doctor.run),
    "completion": (completion.Completion, completion.run),
}

_DESCRIPTION = """\
Level of detail for 3D Gaussian Splatting, in four steps:
    v3dg build donut.ply               makes clusters at halving levels of detail
    v3dg render donut.v3dg --views 8   draws those that are just detailed enough
    v3dg view donut.v3dg               shows it in a web browser
    v3dg compare donut.ply donut.v3dg  measures the loss of quality

No asset at hand? `v3dg demo` makes one. `v3dg doctor` says what is installed and what is missing.
`v3dg COMMAND --help` has the options, `v3dg --version` prints the version.
"""

_PROGRAM = Program("v3dg", _DESCRIPTION, COMMANDS)
parse = _PROGRAM.parse
main = _PROGRAM.main
