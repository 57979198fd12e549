"""The file of a plan, plan.json: the plan, or why there is none, and the height field it was made from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from drakerock.errors import InputError
from drakerock.files import write_text
from drakerock.loading.field import HeightField
from drakerock.loading.plan import DigPlan, NoPlan


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
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
        seen = data["height_field"]
        field = HeightField(np.array(seen["x"]), np.array(seen["y"]), np.array(seen["h"]), seen["cell"])
        return (NoPlan(data["reason"]) if "reason" in data else DigPlan.from_dict(data)), field
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except KeyError as error:
        raise InputError(f"{path}: not a readable plan: {error} is missing") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: not a readable plan: {error}") from None
