"""Where a plant's own geometries touch, by the plant's contact model: points, and surfaces as one point each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import ContactSurface, GeometryId, PenetrationAsPointPair, QueryObject
from pydrake.multibody.plant import ContactModel, MultibodyPlant

# Drake's bound: a face whose pressure grows no faster than this carries nothing [Pa/m].
GROWTH_MIN = 1e-14


@dataclass(frozen=True, eq=False)
class Touch:
    """A contact of two geometries.

    Attributes:
        id_A, id_B: the geometries.
        point: (3,) in W [m].
        normal: (3,) unit, out of B into A.
        depth: [m].
        stiffness: [N/m]; None: as the materials have it.
        share_A: the share of A in the depth; None: as the materials have it.
    """

    id_A: GeometryId
    id_B: GeometryId
    point: list[float]
    normal: list[float]
    depth: float
    stiffness: float | None = None
    share_A: float | None = None


def find_touches(plant: MultibodyPlant, query: QueryObject) -> Iterator[Touch]:
    """Return what touches, in the order that Drake finds it."""
    model = plant.get_contact_model()
    surfaces: list[ContactSurface] = []
    pairs: list[PenetrationAsPointPair] = []
    if model == ContactModel.kPoint:
        pairs = query.ComputePointPairPenetration()
    elif model == ContactModel.kHydroelastic:
        surfaces = query.ComputeContactSurfaces(plant.get_contact_surface_representation())
    else:
        surfaces, pairs = query.ComputeContactSurfacesWithFallback(plant.get_contact_surface_representation())
    for pair in pairs:
        point = 0.5 * (pair.p_WCa + pair.p_WCb)
        yield Touch(pair.id_A, pair.id_B, point.tolist(), pair.nhat_BA_W.tolist(), pair.depth)
    for surface in surfaces:
        yield _reduce(surface)


def _reduce(surface: ContactSurface) -> Touch:
    """Return the point with a surface's force and stiffness: Drake's laws of its faces, summed up."""
    field = surface.tri_e_MN() if surface.is_triangle() else surface.poly_e_MN()
    faces = range(surface.num_faces())
    areas = np.array([surface.area(k) for k in faces])
    centres = np.array([surface.centroid(k) for k in faces])
    normals = np.array([surface.face_normal(k) for k in faces])
    pressures = np.array([field.EvaluateCartesian(k, centres[k]) for k in faces])
    # How fast the pressure grows into either side [Pa/m]; a rigid one does not give way.
    into_M, into_N = np.full(len(faces), np.inf), np.full(len(faces), np.inf)
    if surface.HasGradE_M():
        into_M = np.einsum("fi,fi->f", normals, [surface.EvaluateGradE_M_W(k) for k in faces])
    if surface.HasGradE_N():
        into_N = -np.einsum("fi,fi->f", normals, [surface.EvaluateGradE_N_W(k) for k in faces])
    carrying = (into_M > GROWTH_MIN) & (into_N > GROWTH_MIN) & (pressures > 0.0)
    if not carrying.any():
        return Touch(surface.id_M(), surface.id_N(), [0.0] * 3, [0.0, 0.0, 1.0], 0.0)
    give_M, give_N = 1.0 / into_M[carrying], 1.0 / into_N[carrying]
    forces = (areas * pressures)[carrying]
    force, stiffness = float(forces.sum()), float((areas[carrying] / (give_M + give_N)).sum())
    normal = forces @ normals[carrying]
    return Touch(
        surface.id_M(), surface.id_N(), (forces @ centres[carrying] / force).tolist(),
        (normal / np.linalg.norm(normal)).tolist(), force / stiffness, stiffness,
        float(forces @ give_M / (forces @ (give_M + give_N))),
    )  # fmt: skip
