from __future__ import annotations

import numpy as np

from drakerock.lhd.checks.page import _make_tour, write_machine_page
from drakerock.lhd.config import MachineConfig
from drakerock.lhd.kinematics import calc_bucket_range


def test_tour_stays_in_the_workspace_and_meets_its_corners(kin):
    tour = _make_tour(kin)
    _x, phi_l, phi_b = tour.T
    low, high = calc_bucket_range(kin, phi_l)
    assert np.all((phi_b > low) & (phi_b < high))
    assert np.allclose([phi_l.min(), phi_l.max()], kin.phi_l_range, atol=2e-3)
    assert np.abs(np.diff(tour, axis=0)).max() < 0.2, "no jumps"
    assert np.allclose(tour[0], tour[-1], atol=0.01)


def test_page_is_one_file_with_an_animation(tmp_path):
    file = write_machine_page(MachineConfig(), tmp_path / "new" / "machine.html")
    assert file.read_text(encoding="utf-8").lstrip().lower().startswith("<!doctype html>")
    assert 1e6 < file.stat().st_size < 8e6
