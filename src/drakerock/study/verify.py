"""Whether a store is whole: its database, its files, and nothing else."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import dataclass

from drakerock.loading.folder import OUTCOME, REPLAY
from drakerock.study.db import DATABASE, POINTS, STUDY, Store, hash_file, write_neutral


@dataclass(frozen=True)
class Fault:
    """Something wrong in a store, found by `verify`.

    Attributes:
        kind: "database", "missing", "damaged", "orphan" or "mismatch".
        path: relative to the store.
        message: what is wrong.
    """

    kind: str
    path: str
    message: str


def verify_store(store: Store) -> list[Fault]:
    """Check the database, every recorded file's checksum, and that nothing else lies about."""
    faults = []
    try:
        messages = [message for (message,) in store.db.execute("PRAGMA integrity_check")]
    except sqlite3.DatabaseError as error:
        messages = [str(error)]
    if messages != ["ok"]:
        # What such a database says of the files is worth nothing.
        return [Fault("database", DATABASE, message) for message in messages]
    for row in store.db.execute("PRAGMA foreign_key_check"):
        faults.append(Fault("database", DATABASE, f"table {row[0]} has a row without its {row[2]}"))
    # A store of an earlier version has none.
    stored = store.db.execute("SELECT value FROM meta WHERE key = 'study'").fetchone()
    if stored and stored[0] != write_neutral(store.study):
        faults.append(Fault("mismatch", STUDY, "is not the study that the database was made for"))
    known, open_folders = set(), []
    for point, attempt, status in store.db.execute(
        "SELECT point, attempt, status FROM sequences ORDER BY point, attempt"
    ).fetchall():
        folder = store.find_sequence_folder(point, attempt)
        if status == "running":
            open_folders.append(folder)
        for name, checksum in store.list_files(point, attempt).items():
            path = folder / name
            known.add(path)
            shown = path.relative_to(store.folder).as_posix()
            if not path.exists():
                faults.append(Fault("missing", shown, "is recorded but not there"))
            elif hash_file(path) != checksum:
                faults.append(Fault("damaged", shown, "is not as it was recorded (checksum)"))
    faults += _verify_outcomes(store)
    for path in sorted((store.folder / POINTS).rglob("*")):
        # Sequences that are not finished may hold files of loadings that are not finished.
        # Replays are made on demand, and again.
        if path.is_dir() or path in known or path.suffix == ".lock" or path.name == REPLAY:
            continue
        if not any(path.is_relative_to(folder) for folder in open_folders):
            shown = path.relative_to(store.folder).as_posix()
            faults.append(Fault("orphan", shown, "belongs to nothing that is recorded"))
    return faults


def _verify_outcomes(store: Store) -> list[Fault]:
    faults = []
    for point, attempt, loading, text in store.db.execute(
        "SELECT point, attempt, loading, outcome FROM cycles ORDER BY point, attempt, loading"
    ):
        path = store.find_sequence_folder(point, attempt) / f"loading_{loading:02d}" / OUTCOME
        try:
            same = json.loads(path.read_text(encoding="utf-8")) == json.loads(text)
        except (OSError, ValueError):
            continue  # missing or damaged, which the checksums say
        if not same:
            shown = path.relative_to(store.folder).as_posix()
            faults.append(Fault("mismatch", shown, "is not what the database holds"))
    return faults
