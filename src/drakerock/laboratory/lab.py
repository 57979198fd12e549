"""The tests by name, and the running of one: its specimens, its table."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from math import isfinite

from drakerock.config import parse_config
from drakerock.errors import InputError
from drakerock.identity import get_versions
from drakerock.laboratory.beds import MakeRig
from drakerock.laboratory.config import LabSettings
from drakerock.laboratory.discharge import DischargeTest
from drakerock.laboratory.drag import DragTest
from drakerock.laboratory.interface import MaterialTest
from drakerock.laboratory.material import Material
from drakerock.laboratory.penetration import PenetrationTest
from drakerock.laboratory.repose import ReposeTest
from drakerock.laboratory.results import LabResult
from drakerock.laboratory.rig import DrakeRig
from drakerock.laboratory.settlement import SettlementTest
from drakerock.laboratory.shear import ShearTest
from drakerock.laboratory.silo import SiloTest
from drakerock.randomness import derive_seed

TESTS: dict[str, MaterialTest] = {
    test.name: test
    for test in (
        ReposeTest(),
        ShearTest(),
        DischargeTest(),
        SiloTest(),
        SettlementTest(),
        PenetrationTest("plate", "Penetration of a plate into a slope"),
        PenetrationTest("bucket", "Penetration of a bucket into a slope"),
        DragTest(),
    )
}
"""All tests, by name."""


def find_test(name: str) -> MaterialTest:
    """Return the test of a name.

    Raises:
        InputError: there is none.
    """
    if name not in TESTS:
        raise InputError(f"lab: there is no test '{name}'; there are {', '.join(TESTS)}")
    return TESTS[name]


def make_settings(test: MaterialTest, overrides: Sequence[str] = ()) -> LabSettings:
    """Return a test's settings.

    Args:
        test: which.
        overrides: ``"key=value"`` strings on top of the defaults.

    Raises:
        InputError: an unknown key, or a value that is not allowed.
    """
    return parse_config("", test.settings, overrides, source=f"lab {test.name}")


def run_test(
    test: MaterialTest,
    material: Material,
    settings: LabSettings,
    seed: int,
    progress: Callable[[str, float], None] | None = None,
    make_rig: MakeRig = DrakeRig,
) -> LabResult:
    """Test a material.

    Args:
        test: which.
        material: the rocks.
        settings: of the test.
        seed: specimens follow from it and their number: the same rocks for every engine.
        progress: called with what is being done and its share done.
        make_rig: the engine; drakerock's own by default.

    Raises:
        InputError: too few rocks for their sizes.
        SimulationFailure: the dynamics failed.
    """
    started = time.process_time()
    specimens, times = [], []
    for number in range(settings.repeats):
        if progress:
            progress(test.name, number / settings.repeats)
        before = time.process_time()
        specimens.append(test.measure(material, settings, derive_seed(seed, "lab", number) % 2**31, make_rig))
        times.append(round(time.process_time() - before, 1))
    rows, panels = test.evaluate(specimens, material, settings)
    facts = {
        "settings": settings.model_dump(mode="json"),
        "seed": seed,
        "rocks": material.config.model_dump(mode="json"),
        "dynamics": material.dynamics.model_dump(mode="json"),
        "mean_size_m": material.mean_size,
        "versions": get_versions(),
        "cpu_s": round(time.process_time() - started, 1),
        "specimen_cpu_s": times,
        "specimens": [
            {key: float(f"{value:.6g}") if isfinite(value) else None for key, value in one.values.items()}
            for one in specimens
        ],
    }
    snapshots = tuple(one.snapshot for one in specimens if one.snapshot is not None)
    return LabResult(test.name, test.title, rows, panels, snapshots, facts)
