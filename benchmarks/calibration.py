"""Are planted parameters found again? One simulation with known parameters is "measured", in a pile that is known, too.

    python benchmarks/calibration.py --out out/calibration

The measurement has noise, other column names and units than the simulation, uneven sampling, a gap and empty cells.
Then `drakerock calibrate` gets it, and digs in the same pile, as in one that was scanned.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from drakerock.loading.cycle import run_cycle
from drakerock.rocks.state import save_pile
from drakerock.study.calibration import run_calibration
from drakerock.study.jobs import get_pile
from drakerock.study.schema import load_study

STUDY = Path(__file__).parents[1] / "studies" / "calibration.yaml"
PLANTED = {"density": 2650.0, "stall_torque": 1.62e5}
# Standard deviations of the measured values, as the study states them.
SPEED, TORQUE, FORCE = 0.02, 5e3, 5e3


def measure(study, path):
    """Write the measurement: speed [km/h] and boom torque [kN m] over time [ms], push force [kN] over place [m]."""
    scenario = study.make_scenario(np.array([PLANTED[v.name] for v in study.variables]), "planted")
    signals = run_cycle(scenario, get_pile(scenario)).signals
    rng = np.random.default_rng(11)
    n = len(signals["time"])
    # Every seventh step or so, none for a second.
    rows = np.sort(rng.choice(n, n // 7, replace=False))
    rows = rows[(signals["time"][rows] < 4.0) | (signals["time"][rows] > 5.0)]
    noise = rng.normal(size=(3, len(rows)))
    columns = {
        "t [ms]": 1e3 * signals["time"][rows],
        "speed [km/h]": 3.6 * (signals["v_F"][rows] + SPEED * noise[0]),
        "boom torque [kNm]": 1e-3 * (signals["torque_boom"][rows] + TORQUE * noise[1]),
        "tip [m]": signals["x_T"][rows],
        "push force [kN]": 1e-3 * (signals["bucket_force_x"][rows] + FORCE * noise[2]),
    }
    lines = [";".join(columns)]
    for k in range(len(rows)):
        cells = [f"{values[k]:.6g}" for values in columns.values()]
        if rng.random() < 0.02:
            cells[2] = ""
        lines.append(";".join(cells))
    path.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/calibration"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    pile, measured = options.out / "pile.npz", options.out / "measured.csv"
    if not pile.exists():
        save_pile(get_pile(load_study(STUDY).scenario), pile)
    study = load_study(STUDY, [f"scenario.pile.source={json.dumps(str(pile.resolve()))}"])
    begin = time.process_time()
    if not measured.exists():
        measure(study, measured)
    result, paths = run_calibration(study, measured, options.out / "store", say=print)
    for name, value in PLANTED.items():
        item = result["parameters"][name]
        item["planted"], item["found"] = value, bool(item["low"] <= value <= item["high"])
    result["cpu_s"] = round(time.process_time() - begin, 1)
    print(json.dumps(result, indent=1))
    (options.out / "calibration.json").write_text(json.dumps(result, indent=1) + "\n")
