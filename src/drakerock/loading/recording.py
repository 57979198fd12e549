"""A recording: what moved in a cycle, complete enough to draw it again without a plant."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    Mesh,
    Role,
    SceneGraph,
    SceneGraphInspector,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from drakerock.errors import InputError
from drakerock.lhd.model import Machine
from drakerock.npz import load_arrays, save_arrays
from drakerock.rocks.config import SiteConfig
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]
FORMAT = "drakerock-recording"
VERSION = 1


@dataclass(frozen=True, eq=False)
class Visual:
    """A coloured triangle mesh fixed to a body.

    Attributes:
        body: index into the recording's bodies.
        vertices: (k, 3) in the body's frame [m].
        triangles: (m, 3) vertex indices.
        rgba: (4,) in [0, 1].
    """

    body: int
    vertices: NDArray[np.float32]
    triangles: NDArray[np.int32]
    rgba: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames of a cycle.

    Attributes:
        times: (f,) [s].
        modes: (f,) the controller's mode at each frame.
        bodies: names of the machine's bodies.
        X_WBs: (f, b, 7) quaternion (w, x, y, z) and position [m] of each body.
        visuals: the machine's looks.
        rock_shapes: (vertices, triangles) of each shape at sieve width 1.
        rock_shape, rock_size, rock_fixed: (n,) of each rock.
        X_WRs: (n, 7) the rocks' poses in the first frame.
        move_frame, move_rock, move_pose: (m,), (m,), (m, 7) poses of rocks that moved, by frame.
        site: the drift.
        notes: what the viewer shows beside it (objectives, versions, strategy).
    """

    times: Array
    modes: NDArray[np.int64]
    bodies: tuple[str, ...]
    X_WBs: NDArray[np.float32]
    visuals: tuple[Visual, ...]
    rock_shapes: tuple[tuple[Array, NDArray[np.int64]], ...]
    rock_shape: NDArray[np.int64]
    rock_size: Array
    rock_fixed: NDArray[np.bool_]
    X_WRs: Array
    move_frame: NDArray[np.int32]
    move_rock: NDArray[np.int32]
    move_pose: NDArray[np.float32]
    site: SiteConfig
    notes: dict[str, Any]


class Recorder:
    """Collects frames; rocks are kept only in the frames in which they moved."""

    def __init__(
        self,
        plant: MultibodyPlant,
        scene_graph: SceneGraph,
        machine: Machine,
        pile: PileState,
        shapes: tuple[RockShape, ...],
        site: SiteConfig,
        motion_threshold: float,
    ) -> None:
        """Start a recording of `pile` and `machine`; a rock is kept when it moved by the threshold [m]."""
        self._plant = plant
        self._indices = plant.GetBodyIndices(machine.instance)
        self._visuals = _make_visuals(plant, scene_graph, machine)
        self._pile, self._shapes, self._site = pile, shapes, site
        self._threshold = motion_threshold
        self._reach = np.array([shape.radius for shape in shapes])[pile.shape] * pile.size
        self._times: list[float] = []
        self._modes: list[int] = []
        self._bodies: list[Array] = []
        self._first: Array | None = None
        self._last: Array = np.zeros((0, 7))
        self._moves: list[tuple[int, NDArray[np.int64], Array]] = []

    def add(self, time: float, mode: int, body_poses: list[RigidTransform], pile: PileState) -> None:
        """Add a frame: the plant's body poses, and where the rocks are."""
        self._times.append(time)
        self._modes.append(mode)
        self._bodies.append(np.array([_to_vector(body_poses[int(index)]) for index in self._indices]))
        poses = np.hstack([pile.q_WRs, pile.p_WRs])
        if self._first is None:
            self._first, self._last = poses, poses.copy()
            return
        # Most rocks lie where they lay.
        rocks = np.flatnonzero((poses != self._last).any(axis=1))
        change = poses[rocks] - self._last[rocks]
        # A turn of the quaternion by d moves the rock's surface by about 2 d times its radius.
        turned = 2.0 * self._reach[rocks] * np.linalg.norm(change[:, :4], axis=1)
        shifted = np.linalg.norm(change[:, 4:], axis=1)
        moved = rocks[turned + shifted > self._threshold]
        if len(moved):
            self._moves.append((len(self._times) - 1, moved, poses[moved]))
            self._last[moved] = poses[moved]

    def finish(self, notes: dict[str, Any]) -> Recording:
        """Return what was recorded.

        Raises:
            ValueError: no frame was added.
        """
        if self._first is None:
            raise ValueError("nothing was recorded")
        moves = self._moves
        return Recording(
            times=np.array(self._times),
            modes=np.array(self._modes, np.int64),
            bodies=tuple(self._plant.get_body(index).name() for index in self._indices),
            X_WBs=np.array(self._bodies, np.float32),
            visuals=self._visuals,
            rock_shapes=tuple((shape.vertices, shape.triangles) for shape in self._shapes),
            rock_shape=self._pile.shape,
            rock_size=self._pile.size,
            rock_fixed=self._pile.fixed,
            X_WRs=self._first,
            move_frame=np.repeat([f for f, _, _ in moves], [len(r) for _, r, _ in moves]).astype(np.int32),
            move_rock=np.concatenate([r for _, r, _ in moves] or [np.zeros(0, np.int64)]).astype(np.int32),
            move_pose=np.concatenate([p for _, _, p in moves] or [np.zeros((0, 7))]).astype(np.float32),
            site=self._site,
            notes=notes,
        )


def save_recording(recording: Recording, path: str | Path) -> None:
    """Write a recording as npz; InputError if the file cannot be written."""
    header = {
        "bodies": recording.bodies,
        "visual_bodies": [visual.body for visual in recording.visuals],
        "n_shapes": len(recording.rock_shapes),
        "site": recording.site.model_dump(mode="json"),
        "notes": recording.notes,
    }
    arrays = {name: getattr(recording, name) for name in _ARRAYS}
    for k, visual in enumerate(recording.visuals):
        arrays |= {f"visual_{k}_{name}": getattr(visual, name) for name in ("vertices", "triangles", "rgba")}
    for k, (vertices, triangles) in enumerate(recording.rock_shapes):
        arrays |= {f"shape_{k}_vertices": vertices, f"shape_{k}_triangles": triangles}
    save_arrays(path, FORMAT, VERSION, header, arrays)


def load_recording(path: str | Path) -> Recording:
    """Read a recording; InputError if it is missing, foreign, damaged or newer."""
    header, data = load_arrays(path, FORMAT, VERSION)
    try:
        visuals = tuple(
            Visual(body, *(data[f"visual_{k}_{name}"] for name in ("vertices", "triangles", "rgba")))
            for k, body in enumerate(header["visual_bodies"])
        )
        shapes = tuple(
            (data[f"shape_{k}_vertices"], data[f"shape_{k}_triangles"]) for k in range(header["n_shapes"])
        )
        recording = Recording(
            bodies=tuple(header["bodies"]),
            visuals=visuals,
            rock_shapes=shapes,
            site=SiteConfig(**header["site"]),
            notes=dict(header["notes"]),
            **{name: data[name] for name in _ARRAYS},
        )
        _check_recording(recording)
    except KeyError as error:
        raise InputError(f"{path}: not a readable recording: {error} is missing") from None
    except (ValueError, TypeError) as error:
        message = " ".join(str(error).split())
        raise InputError(f"{path}: not a readable recording: {message}") from None
    return recording


def _check_recording(recording: Recording) -> None:
    """Raise a ValueError if arrays do not fit each other, or indices point at nothing."""
    f, b, n, m = (
        len(recording.times),
        len(recording.bodies),
        len(recording.rock_size),
        len(recording.move_rock),
    )
    expected = {
        "times": (f,), "modes": (f,), "X_WBs": (f, b, 7), "rock_shape": (n,), "rock_size": (n,), "rock_fixed": (n,),
        "X_WRs": (n, 7), "move_frame": (m,), "move_rock": (m,), "move_pose": (m, 7),
    }  # fmt: skip
    if not f or not all(isinstance(name, str) for name in recording.bodies):
        raise ValueError("no frames, or bodies without names")
    for name, form in expected.items():
        _check_array(name, getattr(recording, name), form)
    indices = {"rock_shape": len(recording.rock_shapes), "move_frame": f, "move_rock": n}
    for name, end in indices.items():
        _check_indices(name, getattr(recording, name), end)
    meshes: list[tuple[NDArray[Any], NDArray[Any]]] = list(recording.rock_shapes)
    meshes += [(visual.vertices, visual.triangles) for visual in recording.visuals]
    for vertices, triangles in meshes:
        _check_array("vertices", vertices, (len(vertices), 3))
        _check_array("triangles", triangles, (len(triangles), 3))
        _check_indices("triangles", triangles, len(vertices))
    for visual in recording.visuals:
        _check_array("rgba", visual.rgba, (4,))
        _check_indices("visual_bodies", np.asarray(visual.body), b)


def _check_array(name: str, array: NDArray[Any], form: tuple[int, ...]) -> None:
    if array.shape != form:
        raise ValueError(f"{name}: shape {array.shape} instead of {form}")
    if array.dtype.kind not in "fiub" or not np.isfinite(array).all():
        raise ValueError(f"{name}: holds {array.dtype} or numbers that are not finite")


def _check_indices(name: str, array: NDArray[Any], end: int) -> None:
    if array.dtype.kind not in "iu" or ((array < 0) | (array >= end)).any():
        raise ValueError(f"{name}: an index beyond {end - 1}")


_ARRAYS = (
    "times", "modes", "X_WBs", "rock_shape", "rock_size", "rock_fixed", "X_WRs",
    "move_frame", "move_rock", "move_pose",
)  # fmt: skip


def _to_vector(X: RigidTransform) -> Array:
    return np.concatenate([X.rotation().ToQuaternion().wxyz(), X.translation()])


def _make_visuals(plant: MultibodyPlant, scene_graph: SceneGraph, machine: Machine) -> tuple[Visual, ...]:
    """Return the illustration geometry of the machine as triangle meshes."""
    inspector = scene_graph.model_inspector()
    visuals = []
    for k, index in enumerate(plant.GetBodyIndices(machine.instance)):
        frame = plant.GetBodyFrameIdOrThrow(index)
        for geometry in inspector.GetGeometries(frame, Role.kIllustration):
            mesh = _make_mesh(inspector, geometry)
            mesh.apply_transform(inspector.GetPoseInFrame(geometry).GetAsMatrix4())
            properties = inspector.GetIllustrationProperties(geometry)
            rgba = [0.85, 0.65, 0.1, 1.0]
            if properties.HasProperty("phong", "diffuse"):
                color = properties.GetProperty("phong", "diffuse")
                rgba = [color.r(), color.g(), color.b(), color.a()]
            visuals.append(
                Visual(
                    k,
                    np.asarray(mesh.vertices, np.float32),
                    np.asarray(mesh.faces, np.int32),
                    np.array(rgba, np.float32),
                )
            )
    return tuple(visuals)


def _make_mesh(inspector: SceneGraphInspector, geometry: Any) -> trimesh.Trimesh:
    shape: Shape = inspector.GetShape(geometry)
    if isinstance(shape, Box):
        return trimesh.creation.box(shape.size())
    if isinstance(shape, Cylinder):
        return trimesh.creation.cylinder(shape.radius(), shape.length(), sections=32)
    if isinstance(shape, Capsule):
        return trimesh.creation.capsule(shape.length(), shape.radius(), count=[16, 16])
    if isinstance(shape, Sphere):
        return trimesh.creation.icosphere(3, shape.radius())
    if isinstance(shape, Ellipsoid):
        mesh = trimesh.creation.icosphere(3)
        mesh.apply_scale([shape.a(), shape.b(), shape.c()])
        return mesh
    if isinstance(shape, Convex) or (isinstance(shape, Mesh) and not shape.source().is_path()):
        hull = inspector.GetConvexHull(geometry)
        return trimesh.convex.convex_hull(np.array([hull.vertex(i) for i in range(hull.num_vertices())]))
    if isinstance(shape, Mesh):
        mesh = trimesh.load_mesh(shape.source().path())
        mesh.apply_scale(shape.scale3())
        return mesh
    raise InputError(f"visual shape {type(shape).__name__} of {inspector.GetName(geometry)} cannot be drawn")
