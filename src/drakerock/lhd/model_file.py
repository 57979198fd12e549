"""A machine's SDFormat file: everything that it must have is checked here, before anything is built on it.

The file is looked at twice. As XML, because Drake drops some elements without a word and gives a link without
<inertial> 1 kg. And as Drake reads it, in a plant of its own: that alone tells what became of the rest.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import (
    ForceElementIndex,
    Joint,
    JointActuator,
    LinearBushingRollPitchYaw,
    ModelInstanceIndex,
    RigidBody,
)
from pydrake.systems.framework import Context, DiagramBuilder
from shapely import Polygon

from drakerock.errors import InputError
from drakerock.lhd import names
from drakerock.lhd.config import MachineConfig, MotorConfig
from drakerock.lhd.outline import Outline
from drakerock.resources import find_data
from drakerock.rocks.drake.ball_constraints import read_ball_constraints

Array = np.ndarray

# How far frames and axes may stand from where `names` wants them [m, rad].
_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Loop:
    """A closed loop: point `p_AP` of `body_A` stays on `p_BQ` of `body_B` [m, in the bodies' frames]."""

    body_A: str
    p_AP: tuple[float, ...]
    body_B: str
    p_BQ: tuple[float, ...]


@dataclass(frozen=True)
class MachineFile:
    """A machine's file that has passed all checks.

    Attributes:
        path: the file.
        loops: the closed loops of its linkage.
        ignored: what stands in it without any effect, a line each.
    """

    path: str
    loops: tuple[Loop, ...]
    ignored: tuple[str, ...]


def check_machine_file(config: MachineConfig) -> MachineFile:
    """Check the machine's file.

    Raises:
        InputError: no such file, or something in it that cannot be used: file, line and what to write.
    """
    path = _resolve(config.model)
    outline = Outline(path, config.model)
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.01), builder)
    instance, warnings = parse_machine(plant, path, config.model)
    _refuse_bad_warnings(warnings, config.model)
    check = _Check(plant, scene_graph, instance, config, outline)
    with _refuse_failures(config.model, path):
        plant.Finalize()
        check.run()
    builder.Build()  # pydrake frees a plant only with its Diagram
    # Drake tells some of what the outline finds.
    ignored = dict.fromkeys([*outline.ignored, *warnings, *check.ignored])
    return MachineFile(path, check.loops, tuple(ignored))


def parse_machine(plant: MultibodyPlant, path: str, name: str) -> tuple[ModelInstanceIndex, list[str]]:
    """Parse a machine's file into a plant before its Finalize; return the model and what Drake warns of.

    Args:
        plant: the plant.
        path: the file.
        name: what messages call it.

    Raises:
        InputError: Drake cannot read the file, or it holds other than one model.
    """
    with _refuse_failures(name, path), _hear_drake() as heard:
        found = _make_parser(plant).AddModels(path)
    if len(found) != 1:
        raise InputError(f"{name}: expected one <model>, found {len(found)}")
    return found[0], [_rename(text, path, name).replace("warning: ", "") for text in heard]


def _make_parser(plant: MultibodyPlant) -> Parser:
    parser = Parser(plant)
    parser.package_map().AddPackageXml(str(find_data("models", "package.xml")))
    return parser


def _resolve(model: str) -> str:
    path = model
    if model.startswith("package://"):
        try:
            path = _make_parser(MultibodyPlant(0.01)).package_map().ResolveUrl(model)
        except RuntimeError as error:
            raise InputError(f"machine.model: {model}: {error}") from None
    if not Path(path).is_file():
        raise InputError(f"machine.model: {model}: no such file")
    if Path(path).suffix != ".sdf":
        raise InputError(f"machine.model: {model}: expected an SDFormat file, with a name that ends in .sdf")
    return str(Path(path).absolute())


@contextmanager
def _refuse_failures(name: str, path: str) -> Iterator[None]:
    """Turn a failure of Drake's over the file into an InputError of one line."""
    try:
        yield
    except (RuntimeError, SystemExit) as error:  # pydrake makes a SystemExit of a failed DRAKE_DEMAND
        text = _rename(str(error), path, name).replace("error: ", "")
        text = re.sub(r"Failure at \S+ in (\w+)\(\): (.*)", r"Drake's \1 refuses a number in it: \2", text)
        raise InputError(text if text.startswith(name) else f"{name}: {text}") from None


def _rename(text: str, path: str, name: str) -> str:
    """Return a message of Drake's as one line, with the file named as the user does."""
    folder, _, file = path.rpartition("/")
    return re.sub(f"/*{re.escape(folder)}/+{re.escape(file)}", lambda _: name, " ".join(text.split()))


@contextmanager
def _hear_drake() -> Iterator[list[str]]:
    """Collect what Drake's parser warns of, in place of its printing."""
    heard: list[str] = []

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if record.levelno >= logging.WARNING:
                heard.append(record.getMessage())

    log = logging.getLogger("drake")
    handlers, propagate = log.handlers, log.propagate
    log.handlers, log.propagate = [Collector()], False
    try:
        yield heard
    finally:
        log.handlers, log.propagate = handlers, propagate


def _refuse_bad_warnings(warnings: list[str], name: str) -> None:
    """Refuse what Drake only warns of although the model then has other numbers than the file."""
    for text in warnings:
        if "central inertia" in text:
            raise InputError(
                f"{text.split(' ')[0]} <inertial> has no <mass> above 0 or no <inertia> of a body"
            )
        if "SDFormat Error" in text or "invalid inertia" in text:
            raise InputError(text if text.startswith(name) else f"{name}: {text}")


# -- the file as Drake reads it


class _Check:
    """The checks of the finalized model; each raises InputError on the first fault."""

    def __init__(
        self,
        plant: MultibodyPlant,
        scene_graph: SceneGraph,
        instance: ModelInstanceIndex,
        config: MachineConfig,
        outline: Outline,
    ) -> None:
        self.plant, self.instance = plant, instance
        self.inspector = scene_graph.model_inspector()
        self.config, self.outline = config, outline
        self.loops: tuple[Loop, ...] = ()
        self.ignored: list[str] = []

    def run(self) -> None:
        """Check everything, what the next check relies on first."""
        self._check_names()
        self._check_base()
        self._check_hinges()
        self._check_actuators()
        self._check_motors()
        self._check_bodies()
        self._check_constraints()
        self._check_inertia()
        self._check_frames()
        self._check_axes()
        self._check_arms()
        self._check_profile()

    def _refuse(self, kind: str, name: str, text: str) -> None:
        raise InputError(f"{self.outline.find(kind, name)}: {kind} '{name}' {text}")

    def _get_joint(self, name: str) -> Joint:
        return self.plant.GetJointByName(name, self.instance)

    def _get_bodies(self) -> list[RigidBody]:
        return [self.plant.get_body(index) for index in self.plant.GetBodyIndices(self.instance)]

    def _check_names(self) -> None:
        plant = self.plant
        wanted = [
            ("link", names.BODIES, plant.HasBodyNamed),
            ("joint", names.JOINTS, plant.HasJointNamed),
            ("frame", (*names.FRAMES, f"{names.PROFILE}0"), plant.HasFrameNamed),
        ]
        missing = [
            f'<{kind} name="{name}">'
            for kind, group, has in wanted
            for name in group
            if not has(name, self.instance)
        ]
        if missing:
            raise InputError(f"{self.outline.name}: missing {', '.join(missing)}")

    def _check_hinges(self) -> None:
        for name in names.JOINTS:
            joint = self._get_joint(name)
            if joint.type_name() != "revolute":
                self._refuse("joint", name, f"is {joint.type_name()}; it has to be revolute")
            parent, child = names.HINGES[name]
            found = (joint.parent_body().name(), joint.child_body().name())
            if child != found[1] or parent not in ("", found[0]):
                wanted = (
                    f"<parent>{parent}</parent> <child>{child}</child>"
                    if parent
                    else f"<child>{child}</child>"
                )
                self._refuse("joint", name, f"joins {found[0]} to {found[1]}; write {wanted}")

    def _check_actuators(self) -> None:
        plant = self.plant
        found = {
            plant.get_joint_actuator(index).joint().name()
            for index in plant.GetJointActuatorIndices(self.instance)
        }
        for name in names.JOINTS:
            if name not in found:
                self._refuse("joint", name, "has no actuator: write its <effort> [N m], above 0, in <limit>")
        for name in sorted(found - set(names.JOINTS)):
            self._refuse(
                "joint", name, "is no motor but has an actuator: write <effort>0</effort> in <limit>"
            )
        actuator = self._get_actuator("articulation")
        if not (actuator.has_controller() and actuator.get_controller_gains().p > 0):
            self._refuse(
                "joint", "articulation", "holds no angle: write <drake:controller_gains> with p > 0 in it"
            )

    def _get_actuator(self, joint: str) -> JointActuator:
        return self.plant.GetJointActuatorByName(joint, self.instance)

    def _check_motors(self) -> None:
        motors: dict[str, MotorConfig] = {"boom_joint": self.config.boom, "bucket_joint": self.config.bucket}
        motors |= dict.fromkeys(names.WHEEL_JOINTS, self.config.wheel)
        for name, motor in motors.items():
            actuator = self._get_actuator(name)
            self._check_limit(name, "effort", "N m", actuator.effort_limit(), motor)
            self._check_limit(
                name, "velocity", "rad/s", self._get_joint(name).velocity_upper_limits()[0], motor
            )
            gains = actuator.get_controller_gains() if actuator.has_controller() else None
            if self.config.motor_damping is None and not (gains and gains.d > 0):
                self._refuse(
                    "joint", name, "has no velocity gain: write <drake:controller_gains> with d > 0 in it"
                )
            if gains and gains.p != 0:
                where = self.outline.find("joint", name)
                self.ignored.append(f"{where}: motors have no position gain: p of joint '{name}' is ignored")
        first, *others = names.WHEEL_JOINTS
        for name in others:
            for key in ("effort", "velocity"):
                if (
                    getattr(self.config.wheel, key) is None
                    and self._get_limits(name)[key] != self._get_limits(first)[key]
                ):
                    self._refuse(
                        "joint", name, f"and '{first}' have different <{key}>; wheels have one motor"
                    )

    def _get_limits(self, joint: str) -> dict[str, float]:
        return {
            "effort": self._get_actuator(joint).effort_limit(),
            "velocity": float(self._get_joint(joint).velocity_upper_limits()[0]),
        }

    def _check_limit(self, joint: str, key: str, unit: str, value: float, motor: MotorConfig) -> None:
        if getattr(motor, key) is None and not 0 < value < math.inf:
            self._refuse(
                "joint", joint, f"has no limit of {key}: write <{key}> [{unit}], above 0, in <limit>"
            )

    def _check_bodies(self) -> None:
        for body in self._get_bodies():
            if not 0 < body.default_mass() < math.inf:
                self._refuse(
                    "link", body.name(), f"has a <mass> of {body.default_mass():g} kg; it has to be above 0"
                )
        for name in ("bucket", *names.WHEELS):
            body = self.plant.GetBodyByName(name, self.instance)
            shapes = [self.inspector.GetName(g) for g in self.plant.GetCollisionGeometriesForBody(body)]
            if all(shape.split("::")[-1].startswith(names.PAD) for shape in shapes):
                pads = f" but {names.PAD}..., which meet the floor only" if shapes else ""
                self._refuse("link", name, f"has no <collision>{pads}: it would go through floor and rock")

    def _check_base(self) -> None:
        floating = {body.name() for body in self._get_bodies() if body.is_floating_base_body()}
        for name in sorted(floating - {"front_unit"}):
            self._refuse("link", name, "hangs on nothing: write a <joint> that leads to front_unit")
        if not floating:
            self._refuse("link", "front_unit", "is held; it has to be free, the machine stands on its wheels")

    def _check_constraints(self) -> None:
        for index in range(self.plant.num_force_elements()):
            if isinstance(self.plant.get_force_element(ForceElementIndex(index)), LinearBushingRollPitchYaw):
                raise InputError(
                    f"{self.outline.name}: <drake:linear_bushing_rpy> gives way, the kinematics of boom and bucket "
                    "cannot be told from it; write <drake:ball_constraint> to close a loop"
                )
        try:
            found = read_ball_constraints(self.plant)
        except InputError as error:
            raise InputError(f"{self.outline.name}: {error}") from None
        self.loops = tuple(
            Loop(ball.body_A.name(), tuple(ball.p_AP), ball.body_B.name(), tuple(ball.p_BQ)) for ball in found
        )

    def _check_inertia(self) -> None:
        """Refuse what the solver could not divide by."""
        mass = self.plant.CalcMassMatrix(self.context)
        if not np.all(np.isfinite(mass)) or np.linalg.eigvalsh(mass).min() <= 1e-12 * np.diag(mass).max():
            raise InputError(f"{self.outline.name}: the links' <inertia> leave a joint without inertia")

    def _check_frames(self) -> None:
        count = 0
        while self.plant.HasFrameNamed(f"{names.PROFILE}{count}", self.instance):
            count += 1
        profile = [f"{names.PROFILE}{i}" for i in range(count)]
        for name, body in [
            ("floor", "front_unit"),
            ("tip", "bucket"),
            *((frame, "bucket") for frame in profile),
        ]:
            frame = self.plant.GetFrameByName(name, self.instance)
            if frame.body().name() != body:
                self._refuse(
                    "frame", name, f'is attached to {frame.body().name()}; write attached_to="{body}"'
                )
        for index in self.plant.GetFrameIndices(self.instance):
            name = self.plant.get_frame(index).name()
            if name.startswith(names.PROFILE) and name not in profile:
                self._refuse(
                    "frame", name, f"stands behind a gap: number the bucket's {names.PROFILE} frames from 0"
                )
        if self._locate("floor", "front_unit")[2] >= 0:
            self._refuse("frame", "floor", "has to stand below front_unit, where the tyres' lowest point is")

    @cached_property
    def context(self) -> Context:
        """The plant's default context: every joint at 0."""
        return self.plant.CreateDefaultContext()

    def _pose(self, frame: str, base: str) -> RigidTransform:
        plant, instance = self.plant, self.instance
        return plant.GetFrameByName(frame, instance).CalcPose(
            self.context, plant.GetFrameByName(base, instance)
        )

    def _locate(self, frame: str, base: str) -> Array:
        return self._pose(frame, base).translation()

    def _check_axes(self) -> None:
        """Angles and rates count about +y, and the hinge's moment is taken in the joint's frame."""
        plant = self.plant
        front = plant.GetFrameByName("front_unit", self.instance)
        for name in names.JOINTS[1:]:
            joint = self._get_joint(name)
            axis = joint.revolute_axis()
            axis_F = joint.frame_on_parent().CalcPose(self.context, front).rotation().multiply(axis)
            if (
                np.linalg.norm(axis - [0, 1, 0]) > _TOLERANCE
                or np.linalg.norm(axis_F - [0, 1, 0]) > _TOLERANCE
            ):
                self._refuse(
                    "joint",
                    name,
                    f"turns about {_format(axis)} in its own frame, {_format(axis_F)} in front_unit's; write "
                    "<xyz>0 1 0</xyz> and give joint and links <pose>s without roll and yaw",
                )
        x, _, z = np.mean([self._locate(wheel, "front_unit") for wheel in names.WHEELS[:2]], axis=0)
        if max(abs(x), abs(z)) > _TOLERANCE:
            self._refuse(
                "link",
                "front_unit",
                f"has its front axle's middle at x = {x:.4g}, z = {z:.4g}; it has to be its frame's origin",
            )

    def _check_arms(self) -> None:
        """With boom and bucket at 0 both hinges and the tip stand one above the other: the angles' zero."""
        hinge = self._get_joint("boom_joint").frame_on_parent()
        front = self.plant.GetFrameByName("front_unit", self.instance)
        if (
            np.linalg.norm(
                self._locate("boom", "front_unit") - hinge.CalcPose(self.context, front).translation()
            )
            > _TOLERANCE
        ):
            self._refuse("link", "boom", "has its origin beside boom_joint; it has to be the boom's hinge")
        p_LB = self._locate("bucket", "boom")
        p_AB = self._locate("bucket", "front_unit") - self._locate("boom", "front_unit")
        p_BT = self._locate("tip", "bucket")
        p_BT_F = self._locate("tip", "front_unit") - self._locate("bucket", "front_unit")
        for kind, name, p, what in (
            ("link", "bucket", p_LB, "the bucket's hinge in the boom's frame"),
            ("link", "bucket", p_AB, "the bucket's hinge above the boom's, with boom_joint at 0,"),
            (
                "frame",
                "tip",
                p_BT_F,
                "the tip above the bucket's hinge, with boom_joint and bucket_joint at 0,",
            ),
        ):
            if max(abs(p[0]), abs(p[1])) > _TOLERANCE or p[2] <= _TOLERANCE:
                self._refuse(
                    kind, name, f"is misplaced: {what} is at {_format(p)}; it has to be at 0 0 z, z > 0"
                )
        if p_BT[0] <= 0:
            self._refuse(
                "frame", "tip", f"is at x = {p_BT[0]:.4g} of the bucket; its floor runs along +x to the tip"
            )

    def _check_profile(self) -> None:
        """The bucket's inside has to be an outline that rock can lie in."""
        points: list[Array] = []
        while self.plant.HasFrameNamed(f"{names.PROFILE}{len(points)}", self.instance):
            points.append(self._locate(f"{names.PROFILE}{len(points)}", "bucket"))
        corners = np.array(points)
        where, name = self.outline.find("frame", f"{names.PROFILE}0"), f"{names.PROFILE}0..{len(points) - 1}"
        wanted = "from the lip over floor and back to the top edge, at the inner face of the left side plate (y > 0)"
        outline = Polygon(corners[:, [0, 2]]) if len(corners) >= 3 else Polygon()
        # In x to the right, z upwards a bucket that opens forward runs clockwise.
        if not (outline.is_valid and outline.area > 0 and corners[:, 1].min() > 0) or outline.exterior.is_ccw:
            raise InputError(
                f"{where}: frames {name} are no outline of a bucket: at least 3 points, {wanted}"
            )


def _format(vector: Array) -> str:
    return " ".join(f"{value:.4g}" for value in vector)
