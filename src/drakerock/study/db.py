"""The store of a study: an SQLite database, and one folder of files per loading, in one place.

    DIR/study.json              the resolved study, its problem and its versions
    DIR/study.db                points, sequences, cycles, runs, events (SQLite, write-ahead log)
    DIR/points/POINT/attempt_K/loading_NN/...   the files of each cycle, `outcome.json` last
    DIR/responses.parquet, ...  tables (`tables`)

One process writes the database: the one that holds the lock. A cycle is recorded, with the checksums of its
files, in one transaction after its folder is complete, so nothing half-written is ever read. What the database
says is enough for its status (`status`); files of unfinished loadings are never counted.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
import socket
import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
from pydantic import TypeAdapter, ValidationError

from drakerock.errors import InputError, RunStopped
from drakerock.exploration.problem import Array
from drakerock.files import make_folder, read_json, write_text
from drakerock.identity import RESULTS_REVISION, calc_config_hash, describe_content, get_versions
from drakerock.loading.cost import LoadingCost
from drakerock.loading.folder import HEIGHT_FIELDS, OUTCOME, PLAN
from drakerock.loading.outcome import CycleOutcome
from drakerock.loading.scenario import Scenario
from drakerock.study.schema import StudyConfig

DATABASE = "study.db"
STUDY = "study.json"
POINTS = "points"
_SCHEMA_VERSION = 3
_SCHEMA = """
CREATE TABLE IF NOT EXISTS meta (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS points (
    point TEXT PRIMARY KEY, role TEXT NOT NULL, batch INTEGER NOT NULL, x TEXT NOT NULL,
    status TEXT NOT NULL DEFAULT 'to do', reason TEXT NOT NULL DEFAULT '');
CREATE TABLE IF NOT EXISTS sequences (
    point TEXT NOT NULL REFERENCES points, attempt INTEGER NOT NULL, inputs_hash TEXT NOT NULL,
    seed INTEGER NOT NULL, versions TEXT NOT NULL, status TEXT NOT NULL DEFAULT 'running',
    reason TEXT NOT NULL DEFAULT '', traceback TEXT NOT NULL DEFAULT '', PRIMARY KEY (point, attempt));
CREATE TABLE IF NOT EXISTS cycles (
    point TEXT NOT NULL, attempt INTEGER NOT NULL, loading INTEGER NOT NULL, status TEXT NOT NULL,
    reason TEXT NOT NULL, outcome TEXT NOT NULL, files TEXT NOT NULL, seconds REAL, recorded REAL NOT NULL,
    cpu_seconds REAL, memory_MB REAL,
    PRIMARY KEY (point, attempt, loading), FOREIGN KEY (point, attempt) REFERENCES sequences);
CREATE TABLE IF NOT EXISTS runs (
    run INTEGER PRIMARY KEY, started REAL NOT NULL, ended REAL, host TEXT NOT NULL, process INTEGER NOT NULL,
    executor TEXT NOT NULL, workers INTEGER NOT NULL, ending TEXT NOT NULL DEFAULT '');
CREATE TABLE IF NOT EXISTS events (time REAL NOT NULL, kind TEXT NOT NULL, text TEXT NOT NULL);
"""
# Checks the types of what an outcome.json holds.
_OUTCOME = TypeAdapter(CycleOutcome)
KEPT_OF_OUTCOMES = (OUTCOME, PLAN, HEIGHT_FIELDS)


@dataclass(frozen=True)
class Point:
    """A design point in the store.

    Attributes:
        name: identifier, such as ``s0003`` (sample) or ``v0001`` (validation).
        role: "sample" or "validation".
        batch: number of the sampling step that asked for it.
        x: (d,) the point, in the variables' units.
        status: "to do", "running", "done", or "failed" (marked: too many failures).
        attempt: number of the latest attempt begun; -1 if none was.
        attempt_status: "running", "done" or "failed"; "" if none was begun.
        n_recorded: cycles recorded of that attempt.
    """

    name: str
    role: str
    batch: int
    x: Array
    status: str
    attempt: int
    attempt_status: str
    n_recorded: int


class Store:
    """The store of one study. Made by `Store.create` (to write) or `Store.open` (to read).

    Attributes:
        folder: where it is.
        study: the resolved study.
        db: the connection; to be written within `transaction` only.
    """

    def __init__(
        self, folder: Path, study: StudyConfig, db: sqlite3.Connection, lock: IO[str] | None = None
    ) -> None:
        self.folder = folder
        self.study = study
        self.db = db
        self._lock = lock

    @classmethod
    def create(cls, folder: str | Path, study: StudyConfig) -> Self:
        """Make a store, or open the one of the same study to go on with it. Holds the lock until closed.

        Raises:
            InputError: the folder cannot be written, holds another study or one without its database, or is in use
                by another process.
        """
        folder = Path(folder)
        make_folder(folder)
        lock = _lock(folder)
        try:
            if (folder / POINTS).exists() and not (folder / DATABASE).exists():
                raise InputError(
                    f"{folder}: {POINTS}/ holds sequences of a study, but {DATABASE} is missing: put it back, or take "
                    "another folder"
                )
            db = _connect(folder / DATABASE)
            stored = db.execute("SELECT value FROM meta WHERE key = 'identity'").fetchone()
            wanted = _describe_identity(study)
            if stored and json.loads(stored[0]) != wanted:
                raise InputError(_describe_difference(folder, json.loads(stored[0]), wanted))
            _write_study(folder, study)
            store = cls(folder, study, db, lock)
            with store.transaction():
                db.execute("INSERT OR IGNORE INTO meta VALUES ('identity', ?)", (json.dumps(wanted),))
                db.execute("INSERT OR IGNORE INTO meta VALUES ('study', ?)", (write_neutral(study),))
                db.execute("UPDATE runs SET ending = 'killed' WHERE ending = ''")
            return store
        except sqlite3.DatabaseError as error:
            lock.close()
            raise _explain(folder / DATABASE, error) from None
        except BaseException:
            lock.close()
            raise

    @classmethod
    def open(cls, folder: str | Path) -> Self:
        """Open a store to read it, also while a study runs.

        Raises:
            InputError: there is no store, or it cannot be read.
        """
        folder = Path(folder)
        if not (folder / DATABASE).exists():
            raise InputError(f"{folder}: no study here ({DATABASE} is missing); make one with `study run`")
        return cls(folder, read_study(folder), _connect(folder / DATABASE, make=False))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
        if isinstance(error, sqlite3.DatabaseError):
            raise _explain(self.folder / DATABASE, error) from None

    def close(self) -> None:
        """Close the database and give up the lock."""
        self.db.close()
        if self._lock is not None:
            self._lock.close()

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Do all that is inside, or nothing of it.

        Raises:
            RunStopped: the disk is full or cannot be written.
        """
        try:
            self.db.execute("BEGIN IMMEDIATE")
            try:
                yield self.db
                self.db.execute("COMMIT")
            except BaseException:
                # After a full disk SQLite has rolled back by itself.
                if self.db.in_transaction:
                    self.db.execute("ROLLBACK")
                raise
        except sqlite3.OperationalError as error:
            raise RunStopped(f"{self.folder / DATABASE}: {error}") from None

    @contextmanager
    def hold(self) -> Iterator[None]:
        """Keep others from running an opened study, and record what a killed run has finished and not recorded.

        Raises:
            InputError: another process is running it.
        """
        self._lock = _lock(self.folder)
        try:
            for point in self.list_points():
                if point.attempt_status == "running":
                    self.record_cycles(point.name, point.attempt, point.n_recorded, None)
            yield
        finally:
            self._lock.close()
            self._lock = None

    # Points and sequences

    def add_points(self, role: str, batch: int, X: Array) -> None:
        """Add design points X (n, d) of one sampling step, all or none."""
        with self.transaction() as db:
            (n,) = db.execute("SELECT COUNT(*) FROM points WHERE role = ?", (role,)).fetchone()
            db.executemany(
                "INSERT INTO points (point, role, batch, x) VALUES (?, ?, ?, ?)",
                [(f"{role[0]}{n + i + 1:04d}", role, batch, json.dumps(x.tolist())) for i, x in enumerate(X)],
            )

    def list_points(self, role: str | None = None) -> list[Point]:
        """Return all points, or those of a role, in the order in which they were asked for."""
        rows = self.db.execute(
            "SELECT p.point, p.role, p.batch, p.x, p.status, COALESCE(s.attempt, -1), COALESCE(s.status, ''), "
            "(SELECT COUNT(*) FROM cycles c WHERE c.point = p.point AND c.attempt = s.attempt) "
            "FROM points p LEFT JOIN sequences s ON s.point = p.point AND s.attempt = "
            "(SELECT MAX(attempt) FROM sequences WHERE point = p.point) "
            "WHERE ? IS NULL OR p.role = ? ORDER BY p.role, p.point",
            (role, role),
        )
        return [
            Point(name, role_, batch, np.array(json.loads(x), dtype=float), status, attempt, ended, n)
            for name, role_, batch, x, status, attempt, ended, n in rows
        ]

    def find_sequence_folder(self, point: str, attempt: int) -> Path:
        """Return the folder of a sequence."""
        return self.folder / POINTS / point / f"attempt_{attempt}"

    def begin_sequence(self, point: str, attempt: int, scenario: Scenario) -> int:
        """Record that a sequence runs, and return how many cycles of it are recorded.

        What an earlier run left of it is kept if it came from the same inputs (scenario, number of loadings,
        versions), and removed otherwise.
        """
        inputs_hash = calc_inputs_hash(scenario, self.study.loadings)
        row = self.db.execute(
            "SELECT inputs_hash FROM sequences WHERE point = ? AND attempt = ?", (point, attempt)
        ).fetchone()
        fresh = row is None or row[0] != inputs_hash
        if fresh:
            shutil.rmtree(self.find_sequence_folder(point, attempt), ignore_errors=True)
        with self.transaction() as db:
            if fresh:
                db.execute("DELETE FROM cycles WHERE point = ? AND attempt = ?", (point, attempt))
                db.execute("DELETE FROM sequences WHERE point = ? AND attempt = ?", (point, attempt))
                db.execute(
                    "INSERT INTO sequences (point, attempt, inputs_hash, seed, versions) VALUES (?, ?, ?, ?, ?)",
                    (point, attempt, inputs_hash, scenario.seed, json.dumps(get_versions())),
                )
            db.execute("UPDATE points SET status = 'running' WHERE point = ?", (point,))
            (n,) = db.execute(
                "SELECT COUNT(*) FROM cycles WHERE point = ? AND attempt = ?", (point, attempt)
            ).fetchone()
        return int(n)

    def record_cycles(self, point: str, attempt: int, n_recorded: int, seconds: float | None) -> int:
        """Record the loadings that are complete on disk beyond the first `n_recorded`; return how many are now.

        Args:
            point, attempt: the sequence.
            n_recorded: cycles recorded before.
            seconds: since the last record of this sequence, shared among the new ones; None if unknown.
        """
        folder = self.find_sequence_folder(point, attempt)
        places: dict[int, Path] = {}
        for loading in range(n_recorded, self.study.loadings):
            place = folder / f"loading_{loading:02d}"
            if not (place / OUTCOME).exists():
                break
            places[loading] = place
        if not places:
            return n_recorded
        rows = []
        for loading, place in places.items():
            outcome = read_outcome(place / OUTCOME)
            files = calc_checksums(place, self.study.storage.keep)
            share = None if seconds is None else seconds / len(places)
            cost = LoadingCost.read(place)
            text = json.dumps(json.loads(outcome.to_json()))
            rows.append(
                (point, attempt, loading, outcome.status, outcome.reason if outcome.status == "failed" else "",
                 text, json.dumps(files), share, time.time(), cost and cost.cpu_time_s, cost and cost.memory_MB)
            )  # fmt: skip
        with self.transaction() as db:
            db.executemany("INSERT OR REPLACE INTO cycles VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", rows)
        return n_recorded + len(rows)

    def finish_sequence(
        self, point: str, attempt: int, status: str, reason: str = "", traceback: str = "", final: bool = True
    ) -> None:
        """Record how a sequence ended; `final` also settles its point as done or failed.

        The files of unfinished loadings are removed, and with ``keep: outcomes`` the large files of the others.
        """
        with self.transaction() as db:
            db.execute(
                "UPDATE sequences SET status = ?, reason = ?, traceback = ? WHERE point = ? AND attempt = ?",
                (status, reason, traceback, point, attempt),
            )
            settled = status if final else "running"
            db.execute("UPDATE points SET status = ?, reason = ? WHERE point = ?", (settled, reason, point))
        self._clean_sequence(point, attempt)

    def clean(self) -> None:
        """Finish the cleaning of sequences that ended just before an earlier run was killed."""
        for point, attempt in self.db.execute(
            "SELECT point, attempt FROM sequences WHERE status != 'running'"
        ).fetchall():
            self._clean_sequence(point, attempt)

    def _clean_sequence(self, point: str, attempt: int) -> None:
        folder = self.find_sequence_folder(point, attempt)
        recorded = self.list_files(point, attempt)
        if not folder.exists():
            return
        for entry in list(folder.iterdir()):
            if entry.is_dir() and entry.name not in {name.split("/")[0] for name in recorded}:
                shutil.rmtree(entry, ignore_errors=True)
            elif self.study.storage.keep == "outcomes":
                for file in [path for path in entry.rglob("*") if path.is_file()]:
                    if file.relative_to(folder).as_posix() not in recorded:
                        file.unlink(missing_ok=True)

    def list_files(self, point: str, attempt: int) -> dict[str, str]:
        """Return the checksums of a sequence's recorded files, by path relative to its folder."""
        rows = self.db.execute(
            "SELECT loading, files FROM cycles WHERE point = ? AND attempt = ?", (point, attempt)
        )
        return {
            f"loading_{loading:02d}/{name}": checksum
            for loading, files in rows
            for name, checksum in json.loads(files).items()
        }

    # Runs and events

    def begin_run(self, executor: str, workers: int) -> int:
        """Record that a run began; return its number."""
        with self.transaction() as db:
            cursor = db.execute(
                "INSERT INTO runs (started, host, process, executor, workers) VALUES (?, ?, ?, ?, ?)",
                (time.time(), socket.gethostname(), os.getpid(), executor, workers),
            )
        return int(cursor.lastrowid or 0)

    def end_run(self, run: int, ending: str) -> None:
        """Record how a run ended."""
        with self.transaction() as db:
            db.execute("UPDATE runs SET ended = ?, ending = ? WHERE run = ?", (time.time(), ending, run))

    def add_event(self, kind: str, text: str) -> None:
        """Record something that happened, such as a lost worker."""
        with self.transaction() as db:
            db.execute("INSERT INTO events VALUES (?, ?, ?)", (time.time(), kind, text))

    def is_running(self) -> bool:
        """Return whether some process, this one included, is running the study."""
        if self._lock is not None:
            return True
        try:
            with open(self.folder / ".lock") as lock:
                fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except FileNotFoundError:
            return False
        except BlockingIOError:
            return True
        return False


def read_study(folder: str | Path) -> StudyConfig:
    """Return the study of a store.

    Raises:
        InputError: no study there, or one that cannot be read.
    """
    path = Path(folder) / STUDY
    data = read_json(path, "a readable study")
    try:
        return StudyConfig.model_validate(data["study"])
    except (KeyError, TypeError, ValidationError) as error:
        raise InputError(f"{path}: not a readable study: {str(error).splitlines()[0]}") from None


def read_outcome(path: Path) -> CycleOutcome:
    """Read an outcome.json.

    Raises:
        InputError: it cannot be read.
    """
    data = read_json(path, "a readable outcome")
    try:
        _OUTCOME.validate_python(data)
        return CycleOutcome(**data)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{path}: not a readable outcome: {where}: {first['msg']}") from None
    except TypeError as error:
        raise InputError(f"{path}: not a readable outcome: {error}") from None


def calc_checksums(folder: Path, keep: str) -> dict[str, str]:
    """Return the SHA-256 of each file of a cycle that stays, by its path relative to the cycle's folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    if keep == "outcomes":
        files = [path for path in files if path.name in KEPT_OF_OUTCOMES]
    return {path.relative_to(folder).as_posix(): hash_file(path) for path in files}


def calc_inputs_hash(scenario: Scenario, n_loadings: int) -> str:
    """Return the hash of all that a sequence's outcomes depend on: scenario, seed, loadings, versions."""
    return calc_config_hash(scenario, str(n_loadings), *get_versions().values())


def _lock(folder: Path) -> IO[str]:
    """Return the file whose lock says that this process writes the store; InputError if another one does."""
    lock = open(folder / ".lock", "a")  # noqa: SIM115 - held as long as the store is
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        raise InputError(f"{folder}: another process is running this study") from None
    return lock


def _connect(path: Path, make: bool = True) -> sqlite3.Connection:
    try:
        db = sqlite3.connect(path, isolation_level=None, timeout=30.0)
        (found,) = db.execute("PRAGMA user_version").fetchone()
        if found > _SCHEMA_VERSION:
            raise InputError(f"{path}: made by a newer version (format {found}, not {_SCHEMA_VERSION})")
        if make and 0 < found < _SCHEMA_VERSION:
            raise InputError(
                f"{path}: made by an earlier version (format {found}, not {_SCHEMA_VERSION}), whose results do not "
                "mix with this one's; take another folder"
            )
        if found == 0:
            (tables,) = db.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()
            if tables or not make:
                raise InputError(f"{path}: not a readable study database: {'foreign' if tables else 'empty'}")
            db.execute("PRAGMA journal_mode = WAL")
            db.executescript(f"BEGIN;{_SCHEMA}PRAGMA user_version = {_SCHEMA_VERSION};COMMIT;")
        db.execute("PRAGMA synchronous = FULL")
        db.execute("PRAGMA foreign_keys = ON")
        return db
    except sqlite3.DatabaseError as error:
        raise _explain(path, error) from None


def _explain(path: Path, error: sqlite3.DatabaseError) -> InputError | RunStopped:
    """Return what to tell of an error of the database: trouble with the disk, or no database of ours."""
    if isinstance(error, sqlite3.OperationalError):
        return RunStopped(f"{path}: {error}")
    return InputError(f"{path}: not a readable study database: {error}")


def _write_study(folder: Path, study: StudyConfig) -> None:
    data = {
        "name": study.name,
        "seed": study.seed,
        "problem": study.problem.model_dump(mode="json"),
        "exploration": study.exploration.model_dump(mode="json"),
        "versions": get_versions(),
        "study": study.model_dump(mode="json"),
    }
    write_text(folder / STUDY, json.dumps(data, indent=2) + "\n")


def _describe_identity(study: StudyConfig) -> dict[str, Any]:
    """Return all that a study's results depend on: of files their content, and the results revision."""
    return {"results revision": RESULTS_REVISION} | describe_content(study.make_neutral())


def write_neutral(study: StudyConfig) -> str:
    """Return the same as it stands in the study, with the files' names."""
    return json.dumps(study.make_neutral().model_dump(mode="json"), sort_keys=True)


def _describe_difference(folder: Path, stored: dict[str, Any], wanted: dict[str, Any]) -> str:
    differs = _list_differences(stored, wanted)
    shown = ", ".join(differs[:5]) + (", ..." if len(differs) > 5 else "")
    return (
        f"{folder}: holds another study (different: {shown}); take another folder, or the same study. The number of "
        "points, the executor and the storage may change; of files the content counts."
    )


def _list_differences(one: Any, two: Any, prefix: str = "") -> list[str]:
    if isinstance(one, dict) and isinstance(two, dict):
        keys = sorted(set(one) | set(two))
        return [d for k in keys for d in _list_differences(one.get(k), two.get(k), f"{prefix}{k}.")]
    return [] if one == two else [prefix.rstrip(".")]


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
