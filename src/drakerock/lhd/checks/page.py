"""An interactive page of the machine moving through its workspace."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams, MeshcatVisualizer, MeshcatVisualizerParams, Role
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.systems.framework import DiagramBuilder

from drakerock.files import make_folder, write_text
from drakerock.lhd import names
from drakerock.lhd.config import MachineConfig
from drakerock.lhd.kinematics import Kinematics, calc_bucket_range, calc_joint_angles, make_kinematics
from drakerock.lhd.model import add_machine
from drakerock.lhd.placement import set_machine_angles

Array = np.ndarray

_FRAMES_PER_SECOND = 25.0


def write_machine_page(config: MachineConfig, path: str | Path, *, contact_shapes: bool = False) -> Path:
    """Write a self-contained HTML page: the machine goes round the border of its workspace.

    Args:
        config: the machine.
        path: the HTML file.
        contact_shapes: show the contact shapes in place of the looks.

    Returns:
        The file.

    Raises:
        InputError: the machine's SDFormat file is not usable.
    """
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.01), builder)
    machine = add_machine(plant, config)
    plant.Finalize()
    kin = make_kinematics(plant, machine)

    meshcat = Meshcat(MeshcatParams(port=None, show_stats_plot=False))
    role = Role.kProximity if contact_shapes else Role.kIllustration
    visualizer = MeshcatVisualizer.AddToBuilder(
        builder,
        scene_graph,
        meshcat,
        MeshcatVisualizerParams(role=role, publish_period=1 / _FRAMES_PER_SECOND),
    )
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)

    front = plant.GetBodyByName("front_unit", machine.instance)
    wheels = [plant.GetJointByName(joint, machine.instance) for joint in names.WHEEL_JOINTS]
    eye = 2.2 * (kin.boom_length + kin.bucket_length)
    meshcat.SetCameraPose(
        np.array([0.36 * eye, -0.64 * eye, 0.28 * eye]), np.array([-0.14 * eye, 0.0, 0.22 * eye])
    )

    visualizer.StartRecording(set_transforms_while_recording=False)
    for k, (x, phi_l, phi_b) in enumerate(_make_tour(kin)):
        set_machine_angles(plant, context, machine, phi_l=phi_l, phi_b=phi_b, kin=kin)
        for wheel in wheels:
            wheel.set_angle(context, x / kin.wheel_radius)
        X_WF = RigidTransform(np.array([x, 0.0, kin.wheel_radius]))
        plant.SetFreeBodyPose(context, front, X_WF)
        # Meshcat rounds a time down to a frame: without the hair, k / 25 may come out as the frame before.
        root.SetTime((k + 1e-6) / _FRAMES_PER_SECOND)
        diagram.ForcedPublish(root)
    visualizer.StopRecording()
    visualizer.PublishRecording()

    path = Path(path)
    make_folder(path.parent)
    write_text(path, meshcat.StaticHtml())
    return path


def _make_tour(kin: Kinematics) -> Array:
    """Return rows (x of the front axle, phi_l, phi_b): forward, round the workspace's border, back."""
    inset = 1e-3
    level_l, level_b = (float(angle) for angle in calc_joint_angles(kin, 0.0, 0.0))
    top, bottom = kin.phi_l_range[0] + inset, kin.phi_l_range[1] - inset
    rows: list[tuple[float, float, float]] = [(-2 * kin.wheel_radius, level_l, level_b)]

    level_share = _calc_share(kin, level_l, level_b)

    def go(x: float, phi_l: float, share: float, seconds: float) -> None:
        """Go on to a boom angle and a share of the bucket's range there (0 full tilt, 1 full dump)."""
        x_0, phi_l_0, phi_b_0 = rows[-1]
        share_0 = _calc_share(kin, phi_l_0, phi_b_0)
        for s in np.linspace(0, 1, round(seconds * _FRAMES_PER_SECOND) + 1)[1:]:
            s = s * s * (3 - 2 * s)
            angle = phi_l_0 + s * (phi_l - phi_l_0)
            low, high = calc_bucket_range(kin, angle)
            part = np.clip(share_0 + s * (share - share_0), 2e-3, 1 - 2e-3)
            rows.append((x_0 + s * (x - x_0), float(angle), float(low + part * (high - low))))

    go(0.0, level_l, level_share, 2.0)
    go(0.0, level_l, 0.0, 1.5)
    go(0.0, top, 0.0, 2.5)
    go(0.0, top, 1.0, 2.0)
    go(0.0, bottom, 1.0, 2.5)
    go(0.0, bottom, 0.0, 1.5)
    go(-2 * kin.wheel_radius, level_l, level_share, 2.0)
    return np.array(rows)


def _calc_share(kin: Kinematics, phi_l: float, phi_b: float) -> float:
    low, high = calc_bucket_range(kin, phi_l)
    return float((phi_b - low) / (high - low))
