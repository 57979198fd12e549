"""Kernels take what they read first, and what they write last, as their docstrings say: read off their sources."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from drakerock.rocks import engine

# What vector instructions write cannot be read off Python: places among their arguments.
INTRINSICS = {"_update_batch": {0, 2, 3}, "_extrapolate": {0, 2}}
HEADING = re.compile(r"^ *(Reads|Writes|Args|Returns|Raises):$")


def collect_kernels() -> dict[str, ast.FunctionDef]:
    kernels: dict[str, ast.FunctionDef] = {}
    for path in sorted(Path(engine.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and any(
                isinstance(item, ast.Name) and item.id in ("kernel", "allocating_kernel")
                for item in node.decorator_list
            ):
                # Private kernels of one name in two files would be one here.
                assert node.name not in kernels, node.name
                kernels[node.name] = node
    return kernels


KERNELS = collect_kernels()


def get_arguments(kernel: ast.FunctionDef) -> list[str]:
    return [argument.arg for argument in kernel.args.args]


class Writes(ast.NodeVisitor):
    """Which arguments a kernel writes, given which ones others do."""

    def __init__(self, kernel: ast.FunctionDef, known: dict[str, set[int]]) -> None:
        self.arguments = get_arguments(kernel)
        self.known = known
        self.roots = {name: name for name in self.arguments}
        self.written: set[str] = set()
        for statement in kernel.body:
            self.visit(statement)

    def find_root(self, node: ast.expr) -> str | None:
        """Return the argument that an expression is a part of."""
        while isinstance(node, ast.Attribute | ast.Subscript | ast.Call):
            if isinstance(node, ast.Call) and not isinstance(node.func, ast.Attribute):
                return None
            node = node.func.value if isinstance(node, ast.Call) else node.value
        return self.roots.get(node.id) if isinstance(node, ast.Name) else None

    def assign(self, target: ast.expr, value: ast.expr | None) -> None:
        if isinstance(target, ast.Tuple):
            parts = value.elts if isinstance(value, ast.Tuple) else [value] * len(target.elts)
            for one, part in zip(target.elts, parts, strict=True):
                self.assign(one, part)
        elif isinstance(target, ast.Name):
            root = None if value is None else self.find_root(value)
            if root is None:
                self.roots.pop(target.id, None)
            else:
                self.roots[target.id] = root
        else:
            self.write(target)

    def write(self, node: ast.expr) -> None:
        root = self.find_root(node)
        if root is not None:
            self.written.add(root)

    def visit_Assign(self, node: ast.Assign) -> None:
        self.generic_visit(node)
        for target in node.targets:
            self.assign(target, node.value)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self.generic_visit(node)
        if not isinstance(node.target, ast.Name):
            self.write(node.target)

    def visit_Call(self, node: ast.Call) -> None:
        self.generic_visit(node)
        if isinstance(node.func, ast.Name):
            for place in self.known.get(node.func.id, ()):
                self.write(node.args[place])


def find_writes() -> dict[str, set[int]]:
    """Return the places of the arguments that each kernel writes, itself or by those it calls."""
    known: dict[str, set[int]] = {name: set() for name in KERNELS} | INTRINSICS
    while True:
        found = dict(INTRINSICS)
        for name, kernel in KERNELS.items():
            arguments = get_arguments(kernel)
            found[name] = {arguments.index(item) for item in Writes(kernel, known).written}
        if found == known:
            return known
        known = found


WRITES = find_writes()


def list_documented(docstring: str, heading: str) -> list[str]:
    """Return the names under a heading, in their order."""
    names, inside, indent = [], False, 0
    for line in docstring.splitlines():
        match = HEADING.match(line)
        if match or not line.strip():
            inside = match is not None and match[1] == heading
            indent = len(line) - len(line.lstrip()) + 4
        elif inside and len(line) - len(line.lstrip()) == indent:
            names += line.split(":")[0].strip().split(", ")
    return names


def test_writes_are_found():
    assert WRITES["dot"] == set()
    assert WRITES["set_vector"] == {1}
    assert WRITES["copy_body"] == {1}  # by an attribute, and by a kernel that it calls
    assert WRITES["solve_batch"] == {1, 2}  # by vector instructions


@pytest.mark.parametrize("name", sorted(KERNELS))
def test_what_is_written_comes_last(name):
    arguments, written = get_arguments(KERNELS[name]), WRITES[name]
    read = [item for k, item in enumerate(arguments) if k not in written]
    assert arguments[: len(read)] == read, f"written: {[arguments[k] for k in sorted(written)]}"


@pytest.mark.parametrize("name", sorted(name for name in KERNELS if WRITES[name]))
def test_docstrings_say_what_is_read_and_what_is_written(name):
    docstring, arguments = ast.get_docstring(KERNELS[name]) or "", get_arguments(KERNELS[name])
    headings = {match[1] for match in map(HEADING.match, docstring.splitlines()) if match}
    assert "Args" not in headings
    if not headings & {"Reads", "Writes"}:
        # Of what nobody else calls, or of one line, the order says it.
        assert name.startswith("_") or len(arguments) <= 4
        return
    written = [item for k, item in enumerate(arguments) if k in WRITES[name]]
    assert list_documented(docstring, "Writes") == written
    assert list_documented(docstring, "Reads") == [item for item in arguments if item not in written]
