"""The file of a plan, plan.json: the plan, or why there is none, and the height field it was made from."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from drakerock.errors import InputError
from drakerock.files import read_json, write_text
from drakerock.loading.field import HeightField
from drakerock.loading.plan import DigPlan, NoPlan, SpeedTable


def save_plan(plan: DigPlan | NoPlan, field: HeightField, path: str | Path) -> None:
    """Write a plan and the height field (heights to a tenth of a millimetre) as JSON.

    Raises:
        InputError: the file cannot be written.
    """
    data: dict[str, Any] = plan.to_dict() if isinstance(plan, DigPlan) else {"reason": plan.reason}
    data["height_field"] = {
        "x": field.x.tolist(),
        "y": field.y.tolist(),
        "h": np.round(field.h, 4).tolist(),
        "cell": field.cell,
    }
    write_text(Path(path), json.dumps(data))


def load_plan(path: str | Path) -> tuple[DigPlan | NoPlan, HeightField]:
    """Read what `save_plan` wrote.

    Raises:
        InputError: missing, or not a plan.
    """
    data = read_json(Path(path), "a readable plan")
    try:
        seen = data["height_field"]
        x, y, h = (np.array(seen[name], dtype=float) for name in ("x", "y", "h"))
        field = HeightField(x, y, h, float(seen["cell"]))
        _check_field(field)
        if "reason" in data:
            return NoPlan(str(data["reason"])), field
        plan = DigPlan.from_dict(data)
        _check_plan(plan)
        return plan, field
    except KeyError as error:
        raise InputError(f"{path}: not a readable plan: {error} is missing") from None
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: not a readable plan: {error}") from None


def _check_field(field: HeightField) -> None:
    """Raise a ValueError if a height field's arrays do not fit each other."""
    form = (field.x.size, field.y.size)
    if field.x.ndim != 1 or field.y.ndim != 1 or field.h.shape != form or 0 in form:
        raise ValueError(f"height_field: h has the shape {field.h.shape} instead of {form}")
    if not all(np.isfinite(values).all() for values in (field.x, field.y, field.h)) or not field.cell > 0.0:
        raise ValueError("height_field: numbers that are not finite, or cell <= 0")


def _check_plan(plan: DigPlan) -> None:
    """Raise a ValueError if a plan's numbers are none, or its arrays do not fit each other."""
    k, m = np.size(plan.x), len(np.atleast_1d(plan.swept))
    forms: dict[str, tuple[int, ...]] = dict.fromkeys(
        ("waypoint_x", "waypoint_z", "waypoint_psi", "waypoint_t"), (5,)
    )
    forms |= dict.fromkeys(("x", "z", "psi", "phi_l", "phi_b", "t", "segment"), (k,)) | {"swept": (m, 2)}
    for item in fields(plan):
        value = getattr(plan, item.name)
        if item.name in ("v_x", "v_z", "omega"):
            if not isinstance(value, SpeedTable):
                raise ValueError(f"{item.name}: expected the lists at and speed")
            parts = {f"{item.name}.at": value.at, f"{item.name}.speed": value.speed}
            form: tuple[int, ...] = (np.size(value.at),)
        else:
            parts, form = {item.name: value}, forms.get(item.name, ())
        for name, part in parts.items():
            array = np.asarray(part)
            if array.shape != form or 0 in form or array.dtype.kind not in "fiub":
                raise ValueError(f"{name}: expected {f'numbers {form}' if form else 'a number'}")
            if not np.isfinite(array).all():
                raise ValueError(f"{name}: not finite")
