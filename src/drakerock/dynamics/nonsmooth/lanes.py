"""Vectors of eight numbers inside kernels: one operation does the same to eight contacts.

Compilers make vectors of loops only when they can prove that no turn of the loop meets another. That the contacts
of a batch share no rock is known to us, not to them, so the batch's operations are written as vectors: `Lanes`
stand for a vector while a kernel is compiled, and their arithmetic is what the kernel is to do. Every lane obeys
IEEE arithmetic, so results do not depend on the width of the processor's own vectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir

# Numbers per vector.
LANES = 8

INTEGER = ir.IntType(64)
_VECTOR = ir.VectorType(ir.FloatType(), LANES)
_UNALIGNED = 4  # bytes: arrays start at any number


class Lanes:
    """Eight numbers in single precision that a kernel under compilation holds."""

    def __init__(self, builder: Any, value: Any) -> None:
        """Wrap a value of vector type of LLVM's `builder`."""
        self._builder, self._value = builder, value

    @classmethod
    def fill(cls, builder: Any, number: float) -> Lanes:
        """Return the same number in all lanes."""
        return cls(builder, ir.Constant(_VECTOR, [number] * LANES))

    @classmethod
    def spread(cls, builder: Any, number: Any) -> Lanes:
        """Return a number known only when the kernel runs, in all lanes."""
        empty = ir.Constant(_VECTOR, ir.Undefined)
        one = builder.insert_element(empty, number, ir.Constant(ir.IntType(32), 0))
        mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        return cls(builder, builder.shuffle_vector(one, empty, mask))

    @classmethod
    def load(cls, builder: Any, pointer: Any) -> Lanes:
        """Return the eight numbers at a pointer to a number."""
        address = builder.bitcast(pointer, _VECTOR.as_pointer())
        return cls(builder, builder.load(address, align=_UNALIGNED))

    def store(self, pointer: Any) -> None:
        """Write the eight numbers to a pointer to a number."""
        address = self._builder.bitcast(pointer, _VECTOR.as_pointer())
        self._builder.store(self._value, address, align=_UNALIGNED)

    def __add__(self, other: Lanes) -> Lanes:
        return Lanes(self._builder, self._builder.fadd(self._value, other._value))

    def __sub__(self, other: Lanes) -> Lanes:
        return Lanes(self._builder, self._builder.fsub(self._value, other._value))

    def __mul__(self, other: Lanes) -> Lanes:
        return Lanes(self._builder, self._builder.fmul(self._value, other._value))

    def __truediv__(self, other: Lanes) -> Lanes:
        return Lanes(self._builder, self._builder.fdiv(self._value, other._value))

    def where_above(self, limit: Lanes, then: Lanes, otherwise: Lanes) -> Lanes:
        """Return `then` in lanes above `limit`, elsewhere `otherwise`."""
        condition = self._builder.fcmp_ordered(">", self._value, limit._value)
        return Lanes(self._builder, self._builder.select(condition, then._value, otherwise._value))

    def calc_root(self) -> Lanes:
        """Return the square root."""
        return self._call("sqrt")

    def calc_size(self) -> Lanes:
        """Return the absolute value."""
        return self._call("fabs")

    def _call(self, name: str) -> Lanes:
        name = f"llvm.{name}.v{LANES}f32"
        function = self._builder.module.globals.get(name) or ir.Function(
            self._builder.module, ir.FunctionType(_VECTOR, [_VECTOR]), name
        )
        return Lanes(self._builder, self._builder.call(function, [self._value]))

    def _merge(self, other: Lanes, places: Sequence[int]) -> Lanes:
        """Return lanes picked from these (0..7) and from `other` (8..15)."""
        mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), list(places))
        return Lanes(self._builder, self._builder.shuffle_vector(self._value, other._value, mask))


def transpose(rows: Sequence[Lanes]) -> list[Lanes]:
    """Return the columns of an 8 x 8 matrix given by its rows: pairs, quarters, then halves are exchanged."""
    pairs = []
    for k in range(0, LANES, 2):
        pairs.append(rows[k]._merge(rows[k + 1], (0, 8, 1, 9, 4, 12, 5, 13)))
        pairs.append(rows[k]._merge(rows[k + 1], (2, 10, 3, 11, 6, 14, 7, 15)))
    quarters = []
    for k in (0, 1, 4, 5):
        quarters.append(pairs[k]._merge(pairs[k + 2], (0, 1, 8, 9, 4, 5, 12, 13)))
        quarters.append(pairs[k]._merge(pairs[k + 2], (2, 3, 10, 11, 6, 7, 14, 15)))
    half = LANES // 2
    lower = [quarters[k]._merge(quarters[k + half], (0, 1, 2, 3, 8, 9, 10, 11)) for k in range(half)]
    upper = [quarters[k]._merge(quarters[k + half], (4, 5, 6, 7, 12, 13, 14, 15)) for k in range(half)]
    return lower + upper
