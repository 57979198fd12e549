"""Spin damping: rocks that swing on two points come to rest.

Two bodies in contact turn against each other with the relative spin w = w_B - w_A. An impulse along w of size
s |w| / M, with M = n . (I_A^-1 + I_B^-1) n the mobility along its direction n, takes the share s from it and keeps the
angular momentum. Measured by the rocks' own inertia, it is nothing beside the moments of contacts under load.
"""

from __future__ import annotations

from drakerock.rocks.engine.compiling import Array, kernel
from drakerock.rocks.engine.solve.rows import ContactRows
from drakerock.rocks.engine.vectors import dot, get_vector, multiply_symmetric, subtract


@kernel
def damp_spin(n_rows: int, rows: ContactRows, share: float, bodies: Array) -> None:
    """Take a small share from the relative spin of rocks at each of their contacts that carried load.

    Contacts of the machine are left out.

    Reads:
        n_rows, rows: contact rows with the impulses of the last step.
        share: of the relative spin.
    Writes:
        bodies: (n + 1,) angular velocities.
    """
    for k in range(n_rows):
        a, b = rows.body_a[k], rows.body_b[k]
        if rows.values[k].impulse[0] <= 0.0 or b >= len(bodies):
            continue
        one, other = bodies[a], bodies[b]
        spin = subtract(get_vector(other.angular), get_vector(one.angular))
        turning_a = multiply_symmetric(one.inverse_inertia, spin)
        turning_b = multiply_symmetric(other.inverse_inertia, spin)
        mobility = (
            spin[0] * (turning_a[0] + turning_b[0])
            + spin[1] * (turning_a[1] + turning_b[1])
            + spin[2] * (turning_a[2] + turning_b[2])
        )
        if mobility <= 0.0:
            continue
        factor = share * dot(spin, spin) / mobility
        for d in range(3):
            one.angular[d] += factor * turning_a[d]
            other.angular[d] -= factor * turning_b[d]
