"""The command `python -m benchmarks COMMAND`, which runs in the root of a checkout."""

import sys

from benchmarks.evaluation import command as evaluate
from benchmarks.evaluation import report
from benchmarks.worlds import command as world
from v3dg.cli._program import Program

DESCRIPTION = """\
What v3dg is measured with:
    python -m benchmarks evaluate       measures speed against error, beside peers
    python -m benchmarks report FOLDER  makes a page of what was measured
    python -m benchmarks world forest   makes a world: assets, bundles, a scene with 400 cameras

One operation: `python -m benchmarks.ops.bench_<operation>`.
"""

PROGRAM = Program(
    "python -m benchmarks",
    DESCRIPTION,
    {
        "evaluate": (evaluate.Evaluate, evaluate.run),
        "report": (report.Report, report.run),
        "world": (world.World, world.run),
    },
)

if __name__ == "__main__":
    sys.exit(PROGRAM.main())
