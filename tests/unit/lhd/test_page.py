from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform

from drakerock.lhd.checks.page import _make_tour, write_machine_page
from drakerock.lhd.config import MachineConfig
from drakerock.lhd.kinematics import calc_bucket_range
from drakerock.lhd.placement import set_machine_angles
from tests.browsers import visit


def test_tour_stays_in_the_workspace_and_meets_its_corners(kin):
    tour = _make_tour(kin)
    _x, phi_l, phi_b = tour.T
    low, high = calc_bucket_range(kin, phi_l)
    assert np.all((phi_b > low) & (phi_b < high))
    assert np.allclose([phi_l.min(), phi_l.max()], kin.phi_l_range, atol=2e-3)
    assert np.abs(np.diff(tour, axis=0)).max() < 0.2, "no jumps"
    assert np.allclose(tour[0], tour[-1], atol=0.01)


# Where a body is drawn at times of the animation; what the camera sees of the machine.
LOOK = """(() => {
  const machine = viewer.scene_tree.find(["drake", "visualizer", "lhd"]).object;
  viewer.scene.updateMatrixWorld(true);
  const place = (name) => machine.getObjectByName(name).matrixWorld.elements.slice(12, 15);
  const box = [], p = machine.position.clone();
  machine.traverse((part) => {
    if (part.isMesh) { p.setFromMatrixPosition(part.matrixWorld).project(viewer.camera); box.push([p.x, p.y]); }
  });
  return { bucket: place("bucket"), boom: place("boom"), box, duration: viewer.animator.duration,
    playing: viewer.animator.playing };
})()"""


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return write_machine_page(MachineConfig(), tmp_path_factory.mktemp("page") / "new" / "machine.html")


def test_page_plays_the_tour_in_a_browser(file, build, kin):
    """Bodies are drawn where the plant has them, at any time; the machine fills the picture and stays in it."""
    tour = _make_tour(kin)
    steps = {"first": "", "stopped": "viewer.animator.pause()"}
    steps |= {str(k): f"viewer.animator.seek({k} / 25)" for k in (50, 150, 250)}
    seen = visit(
        file,
        steps | {"played": "viewer.animator.play()"},
        LOOK,
        ready="viewer.animator.duration && viewer.scene_tree.find(['drake']).object.getObjectByName('bucket')",
    )
    assert seen["faults"] == []
    assert seen["first"]["playing"]
    assert not seen["stopped"]["playing"]
    assert seen["played"]["playing"]
    assert seen["first"]["duration"] == pytest.approx((len(tour) - 1) / 25)
    diagram, plant, _, machine = build()
    context = plant.GetMyMutableContextFromRoot(diagram.CreateDefaultContext())
    for k in (50, 150, 250):
        x, phi_l, phi_b = tour[k]
        set_machine_angles(plant, context, machine, phi_l=phi_l, phi_b=phi_b, kin=kin)
        front = plant.GetBodyByName("front_unit", machine.instance)
        plant.SetFreeBodyPose(context, front, RigidTransform(np.array([x, 0.0, kin.wheel_radius])))
        for name in ("bucket", "boom"):
            body = plant.GetBodyByName(name, machine.instance)
            p_WBo = plant.EvalBodyPoseInWorld(context, body).translation()
            # Meshcat's y is up: (x, y, z) of the world is drawn at (x, z, -y).
            drawn = np.array(seen[str(k)][name])
            np.testing.assert_allclose([drawn[0], -drawn[2], drawn[1]], p_WBo, atol=1e-3)
        box = np.array(seen[str(k)]["box"])
        assert np.abs(box).max() < 1.0, "all of it is in the picture"
        assert np.ptp(box[:, 0]) > 0.5, "and fills a quarter of its width at least"


def test_page_is_one_file_with_an_animation(file):
    assert file.read_text(encoding="utf-8").lstrip().lower().startswith("<!doctype html>")
    assert 1e6 < file.stat().st_size < 8e6
