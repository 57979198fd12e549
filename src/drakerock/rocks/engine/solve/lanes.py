"""Vectors of numbers inside kernels: one operation does the same to sixteen contacts.

Compilers make vectors of loops only when they can prove that no turn of the loop meets another. That the contacts of
a batch share no rock is known to us, not to them, so the batch's operations are written as vectors: `Lanes` stand for
numbers side by side while a kernel is compiled, and their arithmetic is what the kernel is to do. Every lane obeys
IEEE arithmetic, so results do not depend on the width of the processor's own vectors.

Sixteen lanes are two of the processor's vectors. What a contact's update does is one long chain of operations, each
of which waits for the one before; with two chains side by side the processor need not wait.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir

# Numbers per vector of the processor, and per batch.
WIDTH = 8
LANES = 16

INTEGER = ir.IntType(64)
_VECTOR = ir.VectorType(ir.FloatType(), WIDTH)
_UNALIGNED = 4  # bytes: arrays start at any number


class Lanes:
    """Numbers in single precision, one or several vectors of them, that a kernel under compilation holds."""

    def __init__(self, builder: Any, vectors: Sequence[Any]) -> None:
        """Wrap values of vector type of LLVM's `builder`."""
        self._builder, self._vectors = builder, tuple(vectors)

    @classmethod
    def fill(cls, builder: Any, number: float, lanes: int = LANES) -> Lanes:
        """Return the same number in all lanes."""
        return cls(builder, [ir.Constant(_VECTOR, [number] * WIDTH)] * (lanes // WIDTH))

    @classmethod
    def spread(cls, builder: Any, number: Any, lanes: int = LANES) -> Lanes:
        """Return a number known only when the kernel runs, in all lanes."""
        empty = ir.Constant(_VECTOR, ir.Undefined)
        one = builder.insert_element(empty, number, ir.Constant(ir.IntType(32), 0))
        mask = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
        return cls(builder, [builder.shuffle_vector(one, empty, mask)] * (lanes // WIDTH))

    @classmethod
    def load(cls, builder: Any, pointer: Any, lanes: int = LANES) -> Lanes:
        """Return the numbers at a pointer to a number."""
        return cls(builder, [_load(builder, pointer, start) for start in range(0, lanes, WIDTH)])

    def store(self, pointer: Any) -> None:
        """Write the numbers to a pointer to a number."""
        for k, vector in enumerate(self._vectors):
            _store(self._builder, vector, pointer, k * WIDTH)

    def __add__(self, other: Lanes) -> Lanes:
        return self._map(self._builder.fadd, other)

    def __sub__(self, other: Lanes) -> Lanes:
        return self._map(self._builder.fsub, other)

    def __mul__(self, other: Lanes) -> Lanes:
        return self._map(self._builder.fmul, other)

    def __truediv__(self, other: Lanes) -> Lanes:
        return self._map(self._builder.fdiv, other)

    def __neg__(self) -> Lanes:
        return self._map(self._builder.fneg)

    def times_plus(self, factor: Lanes, term: Lanes) -> Lanes:
        """Return ``self * factor + term``, rounded once: half the operations, and the same bits everywhere."""
        return self._call("fma", factor, term)

    def where_above(self, limit: Lanes, then: Lanes, otherwise: Lanes) -> Lanes:
        """Return `then` in lanes above `limit`, elsewhere `otherwise`."""

        def pick(value: Any, bound: Any, one: Any, other: Any) -> Any:
            return self._builder.select(self._builder.fcmp_ordered(">", value, bound), one, other)

        return self._map(pick, limit, then, otherwise)

    def calc_root(self) -> Lanes:
        """Return the square root."""
        return self._call("sqrt")

    def calc_size(self) -> Lanes:
        """Return the absolute value."""
        return self._call("fabs")

    def _call(self, name: str, *others: Lanes) -> Lanes:
        name = f"llvm.{name}.v{WIDTH}f32"
        function = self._builder.module.globals.get(name) or ir.Function(
            self._builder.module, ir.FunctionType(_VECTOR, [_VECTOR] * (1 + len(others))), name
        )
        return self._map(lambda *values: self._builder.call(function, values), *others)

    def _map(self, operation: Any, *others: Lanes) -> Lanes:
        columns = zip(self._vectors, *(other._vectors for other in others), strict=True)
        return Lanes(self._builder, [operation(*values) for values in columns])


def gather(builder: Any, pointers: Sequence[Any]) -> list[Lanes]:
    """Return the eight numbers at each of sixteen pointers as eight columns of sixteen lanes."""
    blocks = [
        _transpose(builder, [_load(builder, pointer, 0) for pointer in pointers[start : start + WIDTH]])
        for start in range(0, len(pointers), WIDTH)
    ]
    return [Lanes(builder, column) for column in zip(*blocks, strict=True)]


def scatter(builder: Any, pointers: Sequence[Any], columns: Sequence[Lanes]) -> None:
    """Write eight columns of sixteen lanes to sixteen pointers, eight numbers each."""
    for block, start in enumerate(range(0, len(pointers), WIDTH)):
        rows = _transpose(builder, [column._vectors[block] for column in columns])
        for pointer, row in zip(pointers[start : start + WIDTH], rows, strict=True):
            _store(builder, row, pointer, 0)


def _find(builder: Any, pointer: Any, start: int) -> Any:
    return builder.bitcast(builder.gep(pointer, [ir.Constant(INTEGER, start)]), _VECTOR.as_pointer())


def _load(builder: Any, pointer: Any, start: int) -> Any:
    return builder.load(_find(builder, pointer, start), align=_UNALIGNED)


def _store(builder: Any, vector: Any, pointer: Any, start: int) -> None:
    builder.store(vector, _find(builder, pointer, start), align=_UNALIGNED)


def _transpose(builder: Any, rows: Sequence[Any]) -> list[Any]:
    """Return the columns of an 8 x 8 matrix given by its rows: pairs, quarters, then halves are exchanged."""

    def merge(one: Any, other: Any, places: Sequence[int]) -> Any:
        """Return lanes picked from one (0..7) and from the other (8..15)."""
        mask = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), list(places))
        return builder.shuffle_vector(one, other, mask)

    pairs = []
    for k in range(0, WIDTH, 2):
        pairs.append(merge(rows[k], rows[k + 1], (0, 8, 1, 9, 4, 12, 5, 13)))
        pairs.append(merge(rows[k], rows[k + 1], (2, 10, 3, 11, 6, 14, 7, 15)))
    quarters = []
    for k in (0, 1, 4, 5):
        quarters.append(merge(pairs[k], pairs[k + 2], (0, 1, 8, 9, 4, 5, 12, 13)))
        quarters.append(merge(pairs[k], pairs[k + 2], (2, 3, 10, 11, 6, 7, 14, 15)))
    half = WIDTH // 2
    lower = [merge(quarters[k], quarters[k + half], (0, 1, 2, 3, 8, 9, 10, 11)) for k in range(half)]
    upper = [merge(quarters[k], quarters[k + half], (4, 5, 6, 7, 12, 13, 14, 15)) for k in range(half)]
    return lower + upper
