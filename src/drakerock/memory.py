"""Letting Diagrams go: what Python's garbage collector needs to free them (pydrake 1.58).

A Diagram, its systems and their plant refer to each other, so only the collector frees them. It cannot look into C++:
a reference that pydrake holds there, back into the Diagram, keeps all of it for good, tens of MB with a full-size pile.
So a system of ours keeps

- no callback of an abstract port or a cache entry but by `weak` (vector ports and events need no such care);
- no cache entry, body, frame, joint, output port or geometry id of the plant: their indices, and looks them up.

A context has a trap of its own, see `get_own_context`.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from functools import cache
from typing import Any
from weakref import WeakMethod

from pydrake.systems.framework import Context, System


def weak[Result](method: Callable[..., Result]) -> Callable[..., Result]:
    """Return a callable that calls a bound method without keeping the method's object alive."""
    reference = WeakMethod(method)

    def call(*arguments: Any) -> Result:
        bound = reference()
        assert bound is not None, "the system is gone"
        return bound(*arguments)

    return call


def get_own_context(system: System, root_context: Context) -> Context:
    """Return a system's context, to be changed, in that of the Diagram it is a part of; it may be that Diagram itself.

    Asked for the whole Diagram's own context, Drake's `GetMyMutableContextFromRoot` returns the context it was given
    and makes it keep itself alive, all rocks included.
    """
    try:
        system.ValidateContext(root_context)
    except RuntimeError:  # that of a larger Diagram
        return system.GetMyMutableContextFromRoot(root_context)
    return root_context


@cache
def freeze_imports() -> None:
    """Spare the collector what was imported so far: most of what it would look through, again and again.

    For a process of ours, a command's or a worker's, before its first Diagram: what is alive now is never looked at
    again, so a Diagram among it would stay for good.
    """
    gc.freeze()


def free_diagrams() -> None:
    """Free the Diagrams that nobody uses any more.

    The collector comes by itself only after so many new Python objects; that a Diagram's memory in C++ is large, it
    doesn't know.
    """
    gc.collect()
    # The first pass frees wrappers that kept the rest.
    gc.collect()
