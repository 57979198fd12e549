"""A study in one file, to be carried elsewhere and gone on with: `pack_study`, `unpack_study`.

The file is a tar archive compressed with LZMA. Its first member, ``manifest.json``, says what it is and has the SHA-256
of every other member: study.json, study.db (a consistent copy), the recorded files of the loadings and, of sequences
that are not finished, the pile that the next loading starts from.
"""

from __future__ import annotations

import hashlib
import io
import json
import lzma
import sqlite3
import tarfile
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from drakerock.errors import InputError
from drakerock.files import make_folder
from drakerock.loading.folder import NEXT_PILE, PLAN
from drakerock.study.db import DATABASE, KEPT_OF_OUTCOMES, POINTS, STUDY, Store, hash_file

MANIFEST = "manifest.json"
_FORMAT, _VERSION = "drakerock-study", 1


def pack_study(folder: str | Path, path: str | Path, *, everything: bool = False, plans: bool = True) -> Path:
    """Pack a study into one file.

    Args:
        folder: the study; not one that is running.
        path: the file to write, such as ``paper.tar.xz``; an old one is replaced once the new one is whole.
        everything: also the signals, recordings and piles of finished loadings, where the study keeps them.
        plans: also the plans, which are four fifths of the file without `everything`.

    Returns:
        The path.

    Raises:
        InputError: no study there, one that is running or damaged, or a file that cannot be written.
    """
    folder, path = Path(folder), Path(path)
    with Store.open(folder) as store, store.hold():
        partial = path.with_name(f".partial-{path.name}")
        try:
            with tempfile.TemporaryDirectory() as temporary:
                copy = Path(temporary) / DATABASE
                keeps = _make_filter(everything, plans)
                _copy_database(store, copy, keeps)
                members = {STUDY: folder / STUDY, DATABASE: copy} | dict(_list_files(store, keeps))
                make_folder(path.parent)
                _write(partial, members)
            partial.replace(path)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from None
        finally:
            partial.unlink(missing_ok=True)
    return path


def unpack_study(path: str | Path, folder: str | Path) -> Path:
    """Unpack a study into a folder of its own; `study run` goes on there.

    Args:
        path: what `pack_study` wrote.
        folder: made if missing; an empty one otherwise.

    Returns:
        The folder.

    Raises:
        InputError: not such a file, or a damaged one; a folder that holds something. Nothing is left there then.
    """
    path, folder = Path(path), Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: not an empty folder; take another one")
    make_folder(folder.parent)
    try:
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".unpacking-") as temporary:
            whole = Path(temporary) / "study"
            whole.mkdir()
            _read(path, whole)
            if folder.exists():
                folder.rmdir()
            whole.rename(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror or error}") from None
    return folder


def _make_filter(everything: bool, plans: bool) -> Callable[[str], bool]:
    """Return which recorded files of a finished loading come along, by their name."""
    return lambda name: (everything or name in KEPT_OF_OUTCOMES) and (plans or name != PLAN)


def _copy_database(store: Store, path: Path, keeps: Callable[[str], bool]) -> None:
    """Copy the database as it is at one instant, without its log."""
    copy = sqlite3.connect(path)
    try:
        store.db.backup(copy)
        # What is left behind is not missing there; the pile that an unfinished sequence goes on from comes along.
        rows = copy.execute(
            "SELECT c.rowid, c.files, s.status = 'running' AND c.loading = (SELECT MAX(d.loading) FROM cycles d "
            "WHERE d.point = c.point AND d.attempt = c.attempt) "
            "FROM cycles c JOIN sequences s ON s.point = c.point AND s.attempt = c.attempt"
        ).fetchall()
        for row, files, goes_on in rows:
            kept = {
                name: value
                for name, value in json.loads(files).items()
                if keeps(name) or (goes_on and name == NEXT_PILE)
            }
            copy.execute("UPDATE cycles SET files = ? WHERE rowid = ?", (json.dumps(kept), row))
        copy.commit()
        copy.execute("PRAGMA journal_mode = DELETE")
        copy.execute("VACUUM")
    finally:
        copy.close()


def _list_files(store: Store, keeps: Callable[[str], bool]) -> Iterator[tuple[str, Path]]:
    """Return the files that belong to the study, by their name in it, in order."""
    sequences = store.db.execute(
        "SELECT s.point, s.attempt, s.status, (SELECT COUNT(*) FROM cycles c WHERE c.point = s.point AND "
        "c.attempt = s.attempt) FROM sequences s ORDER BY s.point, s.attempt"
    ).fetchall()
    for point, attempt, status, n_cycles in sequences:
        folder = store.find_sequence_folder(point, attempt)
        names = [name for name in store.list_files(point, attempt) if keeps(name.partition("/")[2])]
        if status == "running" and n_cycles:
            last = f"loading_{n_cycles - 1:02d}"
            names += [name for name in (f"{last}/{NEXT_PILE}",) if name not in names]
        for name in sorted(names):
            file = folder / name
            if not file.exists():
                raise InputError(f"{file}: is recorded but not there; `study verify` says what else is wrong")
            yield file.relative_to(store.folder).as_posix(), file


def _write(path: Path, members: dict[str, Path]) -> None:
    """Write the archive; the same study gives the same bytes."""
    checksums = {name: hash_file(file) for name, file in members.items()}
    manifest = json.dumps({"format": _FORMAT, "version": _VERSION, "sha256": checksums}, indent=0).encode()
    with tarfile.open(path, "w:xz", preset=6, format=tarfile.PAX_FORMAT) as archive:
        archive.addfile(_make_entry(MANIFEST, len(manifest)), io.BytesIO(manifest))
        for name, file in members.items():
            with open(file, "rb") as data:
                archive.addfile(_make_entry(name, file.stat().st_size), data)


def _make_entry(name: str, size: int) -> tarfile.TarInfo:
    entry = tarfile.TarInfo(name)
    entry.size, entry.mode = size, 0o644
    return entry


def _read(path: Path, folder: Path) -> None:
    """Write the archive's members into a folder, each checked.

    Raises:
        InputError: it is not a packed study, or damaged.
    """
    try:
        with tarfile.open(path, "r:xz") as archive:
            first = archive.next()
            data = archive.extractfile(first) if first is not None and first.name == MANIFEST else None
            if data is None:
                raise InputError(f"{path}: not a packed study (no {MANIFEST} in it)")
            expected = _read_manifest(path, json.loads(data.read()))
            while (entry := archive.next()) is not None:
                _check_entry(path, entry, expected)
                member = archive.extractfile(entry)
                assert member is not None  # it is a plain file
                target = folder / entry.name
                target.parent.mkdir(parents=True, exist_ok=True)
                digest = hashlib.sha256()
                with open(target, "wb") as out:
                    while block := member.read(1 << 20):
                        digest.update(block)
                        out.write(block)
                if digest.hexdigest() != expected.pop(entry.name):
                    raise InputError(f"{path}: damaged: {entry.name} is not as it was packed")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (tarfile.TarError, lzma.LZMAError, EOFError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a readable packed study: {error}") from None
    if expected:
        raise InputError(
            f"{path}: damaged: {len(expected)} files are missing, {next(iter(expected))} is the first"
        )


def _read_manifest(path: Path, manifest: Any) -> dict[str, str]:
    if not isinstance(manifest, dict) or manifest.get("format") != _FORMAT:
        raise InputError(f"{path}: not a packed study")
    if manifest["version"] > _VERSION:
        raise InputError(
            f"{path}: packed by a newer version ({manifest['version']}; this one reads {_VERSION})"
        )
    return dict(manifest["sha256"])


def _check_entry(path: Path, entry: tarfile.TarInfo, expected: dict[str, str]) -> None:
    """Raise an InputError unless a member is a plain file of a study, in the study's folder."""
    parts = PurePosixPath(entry.name).parts
    inside = entry.name in (STUDY, DATABASE) or (parts[:1] == (POINTS,) and ".." not in parts)
    if not (entry.isreg() and inside and entry.name in expected):
        raise InputError(f"{path}: {entry.name}: not a file of a packed study")
