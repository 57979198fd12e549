"""Machine files changed at random: the small machine with elements dropped, doubled, renamed, with other numbers."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.systems.framework import DiagramBuilder

from drakerock.lhd.config import MachineConfig
from drakerock.lhd.geometry import make_bucket_geometry
from drakerock.lhd.kinematics import make_kinematics
from drakerock.lhd.model import add_machine
from drakerock.lhd.placement import set_machine_pose
from drakerock.resources import find_data

NUMBERS = (
    "0",
    "-1",
    "1",
    "0.5",
    "1e-9",
    "1e9",
    "-1e9",
    "nan",
    "inf",
    "-inf",
    "word",
    "",
    "1 2",
    "0 0 1",
    "1e400",
)


def mutate(rng: np.random.Generator) -> str:
    """Return the small machine's file, without its looks, with one to three random changes."""
    ET.register_namespace("drake", "drake.mit.edu")
    root = ET.parse(find_data("models", "lhd_small", "lhd_small.sdf")).getroot()
    for link in root.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    for _ in range(rng.integers(1, 4)):
        parents = {child: parent for parent in root.iter() for child in parent}
        # Every kind of element is as likely as any other.
        if not parents:
            break
        tags = sorted({element.tag for element in parents})
        tag = tags[rng.integers(len(tags))]
        same = [element for element in parents if element.tag == tag]
        _change(rng, same[rng.integers(len(same))], parents, list(parents))
    text = ET.tostring(root, encoding="unicode")
    if rng.random() < 0.03:
        text = text[: rng.integers(len(text))]
    if rng.random() < 0.03:
        text = text.replace("drake:", "d:").replace("xmlns:drake", "xmlns:d")
    return text


def _change(
    rng: np.random.Generator,
    element: ET.Element,
    parents: dict[ET.Element, ET.Element],
    all_: list[ET.Element],
) -> None:
    parent, other = parents[element], all_[rng.integers(len(all_))]
    match rng.integers(14):
        case 0:
            parent.remove(element)
        case 1:
            parent.append(element)
        case 2 if element.attrib:
            key = sorted(element.attrib)[rng.integers(len(element.attrib))]
            element.set(
                key, str(rng.choice(["", "world", "boom", "x y", "__model__", "nan", other.get("name", "z")]))
            )
        case 3:
            element.tag = other.tag
        case 4:
            element.text = other.text
        case 5 if element is not other and other not in element.iter() and element not in other.iter():
            parent.remove(element)
            other.append(element)
        case _:
            words = (element.text or "").split()
            if words:
                k = rng.integers(len(words))
                words[k] = _scale(rng, words[k]) if rng.random() < 0.6 else str(rng.choice(NUMBERS))
                element.text = " ".join(words)


def _scale(rng: np.random.Generator, word: str) -> str:
    try:
        return f"{float(word) * rng.choice([-1, 0.5, 0.9, 0.99, 1.01, 1.1, 2, 10]):.9g}"
    except ValueError:
        return word


def use(file: Path) -> None:
    """Do with a machine's file all that is done before a simulation starts."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.01), builder)
    machine = add_machine(plant, MachineConfig(model=str(file)))
    plant.Finalize()
    kin = make_kinematics(plant, machine)
    make_bucket_geometry(plant, scene_graph, machine)
    diagram = builder.Build()
    context = plant.GetMyMutableContextFromRoot(diagram.CreateDefaultContext())
    set_machine_pose(plant, context, machine, x_tip=0.0, kin=kin)
