"""Replays of a study's loadings: made on demand from the recordings, linked from the report."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from drakerock.errors import InputError
from drakerock.exploration.table import ResponseTable
from drakerock.loading.folder import RECORDING, REPLAY
from drakerock.study.db import Store


def write_study_replays(
    folder: str | Path, progress: Callable[[str, float | None], None] | None = None
) -> list[Path]:
    """Write the replay of each loading of a study's finished points, but for those already there; return their paths.

    Raises:
        InputError: no store there, or one that keeps no recordings.
    """
    with Store.open(folder) as store:
        if store.study.storage.keep != "everything":
            raise InputError(f"{folder}: no recordings are kept (storage.keep: {store.study.storage.keep})")
        loadings = store.study.loadings
        places = [
            place.parent
            for point in store.list_points()
            if point.status in ("done", "failed")
            for place in sorted(
                store.find_sequence_folder(point.name, point.attempt).glob("loading_*/recording.npz")
            )
        ]
    for number, place in enumerate(places):
        if progress:
            progress("drawing", number / len(places))
        update_replay(place, loadings)
    return [place / REPLAY for place in places]


def update_replay(place: Path, loadings: int = 1) -> Path:
    """Write a loading's replay unless there is one that is newer than its recording; return its path."""
    from drakerock.viewing.replay import write_replay  # takes long to import

    page = place / REPLAY
    if not page.exists() or page.stat().st_mtime < (place / RECORDING).stat().st_mtime:
        write_replay(place, loadings=loadings)
    return page


def find_replay(store: Store, point: str, attempt: int) -> str:
    """Return the path, relative to the study's folder, of the first replay of a point's sequence; "" without one.

    It leads on to the other loadings'.
    """
    pages = sorted(store.find_sequence_folder(point, attempt).glob(f"loading_*/{REPLAY}"))
    return pages[0].relative_to(store.folder).as_posix() if pages else ""


def link_replays(table: ResponseTable, folder: Path, out: Path) -> ResponseTable:
    """Return a table whose replays, where they are files relative to `folder`, are relative to `out`."""

    def link(address: str) -> str:
        there = bool(address) and (folder / address).is_file()
        return Path(os.path.relpath(folder / address, out)).as_posix() if there else address

    return replace(table, replay=tuple(link(address) for address in table.replay))
