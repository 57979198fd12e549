"""From material constants to contact parameters."""

from __future__ import annotations

import math


def calc_contact_stiffness(
    elastic_modulus: float, poisson_ratio: float, radius: float, reference_overlap: float
) -> float:
    """Return the stiffness of a contact between two like bodies [N/m].

    Hertz: two spheres of equal material and of radius r meet with F = 4/3 E* sqrt(R) d^1.5, where
    E* = E / (2 (1 - nu^2)) and R = r / 2. The linear contact has the same force at the reference overlap, so
    k = 4/3 E* sqrt(R d_ref).

    Args:
        elastic_modulus: E [Pa].
        poisson_ratio: nu.
        radius: r, of the sphere of the body's volume [m].
        reference_overlap: d_ref [m].
    """
    e_star = elastic_modulus / (2.0 * (1.0 - poisson_ratio**2))
    return 4.0 / 3.0 * e_star * math.sqrt(0.5 * radius * reference_overlap)


def calc_spring_stiffness(
    elastic_modulus: float, poisson_ratio: float, volume: float, reference_overlap: float
) -> float:
    """Return the stiffness of a body's own spring [N/m]: in series, two like ones have that of their contact.

    Args:
        elastic_modulus, poisson_ratio, reference_overlap: as for `calc_contact_stiffness`.
        volume: of the body [m^3].
    """
    radius = (3.0 * volume / (4.0 * math.pi)) ** (1.0 / 3.0)
    return 2.0 * calc_contact_stiffness(elastic_modulus, poisson_ratio, radius, reference_overlap)


def calc_pair_friction(first: float, second: float) -> float:
    """Return the pair's friction coefficient, 2 a b / (a + b), as Drake combines bodies; of smooth ones 0."""
    total = first + second
    return 2.0 * first * second / total if total > 0.0 else 0.0
