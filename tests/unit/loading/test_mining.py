"""The numbers of mining against closed forms of made signals."""

import numpy as np
import pytest

from drakerock.exploration.problem import OWN_COLUMNS
from drakerock.loading.mining import MINING, MachineRating, calc_mining_numbers, describe_mining

RATING = MachineRating(payload=20e3, capacity=8.0, loose_density=1500.0, wheel_radius=0.5, bucket_effort=8e5)
TIMES = np.array([1.0, 3.0, 5.0, 6.0, 9.0])
TIME = np.arange(0.0, 10.0, 0.01)


def make_signals():
    """36 MJ/h of power throughout; torque of the wheels rises from 0 at 0 s to 1e5 N m at 10 s; 0.2 m/s of slip."""
    torque = np.where((TIME > 4.0) & (TIME < 5.5), -6e5, 1e5)
    torque = np.where(TIME > 6.5, 9e5, torque)
    return {
        "time": TIME,
        "work": 1e4 * TIME,
        "torque_wheels": 1e4 * TIME,
        "torque_bucket": torque,
        "wheel_slip": np.where(TIME < 4.0, 0.2, -0.2),
    }


def test_numbers_of_a_made_loading():
    numbers = calc_mining_numbers(make_signals(), TIMES, 12e3, 3e3, RATING)
    assert numbers == pytest.approx(
        {
            "load_t": 12.0,
            "payload_percent": 60.0,
            "fill_factor": 1.0,
            "bucket_phase_kWh_per_t": 5e4 / 3.6e6 / 12.0,
            "loading_kWh_per_t": 8e4 / 3.6e6 / 12.0,
            # Means and sums over [t0, t2) of what rises evenly.
            "tractive_effort_mean_N": 2e4 * 2.995,
            "tractive_effort_peak_N": 2e4 * 4.99,
            "wheel_slip_m": 8.0 * 0.2,
            "breakout_use": 0.75,
            "spillage_share": 0.2,
        }
    )
    assert list(numbers) == list(MINING)


def test_an_empty_bucket_has_no_energy_per_tonne():
    numbers = calc_mining_numbers(make_signals(), TIMES, 0.0, 0.0, RATING)
    assert (numbers["load_t"], numbers["payload_percent"], numbers["fill_factor"]) == (0.0, 0.0, 0.0)
    assert numbers["bucket_phase_kWh_per_t"] is None
    assert numbers["loading_kWh_per_t"] is None
    assert numbers["spillage_share"] is None
    assert numbers["wheel_slip_m"] == pytest.approx(1.6)
    assert calc_mining_numbers(make_signals(), TIMES, 0.0, 5.0, RATING)["spillage_share"] == 1.0


def test_a_loading_that_was_not_driven_has_load_and_spillage_only():
    numbers = calc_mining_numbers(make_signals(), np.full(5, np.nan), 0.0, 0.0, RATING)
    assert {name for name, value in numbers.items() if value is not None} == {
        "load_t",
        "payload_percent",
        "fill_factor",
    }


def test_what_people_read():
    text = dict(describe_mining(calc_mining_numbers(make_signals(), TIMES, 12e3, 3e3, RATING)))
    assert text["load"] == "12.00 t, 60 % of the payload"
    assert text["tractive effort mean, peak"] == "60, 100 kN"
    assert text["spillage"] == "20.0 % of load and debris"
    assert dict(describe_mining({}))["breakout use"] == "-"


def test_no_objective_can_take_their_columns():
    assert set(MINING) <= set(OWN_COLUMNS)
