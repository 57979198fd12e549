"""The `drakerock` command with the stand-in of `study_work` in place of the simulation."""

from drakerock.cli import main
from drakerock.study import runner

runner.run_study.__kwdefaults__["work"] = "study_work:run"

if __name__ == "__main__":
    main()
