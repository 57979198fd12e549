"""How kernels are compiled."""

from numba import types

from drakerock.rocks.engine.compiling import kernel


@kernel
def multiply(value: float, times: int) -> float:
    return value * times


def test_a_kernel_is_compiled_once_whatever_constants_it_is_called_with():
    for constant in (2, 3):
        multiply.get_call_template((types.float64, types.literal(constant)), {})
    assert [signature[1] for signature in multiply.signatures] == [types.int64]
    assert multiply(1.5, 2) == 3.0
