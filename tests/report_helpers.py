"""What tests of commands that end with a report need: saving all of its figures takes ten seconds."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from drakerock.viewing import report

save_figures = report.save_figures


def save_confirmation(figures: dict[str, Figure], folder: Path) -> list[Path]:
    """Save the confirmation's figure, if there is one, and empty pictures in place of the others."""
    saved = save_figures({name: figures[name] for name in figures if name == "confirmation"}, folder)
    others = [folder / f"{name}.png" for name in figures if name != "confirmation"]
    for path in others:
        path.write_bytes(b"")
    return saved + others
