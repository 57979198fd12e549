"""Output folders and text files: made, read or written whole, or refused with one message."""

from __future__ import annotations

from pathlib import Path

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
