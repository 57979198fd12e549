"""The `drakerock` command with the stand-in of `study_work` in place of the simulation."""

if __name__ == "__main__":  # the workers import this file, and do not need what the runner needs
    from drakerock.cli import main
    from drakerock.study import runner

    runner.run_study.__kwdefaults__["work"] = "study_work:run"
    main()
