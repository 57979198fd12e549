"""Where the shipped data (models, the default pile, study files) lives, in a wheel and in a checkout."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent
_CHECKOUT = _PACKAGE.parent.parent


_PREFIX = "package://drakerock/"


def find_file(name: str) -> Path:
    """Return the path of a data file: ``package://drakerock/...`` is among the shipped models, all else is a path.

    Raises:
        FileNotFoundError: no such shipped file.
    """
    name = name.removeprefix("file://")
    return find_data("models", name.removeprefix(_PREFIX)) if name.startswith(_PREFIX) else Path(name)


def find_study_file(path: Path) -> Path:
    """Return `path`; if it is ``studies/...`` and not there, the shipped file of that name, if there is one."""
    if path.parts[:1] != ("studies",) or path.exists():
        return path
    try:
        return find_data(*path.parts)
    except FileNotFoundError:
        return path


def find_data(*parts: str) -> Path:
    """Return the path of a shipped file or folder, such as ``find_data("models", "package.xml")``.

    Raises:
        FileNotFoundError: neither the installed package nor the checkout has it.
    """
    for root in (_PACKAGE, _PACKAGE / "data", _CHECKOUT):
        path = root.joinpath(*parts)
        if path.exists():
            return path
    raise FileNotFoundError("/".join(parts) + " is not among the data shipped with drakerock")
