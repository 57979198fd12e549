"""Output folders and text files: made, read or written whole, or refused with one message."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from drakerock.errors import InputError


def make_folder(folder: Path) -> None:
    """Make an output folder.

    Raises:
        InputError: it cannot be made or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"{folder}: the folder cannot be written: {error.strerror}") from None


def read_text(path: Path) -> str:
    """Return the text of a file.

    Raises:
        InputError: it is missing, or cannot be read as text.
    """
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{path}: cannot be read: {reason}") from None


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all; InputError if it cannot be written."""
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None


def read_json(path: Path, what: str = "valid JSON") -> Any:
    """Return what a JSON file holds; `what` it should be is said where it is not.

    Raises:
        InputError: it cannot be read, or is no JSON that can be written as UTF-8 again.
    """
    try:
        text = path.read_text(encoding="utf-8")
        data = json.loads(text, parse_constant=_refuse_constant)
        # A lone half of a surrogate pair can be read by its escape, and written nowhere.
        json.dumps(data, ensure_ascii=False).encode()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not {what}: {error}") from None
    return data


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is no number of JSON")
