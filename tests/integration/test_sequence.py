from dataclasses import asdict

import numpy as np
import pytest

from drakerock.errors import InputError
from drakerock.loading.sequence import run_sequence
from drakerock.rocks.config import RocksConfig
from drakerock.rocks.contact_graph import find_loose
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.state import load_pile

N = 2


def strip(outcomes):
    return [
        {k: v for k, v in asdict(item).items() if k not in ("wall_time_s", "cpu_time_s", "ms_per_step")}
        for item in outcomes
    ]


@pytest.fixture(scope="module")
def scenario(small_scenario):
    return small_scenario.replace(**{"dynamics.rocks": "nonsmooth"})


@pytest.fixture(scope="module")
def straight(scenario, tmp_path_factory):
    folder = tmp_path_factory.mktemp("straight")
    return folder, run_sequence(scenario, N, folder)


def test_rocks_are_neither_lost_nor_made(straight):
    folder, outcomes = straight
    assert len(outcomes) == N
    before = load_pile(folder / "loading_00" / "pile_before.npz")
    for number in range(N):
        pile = load_pile(folder / f"loading_{number:02d}" / "pile_next.npz")
        assert np.array_equal(np.sort(pile.size), np.sort(before.size))
        assert np.array_equal(np.sort(pile.shape), np.sort(before.shape))
        assert pile.p_WRs[:, 2].min() > 0


def test_each_loading_starts_from_the_refilled_pile(straight):
    folder, _ = straight
    for number in range(N - 1):
        following = load_pile(folder / f"loading_{number:02d}" / "pile_next.npz")
        start = load_pile(folder / f"loading_{number + 1:02d}" / "pile_before.npz")
        assert np.array_equal(following.p_WRs, start.p_WRs)


def test_interrupted_sequence_ends_with_the_same_bits(scenario, straight, tmp_path):
    class Stop(Exception):
        pass

    def stop_in_the_second(number, stage, time):
        if number == 1 and time > 1.0:
            raise Stop

    with pytest.raises(Stop):
        run_sequence(scenario, N, tmp_path, progress=stop_in_the_second)
    assert (tmp_path / "loading_00" / "outcome.json").exists()
    assert not (tmp_path / "loading_01" / "outcome.json").exists()
    stamp = (tmp_path / "loading_00" / "outcome.json").stat().st_mtime_ns
    outcomes = run_sequence(scenario, N, tmp_path)
    assert (tmp_path / "loading_00" / "outcome.json").stat().st_mtime_ns == stamp
    folder, expected = straight
    assert strip(outcomes) == strip(expected)
    last = f"loading_{N - 1:02d}/pile_next.npz"
    assert np.array_equal(load_pile(tmp_path / last).p_WRs, load_pile(folder / last).p_WRs)


def test_folder_of_another_scenario_is_refused(scenario, straight):
    folder, _ = straight
    other = scenario.replace(seed=99)
    with pytest.raises(InputError, match="another scenario"):
        run_sequence(other, 1, folder)


def test_a_failed_loading_is_the_last(scenario, tmp_path):
    def fail_in_the_second(number, stage, time):
        if number == 1 and stage != "refill" and time > 1.0:
            raise RuntimeError("the solver failed to converge")

    outcomes = run_sequence(scenario, N + 1, tmp_path, progress=fail_in_the_second)
    assert [item.status for item in outcomes] == ["done", "failed"]
    assert not (tmp_path / "loading_02").exists()
    # Resumed, it ends in the same place.
    assert strip(run_sequence(scenario, N + 1, tmp_path)) == strip(outcomes)


def test_what_the_bucket_took_is_cleared_away_though_it_spilled(straight):
    folder, _ = straight
    pile = load_pile(folder / "loading_00" / "pile_next.npz")
    loose = find_loose(pile, load_rock_shapes(RocksConfig()), 0.005)
    assert not np.any(loose & (pile.p_WRs[:, 0] < -4.0))
