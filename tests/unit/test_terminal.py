"""What the terminal shows of a loading."""

from types import SimpleNamespace

import pytest

from drakerock import terminal

OUTCOME = SimpleNamespace(
    strategy={"alpha": 1.2, "beta": 0.9, "gamma": 0.5, "kappa": 0.8},
    status="done",
    reason="s4 reached",
    objectives={"production": 731.0, "damage": 0.59, "debris": 700.0},
    mining={"load_t": 7.19, "payload_percent": 34.2, "fill_factor": 0.62},
    bucket_mass_kg=7190.0,
    bucket_rocks=32,
    counted_when_weighed_kg=7190.0,
    weighed_mass_kg=7269.0,
    loading_time_s=9.83,
    waypoint_times_s=(1.0, 2.0, 3.0, 4.0, 5.0),
    plan={},
    mean_push_force_N=3e5,
    peak_push_force_N=7e5,
    energy_J=1.7e6,
    events=[],
    rocks={
        "total": 60,
        "awake_mean": 5,
        "awake_max": 9,
        "lost": 0,
        "penetration_max_m": 0.01,
        "flagged_steps": 0,
    },
    wall_time_s=1.0,
    sim_time_s=2.0,
    ms_per_step=3.0,
)


@pytest.mark.parametrize("mining", [OUTCOME.mining, None])
def test_a_loading_begins_with_what_a_mine_reads(capsys, mining):
    terminal.print_outcome(SimpleNamespace(**vars(OUTCOME) | {"mining": mining}))
    lines = [line.split("│")[1:3] for line in capsys.readouterr().out.splitlines() if "│" in line]
    labels = [label.strip() for label, _ in lines if label.strip()]
    assert labels[2:6] == ["load", "fill factor", "loading time t4 - t0", "production"]
    assert len(labels) == len(set(labels))
    assert ("7.19 t, 34 %" in lines[2][1]) == (mining is not None)
