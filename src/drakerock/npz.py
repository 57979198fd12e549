"""Arrays in a file that knows what it is: compressed npz with a header and a checksum."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drakerock.errors import InputError

Arrays = dict[str, NDArray[Any]]


def save_arrays(path: str | Path, format_: str, version: int, header: dict[str, Any], arrays: Arrays) -> None:
    """Write arrays with a JSON header.

    Args:
        path: the file.
        format_: the kind of file, such as ``drakerock-pile``.
        version: of the format.
        header: values that JSON can hold.
        arrays: by name.

    Raises:
        InputError: the file cannot be written.
    """
    text = json.dumps(
        {"format": format_, "version": version, "header": header, "checksum": _calc_checksum(arrays)},
        sort_keys=True,
    )
    try:
        with open(path, "wb") as file:
            np.savez_compressed(file, header=np.array(text), **arrays)  # type: ignore[arg-type]
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None


def load_arrays(path: str | Path, format_: str, version: int) -> tuple[dict[str, Any], Arrays]:
    """Read what `save_arrays` wrote: the header and the arrays.

    Raises:
        InputError: missing, foreign, damaged, or of a newer version than `version`.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            head = json.loads(str(data["header"])) if "header" in data else {}
            if not isinstance(head, dict) or head.get("format") != format_:
                raise InputError(f"{path}: not a {format_} file")
            if head["version"] > version:
                raise InputError(
                    f"{path}: {format_} {head['version']} is newer than this version reads ({version})"
                )
            arrays = {name: data[name] for name in data.files if name != "header"}
        header, checksum = dict(head["header"]), head["checksum"]
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except InputError:
        raise
    except Exception as error:  # whatever numpy, zipfile, zlib and json make of a damaged file
        raise InputError(f"{path}: not a readable {format_} file: {error}") from None
    if _calc_checksum(arrays) != checksum:
        raise InputError(f"{path}: damaged: the checksum does not match")
    return header, arrays


def _calc_checksum(arrays: Arrays) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name}{array.dtype.str}{array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
