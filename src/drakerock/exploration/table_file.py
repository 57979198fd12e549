"""The file of a table: CSV as spreadsheets and programs write it, or Parquet.

What differs from the plain form (commas, decimal points, the names as they are asked for) is taken where there is one
reading only, and noted; otherwise an `InputError` says what was found. No error of a library gets out.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from drakerock.errors import InputError
from drakerock.exploration.problem import MAX_MAGNITUDE, Array

_EMPTY = {"", "na", "n/a", "#n/a", "nan", "-nan", "null", "none"}
_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?", re.ASCII)
# Reads as a number with a decimal comma, and as one with thousands set apart.
_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+", re.ASCII)
_DATE = re.compile(
    r"\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}.*|\d{1,2}[-. ][A-Za-z]{3}.*|[A-Za-z]{3}[-. ]\d{2,4}", re.ASCII
)


@dataclass
class TableFile:
    """The columns of a file.

    Attributes:
        source: the file's name, for messages.
        headers: the columns' names as they stand there.
        cells: one sequence per column: texts (CSV), or an Arrow array (Parquet).
        places: of each row, in words, such as ``line 7``.
        metadata: key and value bytes (Parquet).
        notes: what was taken for something else than it looks.
    """

    source: str
    headers: list[str]
    cells: list[Any]
    places: Sequence[str]
    metadata: Mapping[bytes, bytes] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    _found: dict[str, int] = field(default_factory=dict)
    _decimal_comma: bool = False

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.places)

    def __contains__(self, name: str) -> bool:
        """Return whether a name that was looked for (`find_columns`) has a column."""
        return name in self._found

    def find_columns(self, names: Sequence[str]) -> None:
        """Look for columns: by their very names, then by ones that differ in case, spaces or a unit.

        Raises:
            InputError: two columns for one name.
        """
        wanted = [name for name in dict.fromkeys(names) if name not in self._found]
        for name in wanted:
            places = [i for i, header in enumerate(self.headers) if header == name]
            if len(places) > 1:
                shown = " and ".join(str(i + 1) for i in places)
                raise InputError(f"{self.source}: several columns are called '{name}' (columns {shown})")
            if places:
                self._found[name] = places[0]
        forms = [_simplify(name) for name in wanted]
        taken = set(self._found.values())
        for name, form in zip(wanted, forms, strict=True):
            if name in self._found or forms.count(form) > 1:
                continue
            near = [
                i for i, header in enumerate(self.headers) if i not in taken and _simplify(header) == form
            ]
            if len(near) > 1:
                shown = " and ".join(f"'{self.headers[i]}'" for i in near)
                raise InputError(f"{self.source}: the columns {shown} may both be '{name}'")
            if near:
                self._found[name] = near[0]
                self.notes.append(f"column '{self.headers[near[0]]}' is taken as '{name}'")

    def get_header_unit(self, name: str) -> str:
        """Return the unit that stands in a column's header, such as ``kg`` of ``debris [kg]``; "" if none does."""
        return _split_unit(self.headers[self._found[name]])[1]

    def get_texts(self, name: str) -> list[str]:
        """Return a column as texts, "" where a cell is empty."""
        cells = self.cells[self._found[name]]
        if isinstance(cells, list):
            return cells
        kind = cells.type
        if not (
            _is_text(kind)
            or pa.types.is_integer(kind)
            or pa.types.is_floating(kind)
            or pa.types.is_null(kind)
        ):
            raise InputError(f"{self.source}: column '{name}' holds {kind}; allowed are texts")
        return ["" if value is None else str(value) for value in self._unpack(name, cells)]

    def get_numbers(self, name: str) -> Array:
        """Return a column as numbers, NaN where a cell is empty.

        Raises:
            InputError: something else than numbers, or a number too large to calculate with.
        """
        cells = self.cells[self._found[name]]
        if isinstance(cells, list):
            return self._parse(name, cells)
        kind = cells.type
        if _is_text(kind):
            return self._parse(name, ["" if value is None else value for value in self._unpack(name, cells)])
        number = pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind)
        if not number and not pa.types.is_null(kind):
            raise InputError(f"{self.source}: column '{name}' holds {kind}; allowed are numbers")
        values = np.array([np.nan if v is None else float(v) for v in self._unpack(name, cells)], dtype=float)
        for i in np.flatnonzero(np.abs(values) > MAX_MAGNITUDE):
            raise self._refuse(name, f"{values[i]:g}", int(i))
        return values

    def _refuse(self, name: str, cell: str, row: int) -> InputError:
        hint = " (a date; did a spreadsheet change it?)" if _DATE.fullmatch(cell) else ""
        if _NUMBER.fullmatch(cell) or cell in ("inf", "-inf"):
            hint = f" (too large: up to {MAX_MAGNITUDE:g})"
        return InputError(
            f"{self.source}: column '{name}' has a value that is no number: '{cell[:40]}' in {self.places[row]}{hint}"
        )

    def _unpack(self, name: str, cells: Any) -> list[Any]:
        try:
            return list(cells.to_pylist())
        except Exception as error:  # whatever pyarrow makes of damaged data
            raise InputError(f"{self.source}: column '{name}' cannot be read: {_describe(error)}") from None

    def _parse(self, name: str, cells: Sequence[str]) -> Array:
        values = np.full(len(cells), np.nan)
        for i, cell in enumerate(cells):
            text = cell.strip()
            if text.casefold() in _EMPTY:
                continue
            plain = text.replace(",", ".") if self._decimal_comma and _COMMA.fullmatch(text) else text
            if not _NUMBER.fullmatch(plain):
                raise self._refuse(name, text, i)
            values[i] = float(plain)
            if not abs(values[i]) <= MAX_MAGNITUDE:
                raise self._refuse(name, text, i)
        return values

    def find_decimal_comma(self, names: Sequence[str]) -> None:
        """Decide from these columns, where they are there, whether numbers have decimal commas.

        Raises:
            InputError: it cannot be told.
        """
        texts = [
            self.cells[self._found[n]]
            for n in names
            if n in self and isinstance(self.cells[self._found[n]], list)
        ]
        cells = [text.strip() for column in texts for text in column]
        commas = [cell for cell in cells if _COMMA.fullmatch(cell) or _GROUPED.fullmatch(cell)]
        if not commas:
            return
        points = [cell for cell in cells if "." in cell and _NUMBER.fullmatch(cell)]
        if points:
            raise InputError(
                f"{self.source}: numbers with a comma ('{commas[0]}') and with a decimal point ('{points[0]}')"
            )
        if all(_GROUPED.fullmatch(cell) for cell in commas):
            raise InputError(
                f"{self.source}: '{commas[0]}' may be a number with a decimal comma or a large one; write a decimal "
                "point, and no commas in large numbers"
            )
        self._decimal_comma = True
        self.notes.append("commas in numbers are taken as decimal commas")

    def drop_units_row(self, units: Mapping[str, str]) -> None:
        """Take away a first row that holds the units of the columns (by name) instead of numbers.

        Raises:
            InputError: it holds other units.
        """
        if not len(self) or not all(isinstance(column, list) for column in self.cells):
            return
        cells = {name: self.cells[self._found[name]][0].strip() for name in units}
        texts = [cell for cell in cells.values() if cell.casefold() not in _EMPTY]
        if not texts or any(_is_numeric(text) or _DATE.fullmatch(text) for text in texts):
            return
        self.notes.append(f"{self.places[0]} is taken as the columns' units")
        for name, cell in cells.items():
            self.check_unit(name, _split_unit(cell)[1] or cell, units[name])
        self.cells = [column[1:] for column in self.cells]
        self.places = self.places[1:]

    def check_unit(self, name: str, unit: str, wanted: str) -> None:
        """Raise an InputError if a unit that stands in the file is another one than is `wanted`."""
        plain = {"", "-", "1"}
        if unit not in plain and wanted not in plain and unit != wanted:
            raise InputError(f"{self.source}: {name} is in {unit}, and must be in {wanted}")


def read_parquet(path: Path) -> TableFile:
    """Read a Parquet file.

    Raises:
        InputError: it cannot be read.
    """
    try:
        with pyarrow.parquet.ParquetFile(path) as file:
            arrow = file.read()
        arrow.validate(full=True)
        columns = [_decode_dictionary(arrow.column(i)) for i in range(arrow.num_columns)]
        headers, metadata = list(arrow.schema.names), dict(arrow.schema.metadata or {})
    except Exception as error:  # whatever pyarrow makes of a damaged file
        raise InputError(f"{path}: cannot be read as a table: {_describe(error)}") from None
    return TableFile(str(path), headers, columns, [f"row {i + 1}" for i in range(arrow.num_rows)], metadata)


def read_csv(path: Path, needed: Sequence[str]) -> TableFile:
    """Read a file of separated values; `needed` are names of columns by which header and separator are found.

    Raises:
        InputError: it cannot be read, or in several ways.
    """
    text, notes = _read_text(path)
    lines = list(io.StringIO(text, newline=""))
    at, header, separator, comments = _find_header(path, lines, needed)
    if separator != ",":
        notes.append(f"cells are separated by {_SEPARATORS[separator]}")
    rows = _split(path, [header, *lines[at + 1 :]], separator, at)
    _, names = next(rows)
    file = TableFile(str(path), names, [[] for _ in names], [], notes=notes)
    file.find_columns(needed)
    places: list[str] = []
    for number, row in rows:
        if not any(cell.strip() for cell in row):
            continue
        if lines[number - 1].lstrip().startswith("#"):
            if len(row) == len(names) and any(_is_numeric(row[file._found[n]]) for n in needed if n in file):
                raise InputError(
                    f"{path}: line {number} may be a comment or a point called '{row[0]}': quote the name, or remove "
                    "the line"
                )
            comments += 1
            continue
        extra = [cell for cell in row[len(names) :] if cell.strip()]
        if extra or len(row) < len(names):
            hint = "; decimal commas need semicolons between the cells" if extra and separator == "," else ""
            raise InputError(f"{path}: line {number} has {len(row)} cells, the header {len(names)}{hint}")
        for column, cell in zip(file.cells, row, strict=False):
            column.append(cell)
        places.append(f"line {number}")
    file.places = places
    if comments:
        notes.append("lines that begin with # are taken as comments")
    return file


def _read_text(path: Path) -> tuple[str, list[str]]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise InputError(
            f"{path}: not UTF-8 text (byte {data[error.start] if error.start < len(data) else 0:#04x} in line {line}); "
            "save it as CSV with the encoding UTF-8"
        ) from None
    if "\0" in text:
        raise InputError(
            f"{path}: not a text file (it holds zero bytes); save it as CSV with the encoding UTF-8"
        )
    return text, ["the text is taken as UTF-16"] if encoding == "utf-16" else []


def _find_header(path: Path, lines: Sequence[str], needed: Sequence[str]) -> tuple[int, str, str, int]:
    """Return index and text of the header's line, the separator, and the number of comment lines before it."""
    comments, wanted = 0, {_simplify(name) for name in needed}

    def count(line: str, separator: str) -> tuple[int, int]:
        cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
        return len(wanted & {_simplify(cell) for cell in cells}), len(cells)

    for at, line in enumerate(lines):
        plain = line.strip(" \r\n")
        header = plain.lstrip("# ")
        if re.fullmatch(r"sep=[,;\t]", plain, re.IGNORECASE):
            continue  # a hint of spreadsheets to themselves
        try:
            (found, _), best = max((count(header, separator), separator) for separator in "\t;,")
        except csv.Error as error:
            raise InputError(f"{path}: line {at + 1}: {error}") from None
        if plain.startswith("#") and found < len(wanted):
            comments += 1
        elif plain.strip():
            return at, header if plain.startswith("#") else line, best, comments
    raise InputError(f"{path}: an empty file; needed is a header with {', '.join(needed)}")


def _split(path: Path, lines: list[str], separator: str, before: int) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of each row's first line and its cells."""
    reader = csv.reader(lines, delimiter=separator, strict=True, skipinitialspace=True)
    while True:
        number = before + reader.line_num + 1
        try:
            row = next(reader)
        except StopIteration:
            return
        except csv.Error as error:
            raise InputError(f"{path}: line {number}: {error}") from None
        yield number, row


def _decode_dictionary(column: Any) -> Any:
    return column.cast(column.type.value_type) if pa.types.is_dictionary(column.type) else column


def _is_text(kind: Any) -> bool:
    return any(test(kind) for test in (pa.types.is_string, pa.types.is_large_string, pa.types.is_string_view))


def _is_numeric(cell: str) -> bool:
    text = cell.strip()
    return bool(_NUMBER.fullmatch(text) or _COMMA.fullmatch(text) or _GROUPED.fullmatch(text))


def _split_unit(text: str) -> tuple[str, str]:
    """Return a text without the unit in brackets at its end, and that unit, "" if there is none."""
    text = text.strip()
    start = max(text.rfind("["), text.rfind("("))
    if start < 0 or text[-1] not in "])":
        return text, ""
    return text[:start].strip(), text[start + 1 : -1].strip()


def _simplify(header: str) -> str:
    """Return a header without what spelling may add to a name: case, spaces, hyphens, a unit at the end."""
    return re.sub(r"[\s_-]+", "_", _split_unit(header)[0]).casefold()


def _describe(error: Exception) -> str:
    lines = str(error).splitlines()
    return lines[0] if lines and lines[0].strip() else type(error).__name__
