"""What both rock engines offer to a Diagram, so that everything else in it is the same for both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import BasicVector, Context, LeafSystem, OutputPort

from drakerock.memory import weak
from drakerock.rocks.drake.poses import make_poses
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.state import PileState, make_empty_pile

Array = NDArray[np.float64]

ROCK_SUMMARY: dict[str, str] = {
    "n_awake": "1",
    "n_contacts": "1",
    "penetration_max": "m",
    "penetration_p99": "m",
    "residual": "1",
    "n_lost": "1",
    "n_flagged": "1",
}
"""Elements of the ``summary`` output, with units: rocks that are simulated, their contacts, the deepest and the
99th percentile of the penetration, the solver's residual relative to the sum of impulses (0 where the solver
converges to its own tolerance), rocks that have left the bounds, steps so far that had to be solved again or whose
penetration was beyond its bound (0 where the engine has none)."""


@dataclass(frozen=True, eq=False)
class RockContacts:
    """The contact points of rocks that carry load (c points).

    Attributes:
        rock: (c,) the rock that each is of.
        other: (c,) the other rock, or -1: a body of the plant.
        body: (c,) that body's `BodyIndex` as a number, the world's for what is welded to it; -1: between rocks.
        p_WCs: (c, 3) where [m].
        f_WCs: (c, 3) force on the rock's counterpart, in W [N].
        t_WCs: (c, 3) moment on it about that point, which patches carry and points do not [N m].
        depth: (c,) penetration, below 0 where a gap is left [m].
    """

    rock: NDArray[np.int64]
    other: NDArray[np.int64]
    body: NDArray[np.int64]
    p_WCs: Array
    f_WCs: Array
    t_WCs: Array
    depth: Array

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.rock)


# A body of the plant that starts so deep in a rock starts inside the pile: [m], and as a share of the rock's size.
START_PENETRATION = 0.05
START_SHARE = 1 / 6


def find_start_inside(contacts: RockContacts, size: Array) -> int | None:
    """Return the contact at which a body of the plant starts inside the pile; None if all start outside.

    Args:
        contacts: of the first step.
        size: (n,) of the rocks [m].
    """
    allowed = np.minimum(START_PENETRATION, START_SHARE * size[contacts.rock])
    excess = np.where(contacts.body > 0, contacts.depth - allowed, -np.inf)
    return int(np.argmax(excess)) if len(excess) and excess.max() > 0.0 else None


def make_empty_contacts() -> RockContacts:
    """Return no contact points."""
    none, points = np.zeros(0, np.int64), np.zeros((0, 3))
    return RockContacts(none, none, none, points, points, points, np.zeros(0))


class RockSystem(LeafSystem):
    """A system that holds or shows the rocks of a pile (n rocks, in the order of its `PileState`).

    What is said of an instant t is so when the step at t begins, before any update at t. Forces and the summary are of
    the step that *ended* at t, as a sensor measures them (zero at the start), so nothing that reads them closes an
    algebraic loop; contact points are of the step that *begins* at t. Both engines mean the same by every port.

    Output ports:
        ``pile``: abstract, a `PileState` without contacts.
        ``poses``: list of RigidTransform, X_WR of each rock.
        ``summary``: the vector of `ROCK_SUMMARY`, over the last step.
        ``body_spatial_forces``: list of SpatialForce by BodyIndex, the sum of the rocks' forces on each body of the
            plant over the last step, at the body's origin, in W; zero for bodies that are welded to the world.
        ``BODY_spatial_force``: (6,) the same of one body that touches rocks, torque [N m] then force [N]; see
            `get_body_force_output_port`.
        ``contacts``: abstract, `RockContacts` over the coming step.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        pile: PileState,
        shapes: tuple[RockShape, ...],
        bodies: Sequence[BodyIndex],
    ) -> None:
        """Declare what follows from `_get_pile` and `_get_report`; `bodies` are those that touch rocks."""
        super().__init__()
        self.set_name("rocks")
        self._plant = plant
        self._bodies = tuple(bodies)
        self._shapes = shapes
        self._default_pile = pile

    @property
    def pile(self) -> PileState:
        """The rocks as the system was made for them: shapes and sizes; where they are in a default context."""
        return self._default_pile

    @property
    def shapes(self) -> tuple[RockShape, ...]:
        """The rock shapes that the pile's `shape` counts."""
        return self._shapes

    def _declare_outputs(self, report_ticket: object, state_ticket: object) -> None:
        n_bodies = self._plant.num_bodies()
        self.DeclareAbstractOutputPort(
            "pile", lambda: Value[object](make_empty_pile()), weak(self._calc_pile), {state_ticket}
        )
        self.DeclareAbstractOutputPort(
            "poses", lambda: Value[list[RigidTransform]]([]), weak(self._calc_poses), {state_ticket}
        )
        self.DeclareVectorOutputPort("summary", len(ROCK_SUMMARY), self._calc_summary, {report_ticket})
        self.DeclareAbstractOutputPort(
            "body_spatial_forces",
            lambda: Value([SpatialForce.Zero()] * n_bodies),
            weak(self._calc_body_forces),
            {report_ticket},
        )
        calc_body_force = weak(self._calc_body_force)
        for k, index in enumerate(self._bodies):
            self.DeclareVectorOutputPort(
                _name_force_port(self._plant, index),
                6,
                lambda context, output, k=k: calc_body_force(context, output, k),
                {report_ticket},
            )

    def get_body_force_output_port(self, body: BodyIndex) -> OutputPort:
        """Return the port ``BODY_spatial_force`` of a body.

        Raises:
            KeyError: rocks do not touch it.
        """
        if body not in self._bodies:
            name = self._plant.get_body(body).scoped_name()
            known = ", ".join(str(self._plant.get_body(index).scoped_name()) for index in self._bodies)
            raise KeyError(
                f"body '{name}' has no collision geometry that rocks meet; those that have: {known}"
            )
        return self.GetOutputPort(_name_force_port(self._plant, body))

    def set_pile(self, root_context: Context, pile: PileState) -> None:
        """Write the rocks' poses and velocities into the Diagram's context."""
        raise NotImplementedError

    def get_pile(self, root_context: Context) -> PileState:
        """Read the rocks' present state, contacts included where the engine has them, from the Diagram's context."""
        raise NotImplementedError

    def _read_pile(self, context: Context) -> PileState:
        """Return the rocks' present state, without contacts."""
        raise NotImplementedError

    def _read_report(self, context: Context) -> Array:
        """Return the summary and the force on each body (6,) over the last step, in one row."""
        raise NotImplementedError

    def _calc_pile(self, context: Context, output: Value) -> None:
        output.set_value(self._read_pile(context))

    def _calc_poses(self, context: Context, output: Value) -> None:
        pile = self._read_pile(context)
        output.set_value(make_poses(pile.q_WRs, pile.p_WRs))

    def _calc_summary(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._read_report(context)[: len(ROCK_SUMMARY)])

    def _read_forces(self, context: Context) -> Array:
        return self._read_report(context)[len(ROCK_SUMMARY) :].reshape(-1, 6)

    def _calc_body_forces(self, context: Context, output: Value) -> None:
        forces = [SpatialForce.Zero()] * self._plant.num_bodies()
        for index, F_B_W in zip(self._bodies, self._read_forces(context), strict=True):
            forces[int(index)] = SpatialForce(F_B_W[:3], F_B_W[3:])
        output.set_value(forces)

    def _calc_body_force(self, context: Context, output: BasicVector, k: int) -> None:
        output.SetFromVector(self._read_forces(context)[k])


def _name_force_port(plant: MultibodyPlant, body: BodyIndex) -> str:
    return f"{plant.get_body(body).scoped_name()}_spatial_force"
