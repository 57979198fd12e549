"""Cut a loading of a study down to the data that `read_cycle.ipynb` is shown with.

They are of `studies/reduced.yaml` in short (28 + 6 points of 2 loadings, everything kept):

    drakerock study run studies/reduced.yaml --out out/short --set loadings=2 --set storage.keep=everything \
        --set exploration.sampling.n_initial=16 --set exploration.sampling.n_corners=8 \
        --set exploration.sampling.n_samples=28 --set exploration.sampling.n_validation=6
    python notebooks/make_data.py out/short points/s0003/attempt_0/loading_01
"""

import shutil
import sys
from pathlib import Path

from drakerock.loading.signal_table import load_signals, save_signals

EVERY = 4  # steps, of 0.01 s


def main() -> None:
    cycle = Path(sys.argv[1], sys.argv[2])
    data = Path(__file__).with_name("data")
    (data / "cycle").mkdir(parents=True, exist_ok=True)
    for name in ("outcome.json", "plan.json", "scenario.json"):
        shutil.copy(cycle / name, data / "cycle")
    columns, units = load_signals(cycle / "signals.parquet")
    thinned = {name: values[::EVERY] for name, values in columns.items()}
    save_signals(thinned, units, data / "cycle" / "signals.parquet")


main()
