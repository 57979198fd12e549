"""Writes a machine's SDFormat file and meshes from its design.yaml: python sdf/make_machine.py sdf/lhd/design.yaml."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yaml


def make_prism(points: list[list[float]], y: tuple[float, float]) -> trimesh.Trimesh:
    """Return the convex prism over a polygon of [x, z] points, from y[0] to y[1]."""
    vertices = [[x, side, z] for side in y for x, z in points]
    return trimesh.convex.convex_hull(np.array(vertices))


def make_box(box: dict[str, list[float]]) -> trimesh.Trimesh:
    """Return the box with the given x, y and z ranges."""
    return trimesh.creation.box(bounds=np.array([box["x"], box["y"], box["z"]]).T)


def calc_inertial(meshes: list[trimesh.Trimesh], mass: float, com: list[float] | None = None) -> str:
    """Return <inertial> of the meshes with one density that gives `mass`; `com` [x, z] shifts the centre."""
    volume = sum(mesh.volume for mesh in meshes)
    center = sum(mesh.volume * mesh.center_mass for mesh in meshes) / volume
    inertia = np.zeros((3, 3))
    for mesh in meshes:
        r = mesh.center_mass - center
        inertia += mesh.moment_inertia + mesh.volume * (r @ r * np.eye(3) - np.outer(r, r))
    inertia *= mass / volume
    if com is not None:
        center = np.array([com[0], 0.0, com[1]])
    xx, yy, zz = np.diag(inertia)
    return (
        f"<inertial><pose>{center[0]:.5g} {center[1]:.5g} {center[2]:.5g} 0 0 0</pose><mass>{mass:.6g}</mass>"
        f"<inertia><ixx>{xx:.6g}</ixx><iyy>{yy:.6g}</iyy><izz>{zz:.6g}</izz><ixy>{inertia[0, 1]:.6g}</ixy>"
        f"<ixz>{inertia[0, 2]:.6g}</ixz><iyz>{inertia[1, 2]:.6g}</iyz></inertia></inertial>"
    )


def write_machine(design_file: Path) -> None:
    """Write <name>.sdf and the OBJ meshes into the folder of `design_file`."""
    design: dict[str, Any] = yaml.safe_load(design_file.read_text())
    folder, name = design_file.parent, design["name"]
    lines: list[str] = []

    def mesh_geometry(mesh: trimesh.Trimesh, file: str) -> str:
        mesh.export(folder / file, digits=5, header=None)
        return f"<mesh><drake:declare_convex/><uri>package://drakerock/{name}/{file}</uri></mesh>"

    def link(body: str, pose: str, inertial: str, pieces: dict[str, str], proximity: str, color: str) -> None:
        lines.append(f'    <link name="{body}"><pose {pose}</pose>{inertial}')
        for piece, geometry in pieces.items():
            if proximity:
                lines.append(
                    f'      <collision name="{piece}"><geometry>{geometry}</geometry>'
                    f"<drake:proximity_properties>{proximity}</drake:proximity_properties></collision>"
                )
            lines.append(
                f'      <visual name="{piece}"><geometry>{geometry}</geometry>'
                f"<material><diffuse>{color}</diffuse></material></visual>"
            )
        lines.append("    </link>")

    def friction(value: float) -> str:
        return f"<drake:mu_dynamic>{value}</drake:mu_dynamic><drake:mu_static>{value}</drake:mu_static>"

    def motor_joint(
        joint: str, parent: str, child: str, axis: str, motor: dict[str, float], limits: str
    ) -> None:
        lines.append(
            f'    <joint name="{joint}_joint" type="revolute"><parent>{parent}</parent><child>{child}</child>'
            f"<axis><xyz>{axis}</xyz><limit>{limits}<effort>{motor['effort']}</effort>"
            f"<velocity>{motor['velocity']}</velocity></limit></axis>"
            f'<drake:controller_gains p="0" d="{design["motors"]["damping"]}"/></joint>'
        )

    wheel, boom, bucket = design["wheel"], design["boom"], design["bucket"]
    front, rear = design["front_unit"], design["rear_unit"]
    steel = (
        f"{friction(bucket['friction'])}<drake:point_contact_stiffness>{bucket['stiffness']}"
        f"</drake:point_contact_stiffness><drake:hunt_crossley_dissipation>{bucket['dissipation']}"
        "</drake:hunt_crossley_dissipation>"
    )
    yellow, dark, grey = "0.95 0.72 0.1 1", "0.13 0.13 0.14 1", "0.45 0.45 0.47 1"

    box = make_box(front["box"])
    link("front_unit", ">0 0 0 0 0 0", calc_inertial([box], front["mass"], front["com"]),
         {"front_frame": mesh_geometry(box, "front_frame.obj")}, steel, yellow)  # fmt: skip
    box = make_box(rear["box"])
    art_x = design["articulation"]["x"]
    link("rear_unit", f'relative_to="front_unit">{art_x} 0 0 0 0 0', calc_inertial([box], rear["mass"], rear["com"]),
         {"rear_frame": mesh_geometry(box, "rear_frame.obj")}, "", yellow)  # fmt: skip
    r, w, m = wheel["radius"], wheel["width"], wheel["mass"]
    tyre = (
        f"{friction(wheel['friction'])}<drake:point_contact_stiffness>{wheel['stiffness']}"
        f"</drake:point_contact_stiffness><drake:hunt_crossley_dissipation>{wheel['dissipation']}"
        "</drake:hunt_crossley_dissipation>"
    )
    ixx, iyy = m * (3 * r**2 + w**2) / 12, m * r**2 / 2
    for end, parent, x in (("front", "front_unit", 0.0), ("rear", "rear_unit", wheel["axle_rear_x"])):
        for side, sign in (("left", 1), ("right", -1)):
            body = f"wheel_{end}_{side}"
            link(body, f'relative_to="{parent}">{x} {sign * wheel["y"]} 0 0 0 0',
                 f"<inertial><mass>{m}</mass><inertia><ixx>{ixx:.6g}</ixx><iyy>{iyy:.6g}</iyy><izz>{ixx:.6g}</izz>"
                 "<ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial>",
                 {"tyre": f"<ellipsoid><radii>{r} {w / 2} {r}</radii></ellipsoid>"}, tyre, dark)  # fmt: skip
            motor_joint(body, parent, body, "0 1 0", design["motors"]["wheel"], "")
    limit = math.radians(design["articulation"]["limit_deg"])
    lines.append(
        '    <joint name="articulation" type="revolute"><parent>front_unit</parent><child>rear_unit</child><axis>'
        f"<xyz>0 0 1</xyz><limit><lower>{-limit:.6f}</lower><upper>{limit:.6f}</upper></limit></axis>"
        '<drake:controller_gains p="1e10" d="1e9"/></joint>'
    )

    ax, az = boom["hinge"]
    box = make_box(boom["box"])
    link("boom", f'relative_to="front_unit">{ax} 0 {az} 0 0 0', calc_inertial([box], boom["mass"] + design["z_bar"]["mass"]),
         {"boom": mesh_geometry(box, "boom.obj")}, steel, yellow)  # fmt: skip
    lower, upper = (math.radians(v) for v in boom["limits_deg"])
    motor_joint("boom", "front_unit", "boom", "0 1 0", design["motors"]["boom"],
                f"<lower>{lower:.6f}</lower><upper>{upper:.6f}</upper>")  # fmt: skip

    tip_x, tip_z = bucket["tip"]
    half, inner = bucket["width"] / 2, bucket["width"] / 2 - bucket["side"]
    pieces = {"floor": make_prism(bucket["floor"], (-half, half))}
    bi, bo = bucket["back_inner"], bucket["back_outer"]
    for i in range(len(bi) - 1):
        pieces[f"back_{i + 1}"] = make_prism([bi[i], bi[i + 1], bo[i + 1], bo[i]], (-half, half))
    outline = [bucket["tip"], *bo]
    pieces["side_left"] = make_prism(outline, (inner, half))
    pieces["side_right"] = make_prism(outline, (-half, -inner))
    level = math.atan2(tip_x, tip_z)
    link("bucket", f'relative_to="boom">0 0 {boom["length"]} 0 {-level:.6f} 0',
         calc_inertial(list(pieces.values()), bucket["mass"]),
         {key: mesh_geometry(mesh, f"bucket_{key}.obj") for key, mesh in pieces.items()}, steel, grey)  # fmt: skip
    lower, upper = (math.radians(v) for v in bucket["limits_deg"])
    motor_joint("bucket", "boom", "bucket", "0 1 0", design["motors"]["bucket"],
                f"<lower>{lower:.6f}</lower><upper>{upper:.6f}</upper>")  # fmt: skip
    lines.append(f'    <frame name="tip" attached_to="bucket"><pose>{tip_x} 0 {tip_z} 0 0 0</pose></frame>')
    lines.append(f'    <frame name="floor" attached_to="front_unit"><pose>0 0 {-r} 0 0 0</pose></frame>')
    profile = [bucket["tip"], *bi]
    for i, (x, z) in enumerate(profile):
        lines.append(
            f'    <frame name="profile_{i}" attached_to="bucket"><pose>{x} {inner:.5g} {z} 0 0 0</pose></frame>'
        )
    members = "".join(f"<drake:member>{b}</drake:member>" for b in (
        "front_unit", "rear_unit", "boom", "bucket", "wheel_front_left", "wheel_front_right", "wheel_rear_left",
        "wheel_rear_right"))  # fmt: skip
    lines.append(
        f'    <drake:collision_filter_group name="machine">{members}'
        "<drake:ignored_collision_filter_group>machine</drake:ignored_collision_filter_group>"
        "</drake:collision_filter_group>"
    )
    text = "\n".join(
        [
            '<?xml version="1.0"?>',
            "<!-- Written by sdf/make_machine.py from design.yaml. -->",
            '<sdf version="1.11" xmlns:drake="drake.mit.edu">',
            f'  <model name="{name}">',
            *lines,
            "  </model>",
            "</sdf>",
            "",
        ]  # fmt: skip
    )
    (folder / f"{name}.sdf").write_text(text)


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        write_machine(Path(argument))
