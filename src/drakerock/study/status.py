"""How far a study is, from its database alone."""

from __future__ import annotations

import json
from typing import Any

from drakerock.study.db import Store


def read_status(store: Store) -> dict[str, Any]:
    """Return the state of the study as plain data, from the database alone."""
    study, db = store.study, store.db
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
        "SELECT AVG(seconds), AVG(awake), AVG(cpu_seconds) FROM (SELECT seconds, cpu_seconds, "
        "json_extract(outcome, '$.rocks.awake_mean') AS awake FROM cycles "
        "WHERE seconds IS NOT NULL ORDER BY recorded DESC LIMIT 100)"
    ).fetchone()
    cpu_used, memory = db.execute("SELECT SUM(cpu_seconds), MAX(memory_MB) FROM cycles").fetchone()
    run = db.execute(
        "SELECT run, started, ended, host, process, executor, workers, ending FROM runs ORDER BY run DESC"
    ).fetchone()
    names = ("number", "started", "ended", "host", "process", "executor", "workers", "ending")
    live = store.is_running()
    rest = (n_points - done - marked) * study.loadings - counted
    seconds, workers = recent[0], run[6] if run else 0
    running = [
        {"point": point.name, "attempt": point.attempt, "cycles": point.n_recorded}
        for point in store.list_points()
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
        "cpu_seconds_per_cycle": recent[2],
        "loadings_per_hour": 3600.0 * workers / seconds if seconds and workers else None,
        "cpu_hours_used": None if cpu_used is None else cpu_used / 3600.0,
        "cpu_hours_left": None if recent[2] is None else max(rest, 0) * recent[2] / 3600.0,
        "worker_memory_max_MB": memory,
        "awake_rocks_mean": recent[1],
        "eta_s": max(rest, 0) * seconds / workers if seconds is not None and workers else None,
        "last_run": dict(zip(names, run, strict=True)) if run else None,
        "versions": [json.loads(row[0]) for row in db.execute(
            "SELECT DISTINCT versions FROM sequences ORDER BY versions")],
    }  # fmt: skip
