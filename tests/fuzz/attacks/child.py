"""A child process of pool.py. It performs the tries whose numbers it reads from stdin,
and reports their outcomes on stdout.

child.py KIND SEED SHARED          prepares, and prints the seconds that a try may take
child.py KIND SEED SHARED WORK     does tries
"""

import contextlib
import faulthandler
import importlib
import json
import os
import random
import shutil
import sys
import time
from pathlib import Path

from fuzz.attacks.memory_use import Watch


def main():
    kind, seed, shared, *work = sys.argv[1:]
    module = importlib.import_module(f"fuzz.attacks.{kind}")
    if not work:
        with contextlib.redirect_stdout(sys.stderr):
            module.prepare(Path(shared))
        print(module.LIMIT_S)
        return
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # other output is not mixed with it
    work = Path(work[0])
    attack = module.Attack(Path(shared))
    for line in sys.stdin:
        number = int(line)
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir()
        os.ftruncate(2, 0)
        os.lseek(2, 0, os.SEEK_SET)
        attack.number = number  # for kinds that take their tries from a list
        what, do = attack.plan(random.Random(f"{kind} {seed} {number}"), work)
        print(json.dumps({"what": what}), file=answers, flush=True)
        faulthandler.dump_traceback_later(module.LIMIT_S, exit=True)
        watch, start = Watch(), time.perf_counter()
        outcome = do()
        seconds = time.perf_counter() - start
        faulthandler.cancel_dump_traceback_later()
        record = {
            "what": what,
            "outcome": outcome.name,
            "fault": outcome.fault,
            "is_low": outcome.is_low,
            "megabytes": max(outcome.megabytes, watch.megabytes()),
            "seconds": seconds,
        }
        print(json.dumps(record), file=answers, flush=True)


if __name__ == "__main__":
    faulthandler.enable()
    main()
