"""The store of a study: an SQLite database, and one folder of files per loading, in one place.

    DIR/study.json              the resolved study, its problem and its versions
    DIR/study.db                points, sequences, cycles, runs, events (SQLite, write-ahead log)
    DIR/points/POINT/attempt_K/loading_NN/...   the files of each cycle, `outcome.json` last
    DIR/responses.parquet, ...  tables written by `export_tables`

One process writes the database: the one that holds the lock. A cycle is recorded, with the checksums of its
files, in one transaction after its folder is complete, so nothing half-written is ever read. What the database
says is enough for `read_status`; files of unfinished loadings are never counted.
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
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from pydantic import TypeAdapter, ValidationError

import drakerock
from drakerock.config import calc_config_hash
from drakerock.errors import InputError, RunStopped
from drakerock.exploration.problem import Array
from drakerock.exploration.table import ResponseTable, average_loadings
from drakerock.files import make_folder, read_json, write_text
from drakerock.loading.cycle import CycleOutcome
from drakerock.loading.scenario import Scenario
from drakerock.study.objectives import get_objective
from drakerock.study.schema import StudyConfig

DATABASE = "study.db"
STUDY = "study.json"
POINTS = "points"
_SCHEMA_VERSION = 1
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
    PRIMARY KEY (point, attempt, loading), FOREIGN KEY (point, attempt) REFERENCES sequences);
CREATE TABLE IF NOT EXISTS runs (
    run INTEGER PRIMARY KEY, started REAL NOT NULL, ended REAL, host TEXT NOT NULL, process INTEGER NOT NULL,
    executor TEXT NOT NULL, workers INTEGER NOT NULL, ending TEXT NOT NULL DEFAULT '');
CREATE TABLE IF NOT EXISTS events (time REAL NOT NULL, kind TEXT NOT NULL, text TEXT NOT NULL);
"""
# Checks the types of what an outcome.json holds.
_OUTCOME = TypeAdapter(CycleOutcome)
_KEPT_OF_OUTCOMES = ("outcome.json", "plan.json")


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


class Store:
    """The store of one study. Made by `Store.create` (to write) or `Store.open` (to read).

    Attributes:
        folder: where it is.
        study: the resolved study.
    """

    def __init__(self, folder: Path, study: StudyConfig, db: sqlite3.Connection, lock: Any = None) -> None:
        self.folder = folder
        self.study = study
        self._db = db
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
        lock = open(folder / ".lock", "a")  # noqa: SIM115 - held as long as the store is
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.close()
            raise InputError(f"{folder}: another process is running this study") from None
        try:
            if (folder / POINTS).exists() and not (folder / DATABASE).exists():
                raise InputError(
                    f"{folder}: {POINTS}/ holds sequences of a study, but {DATABASE} is missing: put it back, or take "
                    "another folder"
                )
            db = _connect(folder / DATABASE)
            stored = db.execute("SELECT value FROM meta WHERE key = 'identity'").fetchone()
            if stored and stored[0] != study.calc_identity():
                raise InputError(_describe_difference(folder, study))
            _write_study(folder, study)
            store = cls(folder, study, db, lock)
            with store.transaction():
                db.execute("INSERT OR IGNORE INTO meta VALUES ('identity', ?)", (study.calc_identity(),))
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
        self._db.close()
        if self._lock is not None:
            self._lock.close()

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Do all that is inside, or nothing of it.

        Raises:
            RunStopped: the disk is full or cannot be written.
        """
        try:
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield self._db
                self._db.execute("COMMIT")
            except BaseException:
                # After a full disk SQLite has rolled back by itself.
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise
        except sqlite3.OperationalError as error:
            raise RunStopped(f"{self.folder / DATABASE}: {error}") from None

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
        rows = self._db.execute(
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
        row = self._db.execute(
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
            if not (place / "outcome.json").exists():
                break
            places[loading] = place
        if not places:
            return n_recorded
        rows = []
        for loading, place in places.items():
            outcome = read_outcome(place / "outcome.json")
            files = calc_checksums(place, self.study.storage.keep)
            share = None if seconds is None else seconds / len(places)
            text = json.dumps(json.loads(outcome.to_json()))
            rows.append(
                (point, attempt, loading, outcome.status, outcome.reason if outcome.status == "failed" else "",
                 text, json.dumps(files), share, time.time())
            )  # fmt: skip
        with self.transaction() as db:
            db.executemany("INSERT OR REPLACE INTO cycles VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", rows)
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
        for point, attempt in self._db.execute(
            "SELECT point, attempt FROM sequences WHERE status != 'running'"
        ).fetchall():
            self._clean_sequence(point, attempt)

    def _clean_sequence(self, point: str, attempt: int) -> None:
        folder = self.find_sequence_folder(point, attempt)
        recorded = self._list_files(point, attempt)
        if not folder.exists():
            return
        for entry in list(folder.iterdir()):
            if entry.is_dir() and entry.name not in {name.split("/")[0] for name in recorded}:
                shutil.rmtree(entry, ignore_errors=True)
            elif self.study.storage.keep == "outcomes":
                for file in [path for path in entry.rglob("*") if path.is_file()]:
                    if file.relative_to(folder).as_posix() not in recorded:
                        file.unlink(missing_ok=True)

    def _list_files(self, point: str, attempt: int) -> dict[str, str]:
        """Return the checksums of a sequence's recorded files, by path relative to its folder."""
        rows = self._db.execute(
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

    # Reading

    def read_responses(self, role: str | None = None) -> ResponseTable:
        """Return the response table of the points that are done or marked as failed, one row per point.

        Responses are means over the sequence of the attempt that counts; failed cycles are left out, and
        a point marked as failed has none.

        Raises:
            InputError: an objective's function failed.
        """
        problem = self.study.problem
        objectives = [get_objective(name) for name in self.study.objectives]
        names: list[str] = []
        loadings: list[float] = []
        X: list[Array] = []
        Y: list[list[float]] = []
        roles: list[str] = []
        failures: list[str] = []
        failed: list[bool] = []
        rows: dict[tuple[str, int], list[tuple[int, str, str, str]]] = {}
        for point, attempt, *rest in self._db.execute(
            "SELECT point, attempt, loading, status, reason, outcome FROM cycles ORDER BY loading"
        ):
            rows.setdefault((point, attempt), []).append(tuple(rest))
        reasons = dict(self._db.execute("SELECT point, reason FROM points"))
        for point in self.list_points(role):
            if point.status not in ("done", "failed"):
                continue
            cycles = rows.get((point.name, point.attempt), [])
            for loading, status, reason, outcome in cycles or [(0, "failed", "", "")]:
                lost = point.status == "failed" or status == "failed"
                names.append(point.name)
                loadings.append(loading)
                X.append(point.x)
                Y.append(
                    [np.nan] * len(objectives)
                    if lost
                    else [item.evaluate(CycleOutcome.from_json(outcome)) for item in objectives]
                )
                failed.append(lost)
                roles.append(point.role)
                failures.append(reasons[point.name] if point.status == "failed" else reason)
        if not names:
            d, k = len(problem.variables), len(problem.objectives)
            return ResponseTable(problem, np.empty((0, d)), np.empty((0, k)))
        provenance = json.loads((self.folder / STUDY).read_text(encoding="utf-8"))
        return average_loadings(
            problem,
            names,
            loadings,
            np.array(X),
            np.array(Y),
            roles,
            failures,
            failed=failed,
            provenance=provenance,
        )

    def read_loadings(self) -> pa.Table:
        """Return one row per recorded cycle, of all attempts: point, variables, objectives, outcome, cost."""
        problem, columns = self.study.problem, {}
        points = {point.name: point for point in self.list_points()}
        rows = self._db.execute(
            "SELECT c.point, c.attempt, c.loading, c.status, c.reason, c.outcome, c.seconds, s.inputs_hash "
            "FROM cycles c JOIN sequences s ON s.point = c.point AND s.attempt = c.attempt "
            "JOIN points p ON p.point = c.point ORDER BY p.role, c.point, c.attempt, c.loading"
        ).fetchall()
        outcomes = [json.loads(row[5]) for row in rows]
        columns["point"] = [row[0] for row in rows]
        columns["role"] = [points[row[0]].role for row in rows]
        for j, name in enumerate(("attempt", "loading", "status", "reason"), start=1):
            columns[name] = [row[j] for row in rows]
        for j, name in enumerate(problem.variable_names):
            columns[name] = [float(points[row[0]].x[j]) for row in rows]
        for item in [get_objective(name) for name in self.study.objectives]:
            values = [
                np.nan if row[3] == "failed" else item.evaluate(CycleOutcome.from_json(row[5]))
                for row in rows
            ]
            columns[item.objective.name] = pa.array(values, pa.float64(), from_pandas=True)
        for name in ("bucket_mass_kg", "bucket_rocks", "weighed_mass_kg", "loading_time_s", "energy_J",
                     "peak_push_force_N", "mean_push_force_N", "sim_time_s", "steps", "seed",
                     "scenario_hash", "wall_time_s"):  # fmt: skip
            columns[name] = [outcome[name] for outcome in outcomes]
        for name in ("total", "awake_mean", "awake_max"):
            columns[f"rocks_{name}"] = [outcome["rocks"].get(name) for outcome in outcomes]
        columns["seconds"] = [row[6] for row in rows]
        columns["inputs_hash"] = [row[7] for row in rows]
        return pa.table(columns)

    def read_status(self) -> dict[str, Any]:
        """Return the state of the study as plain data, from the database alone."""
        study, db = self.study, self._db
        sampling = study.exploration.sampling
        n_points = sampling.n_samples + sampling.n_validation
        by_status = dict(db.execute("SELECT status, COUNT(*) FROM points GROUP BY status"))
        done, marked = by_status.get("done", 0), by_status.get("failed", 0)
        (n_cycles, n_failed) = db.execute(
            "SELECT COUNT(*), COALESCE(SUM(status = 'failed'), 0) FROM cycles"
        ).fetchone()
        (counted,) = db.execute(
            "SELECT COUNT(*) FROM cycles c JOIN points p ON p.point = c.point WHERE p.status = 'running' AND "
            "c.attempt = (SELECT MAX(attempt) FROM sequences s WHERE s.point = c.point)"
        ).fetchone()
        recent = db.execute(
            "SELECT AVG(seconds), AVG(awake) FROM (SELECT seconds, "
            "json_extract(outcome, '$.rocks.awake_mean') AS awake FROM cycles "
            "WHERE seconds IS NOT NULL ORDER BY recorded DESC LIMIT 100)"
        ).fetchone()
        run = db.execute(
            "SELECT run, started, ended, host, process, executor, workers, ending FROM runs ORDER BY run DESC"
        ).fetchone()
        names = ("number", "started", "ended", "host", "process", "executor", "workers", "ending")
        live = self.is_running()
        rest = (n_points - done - marked) * study.loadings - counted
        seconds, workers = recent[0], run[6] if run else 0
        running = [
            {"point": point.name, "attempt": point.attempt, "cycles": point.n_recorded}
            for point in self.list_points()
            if live and point.status == "running" and point.attempt_status == "running"
        ]
        failures = [
            {"point": row[0], "attempt": row[1], "loading": row[2], "reason": row[3]}
            for row in db.execute(
                "SELECT point, attempt, loading, reason FROM cycles WHERE status = 'failed' UNION ALL "
                "SELECT point, attempt, NULL, reason FROM sequences WHERE status = 'failed' ORDER BY 1, 2, 3"
            )
        ]
        return {
            "name": study.name,
            "running": live,
            "complete": done + marked >= n_points,
            "points": {
                "total": n_points, "done": done, "failed": marked, "running": len(running),
                "to_do": n_points - done - marked - len(running),
            },
            "cycles": {"total": n_points * study.loadings, "recorded": n_cycles, "failed": n_failed},
            "sequences_running": running,
            "failures": failures,
            "points_failed": [
                {"point": name, "reason": reason}
                for name, reason in db.execute(
                    "SELECT point, reason FROM points WHERE status = 'failed' ORDER BY point"
                )
            ],
            "worker_deaths": db.execute("SELECT COUNT(*) FROM events WHERE kind = 'worker lost'").fetchone()[0],
            "seconds_per_cycle": seconds,
            "awake_rocks_mean": recent[1],
            "eta_s": max(rest, 0) * seconds / workers if seconds is not None and workers else None,
            "last_run": dict(zip(names, run, strict=True)) if run else None,
            "versions": [json.loads(row[0]) for row in db.execute(
                "SELECT DISTINCT versions FROM sequences ORDER BY versions")],
        }  # fmt: skip

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

    def verify(self) -> list[Fault]:
        """Check the database, every recorded file's checksum, and that nothing else lies about."""
        faults = []
        try:
            messages = [message for (message,) in self._db.execute("PRAGMA integrity_check")]
        except sqlite3.DatabaseError as error:
            messages = [str(error)]
        if messages != ["ok"]:
            # What such a database says of the files is worth nothing.
            return [Fault("database", DATABASE, message) for message in messages]
        for row in self._db.execute("PRAGMA foreign_key_check"):
            faults.append(Fault("database", DATABASE, f"table {row[0]} has a row without its {row[2]}"))
        (identity,) = self._db.execute("SELECT value FROM meta WHERE key = 'identity'").fetchone()
        if identity != self.study.calc_identity():
            faults.append(Fault("mismatch", STUDY, "is not the study that the database was made for"))
        known, open_folders = set(), []
        for point, attempt, status in self._db.execute(
            "SELECT point, attempt, status FROM sequences ORDER BY point, attempt"
        ).fetchall():
            folder = self.find_sequence_folder(point, attempt)
            if status == "running":
                open_folders.append(folder)
            for name, checksum in self._list_files(point, attempt).items():
                path = folder / name
                known.add(path)
                shown = path.relative_to(self.folder).as_posix()
                if not path.exists():
                    faults.append(Fault("missing", shown, "is recorded but not there"))
                elif _hash_file(path) != checksum:
                    faults.append(Fault("damaged", shown, "is not as it was recorded (checksum)"))
        faults += self._verify_outcomes()
        for path in sorted((self.folder / POINTS).rglob("*")):
            # Sequences that are not finished may hold files of loadings that are not finished.
            if path.is_dir() or path in known or path.suffix == ".lock":
                continue
            if not any(path.is_relative_to(folder) for folder in open_folders):
                shown = path.relative_to(self.folder).as_posix()
                faults.append(Fault("orphan", shown, "belongs to nothing that is recorded"))
        return faults

    def _verify_outcomes(self) -> list[Fault]:
        faults = []
        for point, attempt, loading, text in self._db.execute(
            "SELECT point, attempt, loading, outcome FROM cycles ORDER BY point, attempt, loading"
        ):
            path = self.find_sequence_folder(point, attempt) / f"loading_{loading:02d}" / "outcome.json"
            try:
                same = json.loads(path.read_text(encoding="utf-8")) == json.loads(text)
            except (OSError, ValueError):
                continue  # missing or damaged, which the checksums say
            if not same:
                shown = path.relative_to(self.folder).as_posix()
                faults.append(Fault("mismatch", shown, "is not what the database holds"))
        return faults


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


def export_tables(folder: str | Path, formats: Sequence[str] = ("csv", "parquet")) -> list[Path]:
    """Write `responses` (a row per finished point) and `loadings` (a row per cycle); return the paths.

    Raises:
        InputError: no store there; not one of the formats csv and parquet; the folder cannot be written.
    """
    with Store.open(folder) as store:
        responses, loadings = store.read_responses(), store.read_loadings()
    paths = []
    for suffix in formats:
        if suffix not in ("csv", "parquet"):
            raise InputError(f"--format {suffix}: csv or parquet")
        for name in ("responses", "loadings"):
            path = Path(folder) / f"{name}.{suffix}"
            partial = path.with_name(f".partial-{path.name}")
            try:
                if name == "responses":
                    responses.save(partial)
                elif suffix == "csv":
                    pyarrow.csv.write_csv(loadings, partial)
                else:
                    pyarrow.parquet.write_table(loadings, partial)
                partial.replace(path)
            except OSError as error:
                raise InputError(f"{path}: cannot be written: {error}") from None
            paths.append(path)
    return paths


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
        files = [path for path in files if path.name in _KEPT_OF_OUTCOMES]
    return {path.relative_to(folder).as_posix(): _hash_file(path) for path in files}


def calc_inputs_hash(scenario: Scenario, n_loadings: int) -> str:
    """Return the hash of all that a sequence's outcomes depend on: scenario, seed, loadings, versions."""
    versions = get_versions()
    return calc_config_hash(scenario, str(n_loadings), versions["drakerock"], versions["drake"])


def get_versions() -> dict[str, str]:
    """Return the versions that results depend on."""
    return {"drakerock": drakerock.__version__} | {
        name: version(name) for name in ("drake", "numba", "numpy")
    }


def _connect(path: Path, make: bool = True) -> sqlite3.Connection:
    try:
        db = sqlite3.connect(path, isolation_level=None, timeout=30.0)
        (found,) = db.execute("PRAGMA user_version").fetchone()
        if found > _SCHEMA_VERSION:
            raise InputError(f"{path}: made by a newer version (format {found}, not {_SCHEMA_VERSION})")
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


def _describe_difference(folder: Path, study: StudyConfig) -> str:
    try:
        stored = read_study(folder).model_dump(mode="json")
    except InputError:
        stored = {}
    wanted = study.model_dump(mode="json")
    differs = [
        key for key in _list_differences(stored, wanted) if not key.startswith(("executor", "storage"))
    ]
    shown = ", ".join(differs[:5]) + (", ..." if len(differs) > 5 else "")
    return (
        f"--out {folder}: holds another study (different: {shown or 'unknown'}); take another folder, or the same "
        "study. The number of points, the executor and the storage may change."
    )


def _list_differences(one: Any, two: Any, prefix: str = "") -> list[str]:
    if isinstance(one, dict) and isinstance(two, dict):
        keys = sorted(set(one) | set(two))
        return [d for k in keys for d in _list_differences(one.get(k), two.get(k), f"{prefix}{k}.")]
    return [] if one == two else [prefix.rstrip(".")]


def _hash_file(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
