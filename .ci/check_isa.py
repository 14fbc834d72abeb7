"""Checks that the compiled module runs on every x86-64 processor.

Some sources are compiled once per instruction set, and every object file contains
copies of the inline functions that it uses. The linker keeps one of the copies. If it
kept one that is compiled for AVX, code for all processors would call it. So this script
checks that no function outside of the namespaces isa_avx2 and isa_avx512 reaches a
function with instructions beyond the baseline of x86-64.

    python .ci/check_isa.py build/*/_core*.so      (not stripped)
"""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import dataclass, field

FUNCTION = re.compile(r"^([0-9a-f]+) <(.*)>:$")
TARGET = re.compile(r"\b([0-9a-f]+) <")
# The names of VEX and EVEX instructions begin with v, as do those of two older
# instructions. Those of instructions on AVX-512 masks begin with k. The rest is BMI.
WIDE = re.compile(
    r"^(v(?!er[rw]\b)|k(add|and|mov|not|or|shift|test|unpck|xnor|xor)"
    r"|(andn|bextr|blsi|blsr|blsmsk|bzhi|mulx|pdep|pext|rorx|sarx|shlx|shrx|movbe|lzcnt|popcnt)\b)"
)


@dataclass
class Function:
    name: str
    wide: list[str] = field(default_factory=list)
    targets: set[str] = field(default_factory=set)

    @property
    def is_dispatched(self) -> bool:
        return "isa_avx2" in self.name or "isa_avx512" in self.name


def disassemble(path: str) -> dict[str, Function]:
    """Return all functions by their addresses, in hexadecimal without leading zeros."""
    command = ["objdump", "-d", "-C", "-w", "--no-show-raw-insn", path]
    functions: dict[str, Function] = {}
    function = Function("")
    for line in subprocess.run(
        command, check=True, capture_output=True, text=True
    ).stdout.splitlines():
        if match := FUNCTION.match(line):
            function = functions[match[1].lstrip("0")] = Function(match[2])
        elif "\t" in line:
            instruction = line.split("\t", 1)[1].strip()
            if WIDE.match(instruction):
                function.wide.append(instruction)
            function.targets.update(TARGET.findall(instruction))
    return functions


def main(path: str) -> int:
    functions = disassemble(path)
    if not any("v3dg::" in function.name for function in functions.values()):
        print(
            f"{path}: expected a module with symbols, got a stripped one; take the one in the "
            "build folder"
        )
        return 1
    dispatched = sum(function.is_dispatched for function in functions.values())
    # Functions that no instruction refers to are called through tables or from outside.
    called = {t for address, f in functions.items() for t in f.targets if t != address}
    todo = [
        address for address, f in functions.items() if address not in called and not f.is_dispatched
    ]
    caller = dict.fromkeys(todo, "")
    wrong = 0
    while todo:
        address = todo.pop()
        function = functions[address]
        if function.wide:
            wrong += 1
            print(
                f"{function.name}\n    holds {function.wide[0]!r}\n    called by {caller[address]}"
            )
            continue
        for target in function.targets:
            if target in functions and target not in caller and not functions[target].is_dispatched:
                caller[target] = function.name
                todo.append(target)
    print(
        f"{path}: {len(functions)} functions, {dispatched} in isa_avx2 or isa_avx512, "
        f"{len(caller)} reached without them, {wrong} of these hold wide instructions"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
