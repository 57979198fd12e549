"""A test's scene, for any engine: slabs at rest, tools that move on one joint each, and what a run records."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.state import PileState

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Slab:
    """A box of a bench or of a tool.

    Attributes:
        size: (3,) its edges [m].
        p: (3,) its centre in W at the start [m].
        pitch: its turn about W's y axis [rad].
        friction: of its surface with rock: the pair's coefficient.
    """

    size: tuple[float, float, float]
    p: tuple[float, float, float]
    pitch: float = 0.0
    friction: float = 0.9

    def calc_corners(self) -> Array:
        """Return its corners (8, 3) in W at the start [m]."""
        c, s = np.cos(self.pitch), np.sin(self.pitch)
        turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        signs = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])).reshape(3, 8).T
        return np.asarray(signs * np.array(self.size) @ turn.T + np.array(self.p))


@dataclass(frozen=True, eq=False)
class Mover:
    """Slabs that move together, on one joint to the world, without weight.

    Attributes:
        name: what it is called in records.
        slabs: where they are at the start.
        axis: (3,) unit vector in W along which it slides, or about which it turns.
        joint: whether it slides or turns.
        drive: whether its speed [m/s, rad/s] or the force on it [N] is given.
        pivot: (3,) on the axis that it turns about [m].
        mass: [kg]; of one whose speed is given, much more than what it moves.
        damping: of the joint of one that is driven by force [N s/m].
    """

    name: str
    slabs: tuple[Slab, ...]
    axis: tuple[float, float, float]
    drive: Literal["speed", "force"] = "speed"
    joint: Literal["slide", "turn"] = "slide"
    pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mass: float = 1e7
    damping: float = 0.0


@dataclass(frozen=True, eq=False)
class Scene:
    """What rocks are tested in.

    Attributes:
        slabs: at rest.
        movers: driven.
        gravity: whether there is any.
        floor: rocks below this are out of the test [m].
    """

    slabs: tuple[Slab, ...]
    movers: tuple[Mover, ...] = ()
    gravity: bool = True
    floor: float = -5.0


@dataclass(frozen=True, eq=False)
class Record:
    """A run, step by step (k steps).

    Attributes:
        times: (k,) at the steps' ends [s].
        travels: (k,) of each mover since the scene's start [m, rad].
        forces: (k, 3) of the rocks on each mover over the steps, in W [N].
    """

    times: Array
    travels: dict[str, Array] = field(default_factory=dict)
    forces: dict[str, Array] = field(default_factory=dict)


Drive = Mapping[str, float] | Callable[[Mapping[str, float]], Mapping[str, float]]
"""The movers' speeds or forces by name; or a function of their travels, asked before each step."""


class Rig(Protocol):
    """A scene with rocks in an engine."""

    def advance(self, duration: float, drive: Drive | None = None) -> Record:
        """Go on so long [s]; movers that the drive leaves out stand still, or have no force."""

    def get_pile(self) -> PileState:
        """Return where the rocks are."""
