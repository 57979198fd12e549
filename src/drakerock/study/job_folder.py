"""The folder that `drakerock load` writes into: one run's at a time, with nothing of an earlier one left in it."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from drakerock.errors import InputError
from drakerock.files import make_folder
from drakerock.loading.folder import CYCLE_FILES, REPLAY

LOCK = ".lock"


@contextmanager
def use_folder(folder: Path, *, force: bool, sequence: bool) -> Iterator[None]:
    """Hold a folder for a loading, or a sequence of them.

    A sequence goes on in its own folder. A single loading's files are replaced with `force` only; those are removed
    before it starts, and only those: what else lies there stays.

    Args:
        folder: made if missing.
        force: replace an earlier loading's files.
        sequence: whether a sequence will be there.

    Raises:
        InputError: another run works there, an earlier loading's files are there, or the folder cannot be written.
    """
    make_folder(folder)
    with open(folder / LOCK, "a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(f"{folder}: another run is working there; take another folder") from None
        try:
            _make_free(folder, force, sequence)
            yield
        finally:
            (folder / LOCK).unlink(missing_ok=True)


def _make_free(folder: Path, force: bool, sequence: bool) -> None:
    if not sequence and (loadings := sorted(folder.glob("loading_[0-9][0-9]"))):
        raise InputError(f"{folder}: a sequence of {len(loadings)} loadings is there; take another folder")
    old = [folder / name for name in (*reversed(CYCLE_FILES), REPLAY) if (folder / name).exists()]
    old += sorted(folder.glob("figure_*.png"))
    if old and not force:
        raise InputError(
            f"{folder}: an earlier loading is there ({old[0].name}); take another folder, or force it to be replaced"
        )
    for path in old:
        path.unlink()
