"""Writes a machine's SDFormat file and meshes beside its design: python make_machine.py lhd/design.yaml.

The design states shapes, pins and masses; this works out what SDFormat wants on top: link poses, inertias
from the shapes, the cylinders' joint limits, the points of the loop constraints. The package itself reads the
SDFormat only.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from trimesh import Trimesh as Mesh

from drakerock.errors import InputError
from drakerock.files import read_text
from drakerock.yaml_reader import YamlDocument

_SIGNATURE = "<!-- Written by make_machine.py from design.yaml: change that, not this. -->"


def write_machine(design_file: Path) -> list[Path]:
    """Write <name>.sdf and the OBJ meshes into the folder of `design_file`; nothing is deleted.

    Returns:
        The files written.

    Raises:
        OSError: the design cannot be read or a file not be written.
        ValueError: the design lacks something, or <name>.sdf is none that this has written.
    """
    folder = design_file.parent
    try:
        design = YamlDocument(read_text(design_file), str(design_file)).data
        writer = Writer(design, folder)
        text = writer.make_model()
    except KeyError as error:
        raise ValueError(f"{design_file}: the key {error} is missing") from None
    except (InputError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise ValueError(f"{design_file}: {error}") from None
    model = folder / f"{writer.name}.sdf"
    if model.exists() and _SIGNATURE not in model.read_text(encoding="utf-8"):
        raise ValueError(
            f"{model}: not written by make_machine.py, so it stays; move it or change the design's name"
        )
    files = {model: text} | {folder / name: mesh for name, mesh in writer.meshes.items()}
    for path, content in files.items():
        path.write_text(content, encoding="utf-8")
    return list(files)


def main(arguments: list[str] | None = None) -> int:
    """Run the command: 0, or 2 with a message for a design that cannot be used."""
    parser = argparse.ArgumentParser(
        description="Write a machine's SDFormat file and its meshes into the folder of its design. Files of these "
        "names are replaced, nothing is deleted."
    )
    parser.add_argument("design", nargs="+", type=Path, help="a design.yaml such as lhd/design.yaml")
    for design in parser.parse_args(arguments).design:
        try:
            files = write_machine(design)
        except (OSError, ValueError) as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        for path in files:
            print(f"wrote {path}")
        others = sorted({*design.parent.glob("*.obj"), *design.parent.glob("*.sdf")} - set(files))
        for path in others:
            print(f"left {path}: no part of this machine")
    return 0


class Writer:
    """Collects the lines of one model."""

    def __init__(self, design: dict[str, Any], folder: Path) -> None:
        self.design, self.folder, self.name = design, folder, design["name"]
        self.meshes: dict[str, str] = {}
        self.lines: list[str] = []
        self.links: list[str] = []
        self.loops: list[str] = []

    def make_model(self) -> str:
        """Return the SDFormat text; the meshes' texts are in `meshes`."""
        bodies, motors = self.design["bodies"], self.design["motors"]
        steel = make_proximity(self.design["steel"])

        self.add_body("front_unit", "", bodies["front_unit"], steel)
        joint = self.design["articulation"]
        self.add_body("rear_unit", pose("front_unit", [joint["x"], 0, 0]), bodies["rear_unit"], steel)
        limit = math.radians(joint["limit_deg"])
        self.add_joint("articulation", "revolute", "front_unit", "rear_unit", "0 0 1", (-limit, limit),
                       gains=(joint["stiffness"], joint["damping"]))  # fmt: skip
        self.add_wheels()

        (x, z), length = self.design["boom"]["hinge"], self.design["boom"]["length"]
        self.add_body("boom", pose("front_unit", [x, 0, z]), bodies["boom"], steel)
        self.add_motor("boom", "front_unit", motors["boom"])
        tip = self.design["bucket"]["tip"]
        level = math.atan2(tip[0], tip[1])
        bucket = dict(bodies["bucket"])
        bucket["prisms"] = make_bucket_prisms(self.design["bucket"]) + bucket["prisms"]
        self.add_body(
            "bucket", pose("boom", [0, 0, length], rpy=[0, -level, 0]), bucket, steel, self.make_pads()
        )
        self.add_motor("bucket", "boom", motors["bucket"])

        self.add_frame("floor", "front_unit", [0, 0, -self.design["wheel"]["radius"]])
        self.add_frame("tip", "bucket", [tip[0], 0, tip[1]])
        inner = self.design["bucket"]["width"] / 2 - self.design["bucket"]["side"]
        for i, (x, z) in enumerate([tip, *self.design["bucket"]["inside"]]):
            self.add_frame(f"profile_{i}", "bucket", [x, inner, z])
        self.add_linkage()

        members = "".join(f"<drake:member>{link}</drake:member>" for link in self.links)
        self.lines.append(
            f'<drake:collision_filter_group name="machine">{members}'
            "<drake:ignored_collision_filter_group>machine</drake:ignored_collision_filter_group></drake:collision_filter_group>"
        )
        return "\n".join(
            [
                '<?xml version="1.0"?>',
                _SIGNATURE,
                '<sdf version="1.11" xmlns:drake="drake.mit.edu">',
                f'<model name="{self.name}">',
                *self.lines,
                *self.loops,
                "</model>",
                "</sdf>",
                "",
            ]
        )

    # -- parts

    def add_wheels(self) -> None:
        """Add the four wheels: an ellipsoid touches the floor in one smoothly moving point."""
        wheel, motor = self.design["wheel"], self.design["motors"]["wheel"]
        r, half, m = wheel["radius"], wheel["width"] / 2, wheel["mass"]
        tyre = [make_prism(make_disc(0, 0, 0.965 * r), (-half, half))]
        for i in range(wheel["lugs"]):
            angle = 2 * math.pi * (i + np.array([0.0, 0.5])) / wheel["lugs"]
            c, s = np.cos(angle), np.sin(angle)
            for y in ((-half, -0.05 * half), (0.05 * half, half)):
                outer, root = r * np.stack([c, s], axis=1), 0.95 * r * np.stack([c, s], axis=1)
                tyre.append(make_prism([*outer.tolist(), *root.tolist()[::-1]], y))
        rim = [make_prism(make_disc(0, 0, wheel["rim"]), (-0.8 * half, 0.8 * half)),
               make_prism(make_disc(0, 0, 0.45 * wheel["rim"]), (-1.05 * half, 1.05 * half))]  # fmt: skip
        inertial = make_inertial([make_prism(make_disc(0, 0, r, sides=64), (-half, half))], m)
        visuals = self.make_visual("wheel", "dark", tyre) + self.make_visual("wheel", "yellow", rim)
        shape = f"<geometry><ellipsoid><radii>{r} {half} {r}</radii></ellipsoid></geometry>"
        collision = f'<collision name="tyre">{shape}{make_proximity(self.design["tyre"])}</collision>'
        for end, parent, x in (
            ("front", "front_unit", 0.0),
            ("rear", "rear_unit", self.design["rear_axle_x"]),
        ):
            for side, sign in (("left", 1), ("right", -1)):
                body = f"wheel_{end}_{side}"
                self.add_link(body, pose(parent, [x, sign * wheel["y"], 0]), inertial, visuals + collision)
                self.add_motor(body, parent, motor)

    def make_pads(self) -> str:
        """Return the bucket's four wear pads: they alone touch a flat floor, in four steady points."""
        pads, z = self.design["bucket"]["pads"], self.design["bucket"]["tip"][1]
        r = pads["radius"]
        proximity = make_proximity(self.design["steel"] | {"friction": pads["friction"]})
        return "".join(
            f'<collision name="pad_{i}">{pose_tag([x, y, z + r])}<geometry>'
            f"<sphere><radius>{r}</radius></sphere></geometry>{proximity}</collision>"
            for i, (x, y) in enumerate((x, sign * pads["y"]) for x in pads["x"] for sign in (1, -1))
        )

    def add_linkage(self) -> None:
        """Add the links and cylinders behind boom and bucket, closed by ball constraints."""
        reference = self.calc_reference()
        steel = make_proximity(self.design["steel"])
        for name, spec in self.design["links"].items():
            parent, *base = spec["base"]
            X_WP = reference[parent]
            # Parallel to the boom in the reference pose.
            X_WN = reference["boom"].copy()
            X_WN[:3, 3] = apply(X_WP, base)
            reference[name] = X_WN
            prisms = self.design["bodies"].get(name, {}).get("prisms")
            if prisms is None:
                end_body, *end = spec["end"]
                prisms = make_rod_prisms(apply(np.linalg.inv(X_WN), apply(reference[end_body], end)))
            body = {"mass": spec["mass"], "prisms": prisms}
            self.add_body(name, pose_of(parent, np.linalg.inv(X_WP) @ X_WN), body, steel)
            self.add_joint(f"{name}_joint", "revolute", parent, name, "0 1 0")
            if "end" in spec:
                end_body, *end = spec["end"]
                p_NE = apply(np.linalg.inv(X_WN), apply(reference[end_body], end))
                self.add_loop(name, p_NE, end_body, end)
        for name, spec in self.design["cylinders"].items():
            self.add_cylinder(name, spec, reference, steel)

    def add_cylinder(
        self, name: str, spec: dict[str, Any], reference: dict[str, np.ndarray], steel: str
    ) -> None:
        """Add a cylinder's barrel, rod, joints and closure; the rod's limits are the cylinder's stops."""
        parent, *base = spec["base"]
        end_body, *end = spec["end"]
        start, stop = apply(reference[parent], base), apply(reference[end_body], end)
        length = float(np.linalg.norm(stop - start))
        z_axis = (stop - start) / length
        y_axis = np.array([0.0, 0.0, 1.0]) if spec.get("axis") == "z" else np.array([0.0, 1.0, 0.0])
        X_WC = np.eye(4)
        X_WC[:3, :3] = np.column_stack([np.cross(y_axis, z_axis), y_axis, z_axis])
        X_WC[:3, 3] = start
        shortest, longest = spec["length"]
        if not shortest < length < longest:
            raise ValueError(
                f"{name}: the reference pose needs {length:.3f} m, the stops are {spec['length']}"
            )
        tube = shortest - 0.12
        barrel = [{"color": "dark", "tube": spec["radius"][0], "z": [0.0, tube], "collision": True}]
        rod = [{"color": "chrome", "tube": spec["radius"][1], "z": [tube - longest, 0.0], "collision": True}]
        self.add_body(f"{name}_barrel", pose_of(parent, np.linalg.inv(reference[parent]) @ X_WC),
                      {"mass": spec["mass"][0], "prisms": barrel}, steel)  # fmt: skip
        self.add_joint(f"{name}_barrel_joint", "revolute", parent, f"{name}_barrel", "0 1 0")
        self.add_body(
            f"{name}_rod",
            pose(f"{name}_barrel", [0, 0, length]),
            {"mass": spec["mass"][1], "prisms": rod},
            steel,
        )
        self.add_joint(f"{name}_rod_joint", "prismatic", f"{name}_barrel", f"{name}_rod", "0 0 1",
                       (shortest - length, longest - length), damping=spec["damping"])  # fmt: skip
        self.add_loop(f"{name}_rod", np.zeros(3), end_body, end)

    def calc_reference(self) -> dict[str, np.ndarray]:
        """Return the links' poses (4, 4) in front_unit with the bucket level on the floor."""
        (x, z), length = self.design["boom"]["hinge"], self.design["boom"]["length"]
        floor = -self.design["wheel"]["radius"]
        phi_l = math.acos((floor - self.design["bucket"]["tip"][1] - z) / length)
        boom = make_transform([x, 0, z], pitch=phi_l)
        bucket = make_transform(apply(boom, [0, 0, length]))
        rear = make_transform([self.design["articulation"]["x"], 0, 0])
        return {"front_unit": np.eye(4), "rear_unit": rear, "boom": boom, "bucket": bucket}

    # -- SDFormat elements

    def add_body(
        self, name: str, link_pose: str, body: dict[str, Any], proximity: str, extra: str = ""
    ) -> None:
        """Add a link made of prisms."""
        by_color: dict[str, list[Mesh]] = {}
        solids: list[Mesh] = []
        collisions = extra
        for prism in body["prisms"]:
            meshes = make_prisms(prism)
            by_color.setdefault(prism["color"], []).extend(meshes)
            solids.extend(meshes)
            if prism.get("collision"):
                for mesh in make_prisms(prism, sides=8) if "tube" in prism else meshes:
                    file = f"{name}_{collisions.count('declare_convex') + 1}.obj"
                    collisions += (
                        f'<collision name="{file[:-4]}"><geometry><mesh><drake:declare_convex/>'
                        f"<uri>{self.export(mesh, file)}</uri></mesh></geometry>{proximity}</collision>\n"
                    )
        visuals = "".join(self.make_visual(name, color, meshes) for color, meshes in by_color.items())
        self.add_link(
            name, link_pose, make_inertial(solids, body["mass"], body.get("com")), visuals + collisions
        )

    def add_link(self, name: str, link_pose: str, inertial: str, shapes: str) -> None:
        """Add a link."""
        self.links.append(name)
        self.lines.append(f'<link name="{name}">{link_pose}\n{inertial}\n{shapes}</link>')

    def add_motor(self, body: str, parent: str, motor: dict[str, float]) -> None:
        """Add a motor's joint: a position gain of 0 and a large velocity gain make a velocity motor."""
        self.add_joint(f"{body}_joint", "revolute", parent, body, "0 1 0", motor=motor,
                       gains=(0, self.design["motors"]["damping"]))  # fmt: skip

    def add_joint(
        self,
        name: str,
        kind: str,
        parent: str,
        child: str,
        axis: str,
        limits: tuple[float, float] | None = None,
        motor: dict[str, float] | None = None,
        gains: tuple[float, float] | None = None,
        damping: float = 0.0,
    ) -> None:
        """Add a joint; without gains it has no actuator."""
        text = f"<lower>{limits[0]:.9f}</lower><upper>{limits[1]:.9f}</upper>" if limits else ""
        if motor:
            if "stop_deg" in motor:
                text += f"<upper>{math.radians(motor['stop_deg']):.9f}</upper>"
            text += f"<effort>{motor['effort']:g}</effort><velocity>{motor['velocity']:g}</velocity>"
        elif gains is None:
            text += "<effort>0</effort>"
        drag = f"<dynamics><damping>{damping:g}</damping></dynamics>" if damping else ""
        gain = f'<drake:controller_gains p="{gains[0]:g}" d="{gains[1]:g}"/>' if gains else ""
        self.lines.append(
            f'<joint name="{name}" type="{kind}"><parent>{parent}</parent><child>{child}</child>'
            f"<axis><xyz>{axis}</xyz><limit>{text}</limit>{drag}</axis>{gain}</joint>"
        )

    def add_loop(self, body_a: str, p_a: Any, body_b: str, p_b: Any) -> None:
        """Close a loop: point p_a of body_a stays on point p_b of body_b."""
        self.loops.append(
            f"<drake:ball_constraint><drake:ball_constraint_body_A>{body_a}</drake:ball_constraint_body_A>"
            f"<drake:ball_constraint_p_AP>{join(p_a)}</drake:ball_constraint_p_AP>"
            f"<drake:ball_constraint_body_B>{body_b}</drake:ball_constraint_body_B>"
            f"<drake:ball_constraint_p_BQ>{join(p_b)}</drake:ball_constraint_p_BQ></drake:ball_constraint>"
        )

    def add_frame(self, name: str, body: str, p: list[float]) -> None:
        """Add a frame."""
        self.lines.append(f'<frame name="{name}" attached_to="{body}">{pose_tag(p)}</frame>')

    def make_visual(self, name: str, color: str, meshes: list[Mesh]) -> str:
        """Return a visual of one colour."""
        rgb = join(self.design["colors"][color])
        uri = self.export(trimesh.util.concatenate(meshes), f"{name}_{color}.obj")
        return (
            f'<visual name="{name}_{color}"><geometry><mesh><uri>{uri}</uri></mesh></geometry>'
            f"<material><diffuse>{rgb} 1</diffuse></material></visual>\n"
        )

    def export(self, mesh: Mesh, file: str) -> str:
        """Write a mesh, return its address."""
        # Own vertices for every face: flat shading keeps the plates' edges visible.
        flat = Mesh(
            mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3), process=False
        )
        lines = [f"v {v[0]:.4f} {v[1]:.4f} {v[2]:.4f}" for v in flat.vertices]
        lines += [f"vn {n[0]:.4f} {n[1]:.4f} {n[2]:.4f}" for n in mesh.face_normals]
        lines += [
            f"f {a + 1}//{i + 1} {b + 1}//{i + 1} {c + 1}//{i + 1}" for i, (a, b, c) in enumerate(flat.faces)
        ]
        self.meshes[file] = "\n".join(lines) + "\n"
        # Shipped machines are found by the package, others beside their file.
        shipped = self.folder.resolve() == Path(__file__).resolve().parent / self.name
        return f"package://drakerock/{self.name}/{file}" if shipped else file


# -- shapes


def make_prism(polygon: list[list[float]], y: tuple[float, float]) -> Mesh:
    """Return the convex prism over [x, z] points, from y[0] to y[1]."""
    return trimesh.convex.convex_hull(np.array([[x, side, z] for side in y for x, z in polygon]))


def make_disc(x: float, z: float, radius: float, sides: int = 28) -> list[list[float]]:
    """Return a regular polygon."""
    angle = 2 * np.pi * np.arange(sides) / sides
    return np.stack([x + radius * np.cos(angle), z + radius * np.sin(angle)], axis=1).tolist()


def make_prisms(prism: dict[str, Any], sides: int = 20) -> list[Mesh]:
    """Return the meshes of one entry of a body's `prisms`; a tube has so many sides, on its circle."""
    if "tube" in prism:
        ring = np.array(make_disc(0, 0, prism["tube"], sides=sides))
        return [trimesh.convex.convex_hull(np.array([[x, y, z] for z in prism["z"] for x, y in ring]))]
    polygon = make_disc(*prism["disc"]) if "disc" in prism else prism["xz"]
    y = prism["y"]
    spans = [y, [-y[1], -y[0]]] if prism.get("mirror") else [y]
    return [make_prism(polygon, span) for span in spans]


def make_bucket_prisms(bucket: dict[str, Any]) -> list[dict[str, Any]]:
    """Return floor, back and side plates; plates are as thick as the sides, the lip runs out to a wedge."""
    inside, (tip_x, tip_z), t = np.array(bucket["inside"]), bucket["tip"], bucket["side"]
    half = bucket["width"] / 2
    # The pads carry the bucket; plates keep clear of the floor by a fifth of their thickness.
    under = tip_z + t / 5
    outside = [[inside[0][0], under]]
    for before, point, after in zip(inside[:-2], inside[1:-1], inside[2:], strict=True):
        normal = np.array([-(after - before)[1], (after - before)[0]]) / np.linalg.norm(after - before)
        outside.append((point + t * normal).tolist())
    last = inside[-1] - inside[-2]
    outside.append((inside[-1] + t * np.array([-last[1], last[0]]) / np.linalg.norm(last)).tolist())
    full = [-half, half]
    lip_x = tip_x - 3 * t
    floor = [[tip_x, under], [lip_x, inside[0][1]], inside[0].tolist(), outside[0], [lip_x, under]]
    plates = [{"color": "steel", "xz": floor, "y": full, "collision": True}]
    for i in range(len(inside) - 1):
        quad = [inside[i].tolist(), inside[i + 1].tolist(), outside[i + 1], outside[i]]
        plates.append({"color": "steel", "xz": quad, "y": full, "collision": True})
    side = [[tip_x, under], *outside, inside[-1].tolist()]
    plates.append({"color": "steel", "xz": side, "y": [half - t, half], "mirror": True, "collision": True})
    return plates


def make_rod_prisms(p_end: np.ndarray) -> list[dict[str, Any]]:
    """Return a flat rod from the origin to a pin in the xz plane."""
    along = np.array([p_end[0], p_end[2]])
    across = 0.09 * np.array([-along[1], along[0]]) / np.linalg.norm(along)
    polygon = [across, along + across, along - across, -across]
    return [
        {"color": "yellow", "xz": [p.tolist() for p in polygon], "y": [-0.07, 0.07], "collision": True},
        {"color": "steel", "disc": [0.0, 0.0, 0.12], "y": [-0.12, 0.12]},
        {"color": "steel", "disc": [float(along[0]), float(along[1]), 0.12], "y": [-0.12, 0.12]},
    ]


def make_inertial(meshes: list[Mesh], mass: float, com: list[float] | None = None) -> str:
    """Return <inertial> of the meshes at one density that gives `mass`; `com` [x, z] moves the centre."""
    volume = sum(mesh.volume for mesh in meshes)
    center = sum(mesh.volume * mesh.center_mass for mesh in meshes) / volume
    inertia = np.zeros((3, 3))
    for mesh in meshes:
        r = mesh.center_mass - center
        inertia += mesh.moment_inertia + mesh.volume * (r @ r * np.eye(3) - np.outer(r, r))
    inertia *= mass / volume
    if com is not None:
        center = np.array([com[0], 0.0, com[1]])
    names = (("ixx", 0, 0), ("iyy", 1, 1), ("izz", 2, 2), ("ixy", 0, 1), ("ixz", 0, 2), ("iyz", 1, 2))
    entries = "".join(
        f"<{n}>{inertia[i, j] if i == j else round(inertia[i, j], 3):.6g}</{n}>" for n, i, j in names
    )
    return f"<inertial>{pose_tag(center)}<mass>{mass:g}</mass><inertia>{entries}</inertia></inertial>"


# -- poses and text


def make_transform(p: Any, pitch: float = 0.0) -> np.ndarray:
    """Return the (4, 4) transform of a translation and a rotation about y."""
    X = np.eye(4)
    c, s = math.cos(pitch), math.sin(pitch)
    X[:3, :3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    X[:3, 3] = p
    return X


def apply(X: np.ndarray, p: Any) -> np.ndarray:
    """Return the point p transformed by X."""
    return X[:3, :3] @ np.asarray(p, dtype=float) + X[:3, 3]


def join(values: Any) -> str:
    """Return numbers as text."""
    return " ".join(f"{round(float(v), 9) + 0.0:.10g}" for v in values)


def pose_tag(p: Any, rpy: Any = (0, 0, 0), relative_to: str = "") -> str:
    """Return a <pose>."""
    attribute = f' relative_to="{relative_to}"' if relative_to else ""
    return f"<pose{attribute}>{join(p)} {join(rpy)}</pose>"


def pose(parent: str, p: list[float], rpy: Any = (0, 0, 0)) -> str:
    """Return a link's <pose> relative to another link."""
    return pose_tag(p, rpy, parent)


def pose_of(parent: str, X: np.ndarray) -> str:
    """Return a link's <pose> relative to another link from a transform."""
    return pose_tag(X[:3, 3], trimesh.transformations.euler_from_matrix(X, "sxyz"), parent)


def make_proximity(contact: dict[str, float]) -> str:
    """Return <drake:proximity_properties>."""
    return (
        "<drake:proximity_properties>"
        f"<drake:mu_dynamic>{contact['friction']}</drake:mu_dynamic>"
        f"<drake:mu_static>{contact['friction']}</drake:mu_static>"
        f"<drake:point_contact_stiffness>{contact['stiffness']:g}</drake:point_contact_stiffness>"
        f"<drake:hunt_crossley_dissipation>{contact['dissipation']:g}</drake:hunt_crossley_dissipation>"
        "</drake:proximity_properties>"
    )


if __name__ == "__main__":
    sys.exit(main())
