"""The errors of float32 against float64 in the cases of tests/support/hard_cases.py:
histograms, and the table of docs/numerics.md.

    python -m benchmarks.studies.hard_cases --device cpu \\
        --output benchmarks/results/hard_cases_cpu.json
    python -m benchmarks.studies.hard_cases --device cuda \\
        --output benchmarks/results/hard_cases_h200.json
    python -m benchmarks.studies.hard_cases --docs

The last command writes the table again from the two results, without measuring.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from benchmarks.evaluation import record

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))
sys.path.insert(0, str(ROOT / "tests" / "support"))

import hard_cases as cases  # noqa: E402  (a module of the tests)

DECADES = (1e-7, 1e-6, 1e-5, 1e-4)
DOCS = ROOT / "docs" / "numerics.md"
RESULTS = {"CPU": "hard_cases_cpu.json", "H200": "hard_cases_h200.json"}
BEGIN = "<!-- hard cases: benchmarks/studies/hard_cases.py -->\n"
END = "<!-- end of hard cases -->\n"


@dataclass
class Config:
    device: Literal["cpu", "cuda"] = "cpu"
    output: str | None = None
    docs: bool = False
    """Write the table of docs/numerics.md from the recorded results, without
    measuring."""


def histogram(errors: np.ndarray) -> dict[str, Any]:
    """Return the percentages of errors up to each decade and beyond the last one, and
    the largest error."""
    counts = np.bincount(np.searchsorted(DECADES, errors.ravel()), minlength=len(DECADES) + 1)
    shares = 100 * counts / max(errors.size, 1)
    return {"percent": shares.round(2).tolist(), "largest": float(f"{errors.max(initial=0.0):.1e}")}


def gradient_histogram(case: cases.HardCase, device: str) -> dict[str, Any]:
    """Return a histogram of the errors of the gradients of drawn gaussians.

    Gradients are derivatives by relative changes of the inputs. Errors are relative to
    the root mean square gradient of each input.
    """
    import torch

    single = cases.gradients(case, cases.draw_core, torch.float32, device)
    double = cases.gradients(case, cases.draw_core, torch.float64)
    drawn = cases.drawn_rows(case)
    single, double = ([r[drawn] for r in cases.relative_changes(case, g)] for g in (single, double))
    whole = np.sqrt(sum((d * d).sum() for d in double) / max(sum(d.size for d in double), 1))
    errors = []
    for s, d in zip(single, double, strict=True):
        typical = max(np.sqrt((d * d).mean()) if d.size else 0.0, 1e-6 * whole, 1e-300)
        errors.append((np.abs(s - d) / typical).ravel())
    return histogram(np.concatenate(errors))


def measure(case: cases.HardCase, device: str) -> dict[str, Any]:
    expected = cases.expected_picture(case)
    error = cases.picture_error(cases.picture(case, device), expected)
    return {"picture": histogram(error), "gradients": gradient_histogram(case, device)}


def text_of(shares: list[float]) -> str:
    """Return percentages without decimals, separated by spaces. A dot stands for a
    value above zero that rounds to zero."""
    return " ".join(f"{s:.0f}" if s >= 0.5 else "." if s > 0 else "0" for s in shares)


def table(results: dict[str, dict[str, Any]]) -> str:
    columns = [f"{part}, {device}" for device in results for part in ("picture", "gradients")]
    lines = [
        "| case | what happens, and why | bound | " + " | ".join(columns) + " |",
        "| --- | --- | --- |" + " --- |" * len(columns),
    ]
    for name, case in cases.hard_cases().items():
        cells = []
        for result in results.values():
            measured = result["cases"].get(name)
            for part in ("picture", "gradients"):
                errors = (
                    measured
                    and f"{text_of(measured[part]['percent'])} ({measured[part]['largest']:.0e})"
                )
                cells.append(errors or "not measured")
        bound = f"{case.picture.absolute:.0e}" if case.gradient else "finite"
        lines.append(f"| {name} | {case.what} | {bound} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def write_docs() -> None:
    paths = {device: ROOT / "benchmarks" / "results" / name for device, name in RESULTS.items()}
    results = {
        device: json.loads(path.read_text()) for device, path in paths.items() if path.exists()
    }
    before, rest = DOCS.read_text().split(BEGIN)
    _, after = rest.split(END)
    DOCS.write_text(before + BEGIN + "\n" + table(results) + "\n" + END + after)


def main(config: Config) -> None:
    if config.docs:
        write_docs()
        return
    measured = {}
    for name, case in cases.hard_cases().items():
        measured[name] = measure(case, config.device)
        print(
            f"{name:36}", *(f"{m['percent']} {m['largest']:.0e}" for m in measured[name].values())
        )
    record.write(config.output, {"decades": DECADES, "cases": measured}, config.device)


if __name__ == "__main__":
    main(tyro.cli(Config))
