"""What results depend on: the content of a configuration, whatever its files are called, and the program's revision."""

from __future__ import annotations

import hashlib
import json
import re
from functools import lru_cache
from importlib.metadata import version
from os.path import normpath
from pathlib import Path
from typing import Any

from drakerock.config import Config
from drakerock.resources import find_file

# Raised whenever the same inputs give other results than before, by however little. It is part of every hash, so
# that results of two revisions never meet in one sequence, study or cache.
# 1: the first that is counted.
RESULTS_REVISION = 2

_REFERENCE = re.compile(rb"<uri>\s*([^<]*?)\s*</uri>|\bfilename\s*=\s*[\"']([^\"']+)[\"']")


def calc_config_hash(config: Config, *extra: str) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of a configuration's content and the results revision.

    Args:
        config: any schema instance.
        extra: further strings that belong to the identity (a number of loadings, versions).
    """
    text = json.dumps([RESULTS_REVISION, describe_content(config), *extra], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def describe_content(config: Config) -> dict[str, Any]:
    """Return a configuration as plain data, with the content's hash in place of each file's name."""
    return {
        name: _describe(getattr(config, name), name in config.file_fields)
        for name in type(config).model_fields
    }


def _describe(value: Any, is_file: bool) -> Any:
    if isinstance(value, Config):
        return describe_content(value)
    if isinstance(value, tuple):
        return [_describe(item, is_file) for item in value]
    if not is_file or value is None:
        return value
    # A function in a file is named ``file.py:function``.
    name, colon, function = value.rpartition(".py:")
    return [calc_file_hash(f"{name}.py"), function] if colon else calc_file_hash(value)


def calc_file_hash(name: str) -> str:
    """Return the SHA-256 of a file and of all that it refers to, such as an SDFormat file's meshes.

    Args:
        name: a path, or ``package://drakerock/...``. A name that is no file stands for itself; who needs the file
            says that it is missing.
    """
    digest = hashlib.sha256()
    _add_file(digest, name, Path(), set())
    return digest.hexdigest()


def _add_file(digest: Any, name: str, folder: Path, known: set[Path]) -> None:
    try:
        path = Path(normpath(folder / find_file(name)))
        if path in known:
            return
        known.add(path)
        content = path.read_bytes()
    except (OSError, ValueError):
        digest.update(f"\0{name}".encode())
        return
    digest.update(len(content).to_bytes(8, "little") + content)
    if path.suffix.lower() not in (".sdf", ".urdf", ".xml"):
        return
    for uri, filename in _REFERENCE.findall(content):
        _add_file(digest, (uri or filename).decode(errors="replace"), path.parent, known)


@lru_cache
def get_versions() -> dict[str, str]:
    """Return the versions that results depend on, the results revision (``results``) first."""
    names = ("drakerock", "drake", "numba", "numpy")
    return {"results": str(RESULTS_REVISION)} | {name: version(name) for name in names}
