"""A machine's design at another size: geometrically similar, of the same steel, at the same speeds over ground.

With all lengths k times as long: masses and the forces that balance them go with k^3, moments with k^4, and what
yields to them by an angle or a length that is similar goes accordingly. What the exponents below say is the page
`docs/own_machine.md`, with the reasons.
"""

from __future__ import annotations

import math
import re

import yaml

_NONE = (
    "colors",
    "lugs",
    "limit_deg",
    "stop_deg",
    "friction",
    "dissipation",
    "color",
    "mirror",
    "collision",
    "axis",
)

# By the last keys of a number's place in the design; the first that fits counts.
_EXPONENTS: tuple[tuple[tuple[str, ...], int], ...] = (
    *(((key,), 0) for key in _NONE),
    (("mass",), 3),
    (("articulation", "stiffness"), 4),  # a moment by an angle
    (("articulation", "damping"), 5),  # a moment by an angle's rate, which goes with 1/k
    (("motors", "damping"), 5),
    (("stiffness",), 2),  # a weight by a sink
    (("damping",), 3),  # a force by a speed
    (("effort",), 4),
    (("velocity",), -1),
)


def scale_design(text: str, factor: float, name: str) -> str:
    """Return a design's text at `factor` times its size, under another name; comments and layout stay.

    Args:
        text: a design.yaml.
        factor: k, by which all lengths grow.
        name: of the machine.

    Raises:
        ValueError: not a design, or a factor that is no positive number.
    """
    if not (math.isfinite(factor) and factor > 0):
        raise ValueError(f"a machine cannot be {factor:g} times as large")
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    if not isinstance(root, yaml.MappingNode):
        raise ValueError("not a design: no keys and values")
    edits: list[tuple[int, int, str]] = []
    _collect(root, (), factor, edits)
    for start, end, number in sorted(edits, reverse=True):
        text = text[:start] + number + text[end:]
    return re.sub(r"(?m)^name:.*$", f"name: {name}", text, count=1)


def calc_exponent(path: tuple[str, ...]) -> int:
    """Return the power of the factor that a number at this place of a design goes with."""
    for keys, exponent in _EXPONENTS:
        if len(keys) == 1 and keys[0] in path and keys[0] not in ("stiffness", "damping"):
            return exponent
        if path[-len(keys) :] == keys:
            return exponent
    return 1


def _collect(
    node: yaml.Node, path: tuple[str, ...], factor: float, edits: list[tuple[int, int, str]]
) -> None:
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            _collect(value, (*path, str(key.value)), factor, edits)
    elif isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _collect(item, path, factor, edits)
    elif node.tag in ("tag:yaml.org,2002:float", "tag:yaml.org,2002:int"):
        exponent = calc_exponent(path)
        if exponent:
            value = float(node.value) * factor**exponent
            edits.append((node.start_mark.index, node.end_mark.index, _show(value)))


def _show(value: float) -> str:
    """Return a number with five digits, as YAML reads a float: an exponent needs a point and a sign."""
    if value == 0.0 or 1e-4 <= abs(value) < 1e6:
        return f"{float(f'{value:.5g}'):.10g}"
    mantissa, exponent = f"{value:.4e}".split("e")
    return f"{mantissa}e{exponent}"
