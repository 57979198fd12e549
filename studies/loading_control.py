"""`drakerock study run studies/loading_control.yaml` through the Python API: run, fit, Pareto front, strategy."""

from pathlib import Path

from drakerock import Surrogate, choose_strategy, load_study, pareto_front, run_study
from drakerock.exploration.table import ResponseTable


def main() -> None:
    study = load_study(Path(__file__).with_suffix(".yaml"))
    folder = Path("out") / study.name
    run_study(study, folder)  # interrupted and run again, it goes on

    table = ResponseTable.load(folder)
    samples = table.select("sample")
    exploration = study.exploration
    surrogate = Surrogate(table.problem, exploration.surrogate, study.seed)
    surrogate.fit(samples.X, samples.Y, samples.noise)
    front = pareto_front(surrogate, config=exploration.pareto, seed=study.seed)
    print(choose_strategy(front).to_text())
    print(choose_strategy(front, {table.problem.objective_names[0]: 0.6, "damage": 0.4}).to_text())


# Workers import this file; only the main process runs the study.
if __name__ == "__main__":
    main()
