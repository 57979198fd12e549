"""Reading a plant's ball constraints: points of two bodies that stay together.

A `MultibodyPlant` tells how many constraints it has, not which. Its constraints on positions, made for optimization
programs, tell: each ball constraint names its bodies by index, bounds the place of Q in A by p_AP, and evaluates it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.inverse_kinematics import AddMultibodyPlantConstraints
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.solvers import MathematicalProgram

from drakerock.errors import InputError

_BALL = re.compile(r"Ball constraint between body (\d+) and body (\d+)")


@dataclass(frozen=True, eq=False)
class BallConstraint:
    """Point P of body A stays on point Q of body B.

    Attributes:
        body_A, body_B: the bodies.
        p_AP, p_BQ: (3,) the points in the bodies' frames [m].
    """

    body_A: RigidBody
    p_AP: NDArray[np.float64]
    body_B: RigidBody
    p_BQ: NDArray[np.float64]


def read_ball_constraints(plant: MultibodyPlant) -> tuple[BallConstraint, ...]:
    """Return the ball constraints of a finalized plant, of all model instances, in the order of their making.

    Raises:
        InputError: the plant has constraints of another kind (coupler, distance, weld, tendon).
    """
    if plant.num_constraints() == 0:
        return ()
    context = plant.CreateDefaultContext()
    q = plant.GetPositions(context)
    program = MathematicalProgram()
    try:
        bindings = AddMultibodyPlantConstraints(
            plant, program.NewContinuousVariables(len(q)), program, context
        )
    except RuntimeError as error:
        raise InputError(f"the plant has constraints that cannot be read: {error}") from None
    found = []
    for binding in bindings:
        evaluator = binding.evaluator()
        match = _BALL.fullmatch(evaluator.get_description())
        if match is None:
            continue
        body_A, body_B = (plant.get_body(BodyIndex(int(index))) for index in match.groups())
        X_BA = plant.CalcRelativeTransform(context, body_B.body_frame(), body_A.body_frame())
        # To a picometre: the point as it was given, without the round-off of the bodies' poses.
        p_BQ = np.round(X_BA.multiply(evaluator.Eval(q)), 12) + 0.0
        found.append(BallConstraint(body_A, evaluator.lower_bound(), body_B, p_BQ))
    if len(found) != plant.num_constraints():
        raise InputError(
            f"{plant.num_constraints() - len(found)} of the plant's {plant.num_constraints()} constraints are no "
            "ball constraints; only ball constraints (drake:ball_constraint, AddBallConstraint) are supported"
        )
    return tuple(found)
