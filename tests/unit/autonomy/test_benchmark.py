"""Contract: the evaluation's piles are scenarios, and its table tells paired differences of what is stored."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

from drakerock.loading.scenario import load_scenario

PATH = Path(__file__).resolve().parents[3] / "benchmarks" / "autonomy.py"


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("autonomy_benchmark", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def dug(benchmark, monkeypatch):
    """What is asked to be dug, instead of digging it."""
    asked = []
    monkeypatch.setattr(benchmark, "run_sequence", lambda *args: asked.append(args))
    return asked


def test_piles_are_scenarios_of_seeds_of_their_own(benchmark, dug, tmp_path):
    base = load_scenario()
    seeds = [benchmark.make_start(base, pile, tmp_path).seed for pile in benchmark.PILES]
    assert len(set(seeds)) == len(seeds) >= 10
    assert base.seed not in seeds
    assert 0 not in seeds
    assert max(item.size_m for item in base.replace(**benchmark.PILES["coarse_26"]).rocks.gradation) == 1.0


def test_an_uneven_pile_is_one_that_was_dug_at_its_rear_most_place(benchmark, dug, tmp_path):
    base = load_scenario()
    start = benchmark.make_start(base, "uneven_28", tmp_path)
    ((digging, n, folder),) = dug
    assert (digging.loading.strategy.gamma, n) == (0.0, 4)
    assert start.pile.source == str(folder / "loading_03" / "pile_next.npz")
    assert start.loading.strategy == base.loading.strategy


def write(folder, choice, pile, productions, failed=()):
    for n, production in enumerate(productions):
        place = folder / "runs" / pile / choice / f"loading_{n:02d}"
        place.mkdir(parents=True)
        lost = n in failed
        outcome = {
            "status": "failed" if lost else "done",
            "objectives": dict.fromkeys(("production", "damage", "debris"))
            if lost
            else {"production": production, "damage": 0.5, "debris": 100.0},
            "bucket_mass_kg": None if lost else 10.0 * production, "energy_J": 1e6, "loading_time_s": 10.0,
            "mining": None if lost else {"wheel_slip_m": 1.0},
        }  # fmt: skip
        (place / "outcome.json").write_text(json.dumps(outcome))
        (place / "decision.json").write_text(json.dumps({"fell_back": n == 1, "cleaned_kg": None}))


def test_differences_are_paired_by_pile(benchmark, tmp_path):
    """Piles differ by far more than choices do: only the pairs show the difference."""
    for k, level in enumerate((100.0, 500.0, 900.0, 1300.0)):
        write(tmp_path, "best_fixed", f"pile_{k}", [level, level + 20.0])
        write(tmp_path, "field", f"pile_{k}", [level + 10.0, level + 30.0 + k])
    table = benchmark.make_table(tmp_path)
    assert table["best_fixed"]["production"] == pytest.approx(710.0)
    mean, low, high = table["field"]["production_difference"]
    assert mean == pytest.approx(10.75)
    assert 10.0 <= low < mean < high <= 11.5
    assert table["field"]["J_per_kg"] < table["best_fixed"]["J_per_kg"]
    assert table["field"]["fell_back"] == 4
    assert "production_difference" not in table["best_fixed"]
    benchmark.write_table(tmp_path)
    assert (tmp_path / "table.png").stat().st_size > 5000
    assert "(+10.8, +10" in (tmp_path / "table.md").read_text()


def test_failed_loadings_are_counted_and_left_out_of_means(benchmark, tmp_path):
    write(tmp_path, "field", "pile_0", [100.0, 999.0], failed=(1,))
    entry = benchmark.make_table(tmp_path)["field"]
    assert entry["failed"] == 1
    assert entry["production"] == 100.0


def test_few_piles_have_no_interval(benchmark):
    import numpy as np

    assert benchmark.calc_interval(np.array([1.0, 3.0])) == [2.0, None, None]
    assert benchmark.calc_interval(np.array([np.nan])) == [None, None, None]
