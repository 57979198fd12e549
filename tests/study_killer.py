"""Runs a study in forked children and kills each with SIGKILL at a random moment, until the study is complete.
After every fifth kill it is packed, and gone on with where it was unpacked.

Forking a process that has imported everything makes hundreds of kills a matter of seconds.

    python study_killer.py STUDY.yaml DIR N_KILLS SEED LONGEST_SECONDS
"""

import json
import os
import random
import shutil
import signal
import sys
import time

from drakerock.exploration import sampling  # noqa: F401 - imported before the forks
from drakerock.study.packing import pack_study, unpack_study
from drakerock.study.runner import run_study
from drakerock.study.schema import load_study


def main() -> None:
    study, folder, n_kills, seed, longest = sys.argv[1:]
    config = load_study(study)
    rng = random.Random(int(seed))
    kills, moves = 0, 0
    while True:
        if moves >= 5 and os.path.exists(os.path.join(folder, "study.json")):
            # Carried elsewhere, and back under its name.
            moves = 0
            pack_study(folder, "packed.tar.xz")
            shutil.rmtree(folder)
            unpack_study("packed.tar.xz", folder)
        child = os.fork()
        if child == 0:
            try:
                run_study(config, folder, work="study_work:run")
                os._exit(0)
            except BaseException as error:  # whatever it is, the test has to see it
                print(type(error).__name__, error, file=sys.stderr, flush=True)
                os._exit(1)
        deadline = (
            time.monotonic() + rng.uniform(0.0, float(longest)) if kills < int(n_kills) else float("inf")
        )
        while True:
            pid, status = os.waitpid(child, os.WNOHANG)
            if pid:
                break
            if time.monotonic() >= deadline:
                os.kill(child, signal.SIGKILL)
                kills += 1
                moves += 1
                deadline = float("inf")
            time.sleep(0.0005)
        if os.WIFEXITED(status):
            code = os.WEXITSTATUS(status)
            if code or kills >= int(n_kills):
                print(json.dumps({"kills": kills, "code": code}))
                sys.exit(code)


main()
