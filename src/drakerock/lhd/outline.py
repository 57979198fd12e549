"""A machine's SDFormat file as XML: where things stand in it, and what Drake would drop without a word."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from drakerock.errors import InputError

_DRAKE = "drake.mit.edu"

# What Drake 1.58 reads past without a warning: (parent, element).
_DROPPED = {
    ("dynamics", "friction"),
    ("axis", "mimic"),
    ("limit", "stiffness"),
    ("inertial", "density"),
    ("inertial", "fluid_added_mass"),
    ("surface", "bounce"),
    ("surface", "contact"),
    ("surface", "soft_contact"),
    ("friction", "torsional"),
    ("friction", "bullet"),
    ("ode", "fdir1"),
    ("ode", "slip1"),
    ("ode", "slip2"),
}


@dataclass(eq=False)
class _Element:
    tag: str
    attributes: dict[str, str]
    line: int
    parent: _Element | None
    text: str = ""
    children: list[_Element] = field(default_factory=list)

    def find(self, tag: str) -> _Element | None:
        return next((child for child in self.children if child.tag == tag), None)

    def walk(self) -> Iterator[_Element]:
        yield self
        for child in self.children:
            yield from child.walk()


def _parse_xml(path: str, name: str) -> _Element:
    """Return the root element (ElementTree tells no lines)."""
    parser = expat.ParserCreate()
    top = _Element("", {}, 0, None)
    stack = [top]

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = _Element(tag, attributes, parser.CurrentLineNumber, stack[-1])
        stack[-1].children.append(element)
        stack.append(element)

    def add_text(text: str) -> None:
        stack[-1].text += text

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: stack.pop()
    parser.CharacterDataHandler = add_text
    try:
        parser.Parse(Path(path).read_bytes(), True)
    except OSError as error:
        raise InputError(f"{name}: cannot be read: {error.strerror}") from None
    except (expat.ExpatError, ValueError, LookupError) as error:
        line = f":{error.lineno}" if isinstance(error, expat.ExpatError) else ""
        raise InputError(f"{name}{line}: no valid XML: {error}") from None
    return top.children[0]


class Outline:
    """The named elements of a machine's file.

    Args:
        path: the file.
        name: what messages call it.

    Attributes:
        name: as given.
        ignored: what Drake drops without a word, a line each.

    Raises:
        InputError: no XML, no single <model>, a link without mass, or a loop of joints.
    """

    def __init__(self, path: str, name: str) -> None:
        self.name = name
        root = _parse_xml(path, name)
        for element in root.walk():
            self._check_prefix(element)
        if root.tag != "sdf":
            self._refuse(root, "expected <sdf> around everything")
        if [child.tag for child in root.children] != ["model"]:
            self._refuse(root, "<sdf> has to hold one <model> and nothing else")
        model = root.children[0]
        for child in model.children:
            if child.tag in ("model", "include"):
                self._refuse(
                    child,
                    f"a machine is one <model> without <{child.tag}>; write its links, joints and frames there",
                )
            if child.tag == "link":
                self._check_inertial(child)
        self._check_tree(model)
        self._places = {
            (element.tag, element.attributes["name"]): f"{name}:{element.line}"
            for element in model.walk()
            if "name" in element.attributes
        }
        self.ignored = [line for element in model.walk() for line in self._find_dropped(element)]

    def find(self, kind: str, name: str) -> str:
        """Return file and line of a named element."""
        return self._places.get((kind, name), self.name)

    def _refuse(self, element: _Element, text: str) -> None:
        raise InputError(f"{self.name}:{element.line}: {text}")

    def _check_prefix(self, element: _Element) -> None:
        for key, value in element.attributes.items():
            if key.startswith("xmlns:") and key != "xmlns:drake" and value == _DRAKE:
                self._refuse(
                    element,
                    f"Drake knows its elements by the prefix drake: alone, not by {key[6:]}:; "
                    f'write xmlns:drake="{_DRAKE}"',
                )

    def _check_inertial(self, link: _Element) -> None:
        """Refuse what SDFormat would give 1 kg or 1 kg m^2."""
        inertial = link.find("inertial")
        if inertial is None or inertial.find("mass") is None or inertial.find("inertia") is None:
            self._refuse(
                link,
                f"link '{link.attributes.get('name', '')}' has no <inertial> with <mass> and <inertia>: "
                "SDFormat would make it 1 kg and 1 kg m^2",
            )

    def _check_tree(self, model: _Element) -> None:
        """Refuse joints that close a loop, before Drake stumbles over them."""
        attached = {
            child.attributes.get("name", ""): child.attributes.get("attached_to", "")
            for child in model.children
            if child.tag == "frame"
        }
        group: dict[str, str] = {}

        def find_group(name: str) -> str:
            seen = {name}
            while (above := group.get(name) or attached.get(name)) and above not in seen:
                name = above
                seen.add(name)
            return name

        for joint in (child for child in model.children if child.tag == "joint"):
            ends = [end.text.strip() for tag in ("parent", "child") if (end := joint.find(tag))]
            groups = {find_group(end) for end in ends}
            if len(ends) == 2 and len(groups) == 1:
                self._refuse(
                    joint,
                    f"joint '{joint.attributes.get('name', '')}' closes a loop of joints at '{ends[1]}'; joints make a "
                    "tree, write <drake:ball_constraint> to close a loop",
                )
            if len(groups) == 2:
                one, other = groups
                group[one] = other

    def _find_dropped(self, element: _Element) -> Iterator[str]:
        parent = element.parent
        # Drake's words, where it has any.
        told = f"{self.name}:{element.line}: Ignoring unsupported SDFormat element in"
        if parent is not None and (parent.tag, element.tag) in _DROPPED and element.text.strip() != "0":
            yield f"{told} {parent.tag}: {element.tag}"
        if element.tag == "inertial" and element.attributes.get("auto", "false") in ("true", "1"):
            yield f"{told} inertial: auto"
        if element.tag == "screw_thread_pitch" and parent and parent.attributes.get("type") != "screw":
            yield f"{told} joint: screw_thread_pitch"
