"""Where the shipped data (models, the default pile, study files) lives, in a wheel and in a checkout."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent
_CHECKOUT = _PACKAGE.parent.parent


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
