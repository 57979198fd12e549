"""The contact law: what force a contact has, and the update of one contact's impulses.

A point of body A and one of body B are apart by a gap g along the unit normal n. Their relative velocity d has the
normal part u = n . d and two tangential parts s. Over a step of length h the normal impulse is p, the friction
impulse q.

Normal direction. A spring of stiffness k about the overlap -g, damped so that it decays within a time tau, is stepped
implicitly (SPOOK: Lacoursiere 2007). That gives a complementarity problem with one compliance c and one bias b:

    u + c p >= b,   p >= 0,   p (u + c p - b) = 0
    gap g > 0:   c = 0,                  b = -g / h                    they may just meet
    overlap:     c = 4 Y / (h^2 k),      b = -4 Y g / (m h)            Y = 1 / (1 + 4 tau / h)

Hertz's law F = H sqrt(R) (-g)^(3/2), with H = 4/3 of the effective modulus and 1 / R = 1 / R_A + 1 / R_B, has the
tangent stiffness k = dF/dg = 3/2 H sqrt(R (-g)); a spring of that stiffness has the force F if it is stretched by
-g / m with m = 3/2, the power of the law. The linear law has k = 1 / (c_A + c_B), springs in series, and m = 1. Either
way a pair's compliance is the sum of what its two bodies contribute, 1 / R or 1 / k.

An overlap gives at most the speed v: b is bounded by v + c p0 - 4 Y w, to which Y w is added. p0 is the impulse of the
last step and w = min(u0, 0) the approach before this one, so what the contact carries is never bounded.

Impacts. A pair that approaches faster than a threshold is rigid, c = 0, for that step. With a coefficient of
restitution e it aims at b = -e u0 in a stage of its own (Newton's law).

Tangential direction. Coulomb: |q| <= mu p, against the slip. In an update of one contact with normal mobility M_n,
tangential mobility M_t (2 x 2) and the coupling m_t between them,

    p' = max(p - (u + c p - b) / (M_n + c), 0)
    s' = s + m_t (p' - p)
    q' = q - M_t^-1 s'                     if |q'| <= mu p': it sticks
    q' = project(q - 2 / trace(M_t) s')    on |q'| <= mu p', else: it slides, and the step is along the slip
"""

from __future__ import annotations

import math
from typing import NamedTuple

from drakerock.rocks.engine.compiling import Record, Vector, kernel
from drakerock.rocks.engine.vectors import add, dot, get_vector, scale, set_vector

# Below this overlap Hertz's stiffness is constant, or it would vanish where contact begins [m].
MIN_OVERLAP = 1e-5


class ContactLaw(NamedTuple):
    """Constants of the law.

    Attributes:
        hertz: 4/3 of the effective modulus [Pa].
        linear: the linear law instead of Hertz's, also for what comes near.
        time_step: h [s].
        damping: Y = 1 / (1 + 4 tau / h).
        max_recovery_speed: v [m/s].
        impact_threshold: what approaches faster is an impact [m/s].
    """

    hertz: float
    linear: bool
    time_step: float
    damping: float
    max_recovery_speed: float
    impact_threshold: float


@kernel
def calc_stiffness(gap: float, pair_compliance: float, law: ContactLaw) -> tuple[float, float]:
    """Return the stiffness k at an overlap [N/m] and the power m of the law.

    Args:
        gap: negative [m].
        pair_compliance: 1 / R [1/m], or by the linear law 1 / k [m/N].
        law: constants.
    """
    if law.linear:
        return 1.0 / pair_compliance, 1.0
    return 1.5 * law.hertz * math.sqrt(max(-gap, MIN_OVERLAP) / pair_compliance), 1.5


@kernel
def calc_normal_law(
    gap: float, approach: float, load: float, pair_compliance: float, law: ContactLaw
) -> tuple[float, float]:
    """Return bias b [m/s] and compliance c [1/kg] of a contact's normal constraint.

    Args:
        gap: [m].
        approach: normal velocity before the step, negative if they approach [m/s].
        load: normal impulse of the last step [N s].
        pair_compliance: see `calc_stiffness`.
        law: constants.
    """
    time_step, damping = law.time_step, law.damping
    rigid = approach < -law.impact_threshold
    if gap > 0.0:
        compliance = pair_compliance / (time_step * time_step) if law.linear and not rigid else 0.0
        return -gap / time_step, compliance
    stiffness, power = calc_stiffness(gap, pair_compliance, law)
    bias = -4.0 * damping * (1.0 / power) * gap / time_step
    if rigid:
        return min(bias, law.max_recovery_speed), 0.0
    compliance = 4.0 * damping / (stiffness * time_step * time_step)
    closing = min(approach, 0.0)
    carried = compliance * load - 4.0 * damping * closing
    return min(bias, law.max_recovery_speed + carried) + damping * closing, compliance


@kernel
def is_impact(gap: float, approach: float, law: ContactLaw) -> bool:
    """Return whether a pair meets within the step, faster than the threshold."""
    return bool(approach < -law.impact_threshold and gap + law.time_step * approach < 0.0)


@kernel
def get_impulse(row: Record) -> Vector:
    """Return a row's impulse in W [N s]."""
    normal, one, two = get_vector(row.impulse)
    return (
        normal * row.normal[0] + one * row.tangent_1[0] + two * row.tangent_2[0],
        normal * row.normal[1] + one * row.tangent_1[1] + two * row.tangent_2[1],
        normal * row.normal[2] + one * row.tangent_1[2] + two * row.tangent_2[2],
    )


@kernel
def clip_friction(row: Record) -> None:
    """Shorten a row's friction impulse to what its normal impulse allows."""
    impulse = row.impulse
    limit = row.friction * impulse[0]
    slip = math.sqrt(impulse[1] ** 2 + impulse[2] ** 2)
    if slip > limit:
        impulse[1] *= limit / slip
        impulse[2] *= limit / slip


@kernel
def update_impulse(d: Vector, row: Record) -> tuple[Vector, float]:
    """Update a row's impulses for a relative velocity d; return the impulse's change in W and its normal part."""
    normal, impulse = get_vector(row.normal), row.impulse
    old = impulse[0]
    new = old - (dot(normal, d) + row.compliance * old - row.bias) * row.normal_mass
    if new <= 0.0:
        if old == 0.0:
            return (0.0, 0.0, 0.0), 0.0
        new = 0.0
    change = new - old
    tangent_1, tangent_2 = get_vector(row.tangent_1), get_vector(row.tangent_2)
    slip_1 = dot(tangent_1, d) + row.coupling[0] * change
    slip_2 = dot(tangent_2, d) + row.coupling[1] * change
    mass_11, mass_12, mass_22 = get_vector(row.tangent_mass)
    old_1, old_2 = impulse[1], impulse[2]
    new_1 = old_1 - (mass_11 * slip_1 + mass_12 * slip_2)
    new_2 = old_2 - (mass_12 * slip_1 + mass_22 * slip_2)
    limit = row.friction * new
    size2 = new_1 * new_1 + new_2 * new_2
    if size2 > limit * limit:
        # A step with the matrix would turn the force away from the slip.
        new_1 = old_1 - row.tangent_step * slip_1
        new_2 = old_2 - row.tangent_step * slip_2
        size2 = new_1 * new_1 + new_2 * new_2
        if size2 > limit * limit:
            factor = limit / math.sqrt(size2)
            new_1 *= factor
            new_2 *= factor
    set_vector((new, new_1, new_2), impulse)
    new_1 -= old_1
    new_2 -= old_2
    return add(add(scale(change, normal), scale(new_1, tangent_1)), scale(new_2, tangent_2)), change
