"""How kernels are compiled."""

from numba import types

from drakerock.rocks.engine.compiling import kernel


@kernel
def multiply(value: float, times: int) -> float:
    return value * times


def test_a_kernel_is_compiled_once_whatever_constants_it_is_called_with():
    for constant in (2, 3):
        multiply.get_call_template((types.float64, types.literal(constant)), {})
    assert [signature[1] for signature in multiply.inlined.signatures] == [types.int64]
    assert multiply(1.5, 2) == 3.0


@kernel
def double_twice(value: float) -> float:
    return multiply(multiply(value, 2), 2)


def test_a_kernel_that_only_kernels_call_has_no_entry_for_python():
    assert double_twice(1.5) == 6.0
    (library,) = (item.library for item in double_twice.overloads.values())
    (inlined,) = (item.library for item in multiply.inlined.overloads.values())
    for item, has_entry in ((library, True), (inlined, False)):
        names = [function.name for function in item.get_defined_functions()]
        assert any("cpython" in name for name in names) == has_entry
