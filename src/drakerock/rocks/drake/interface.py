"""What both rock engines offer to a Diagram, so that everything else in it is the same for both."""

from __future__ import annotations

from typing import Protocol

from pydrake.systems.framework import Context, OutputPort

from drakerock.rocks.state import PileState

ROCK_SUMMARY: dict[str, str] = {
    "n_awake": "1",
    "n_contacts": "1",
    "penetration_max": "m",
    "penetration_p99": "m",
    "residual": "1",
    "n_lost": "1",
    "n_flagged": "1",
}
"""Elements of the ``rock_summary`` output, with units: rocks that are simulated, their contacts, the deepest and the
99th percentile of the penetration, the solver's residual relative to the sum of impulses (0 where the solver
converges to its own tolerance), rocks that have left the site, steps so far that had to be solved again or whose
penetration was beyond its bound (0 where the engine has none)."""


class RockSystem(Protocol):
    """A system that holds or shows the rocks of a pile (n rocks, in the order of its `PileState`).

    Output ports:
        ``rock_poses``: (7 n,) quaternion (w, x, y, z) and position in W [m] of each rock.
        ``rock_velocities``: (6 n,) angular [rad/s] and translational [m/s] velocity in W.
        ``rock_summary``: the vector of `ROCK_SUMMARY`.
        ``F_B_W``: (6,) sum of the rocks' forces on the bucket at its origin, torque [N m] then force [N], in W.
    """

    def GetOutputPort(self, port_name: str) -> OutputPort:
        """Return the port of that name."""

    def GetMyContextFromRoot(self, root_context: Context) -> Context:
        """Return the system's own context in a Diagram's."""

    def set_pile(self, root_context: Context, pile: PileState) -> None:
        """Write the rocks' poses and velocities into the Diagram's context."""

    def get_pile(self, root_context: Context) -> PileState:
        """Read the rocks' present state from the Diagram's context."""
