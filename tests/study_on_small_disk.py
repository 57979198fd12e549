"""Runs a study on a file system that is too small for it, and again once that is larger; says how each run ended.

    python study_on_small_disk.py STUDY.yaml DIR SMALL LARGE

To be run as root of a namespace of its own (``unshare -rm``); exit code 77: no file system could be mounted. DIR is
copied to ``kept`` beside it, as the file system ends with the namespace.
"""

import os
import shutil
import subprocess
import sys

from drakerock.cli import main
from drakerock.exploration import sampling  # noqa: F401 - imported before the forks
from drakerock.study import runner

runner.run_study.__kwdefaults__["work"] = "study_work:run"


def run(study: str, folder: str) -> int:
    """Run the command in a forked child; return its exit code."""
    child = os.fork()
    if child == 0:
        code: object = 1
        try:
            sys.argv = ["drakerock", "study", "run", study, "--out", folder, "--set", "executor.kind=serial"]
            main()
        except SystemExit as ended:
            code = ended.code or 0
        finally:
            sys.stderr.flush()
            os._exit(code if isinstance(code, int) else 1)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


if __name__ == "__main__":
    study, folder, small, large = sys.argv[1:]
    if subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={small}", "tmpfs", folder]).returncode:
        sys.exit(77)
    first = run(study, folder)
    subprocess.run(["mount", "-o", f"remount,size={large}", folder], check=True)
    second = run(study, folder)
    shutil.copytree(folder, os.path.join(os.path.dirname(folder), "kept"))
    print("ended with", first, second)
