"""Count the structure of the sources: import cycles, functions that take the whole Slam, lines, documented shapes.

    python benchmarks/structure.py [--missing] [--scan]

`--missing` lists the public functions whose docstring states no shape, `--scan` runs one scan with and one without ids
and counts the files that its calls enter.  The rule for shapes: a public function or method that takes or returns an
array (by its annotations; mappings of named arrays excepted) has a docstring with a shape, such as (K, 3) or (n,).
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

ROOT = Path(__file__).parent.parent
SOURCES = ROOT / "src" / "kalmark"
ARRAY = re.compile(r"\b(NDArray|ndarray)\b")
NAMED = ("dict[", "Mapping[")
SIZE = r"(?:[^(),]|\([^()]*\))"
SHAPE = re.compile(rf"\((?=(?:{SIZE}|,)*\b(?:\d+|[A-Z]|[dkmnp]|dof|axes|count|size)\b){SIZE}+,(?:{SIZE}|,)*\)")
Function = ast.FunctionDef | ast.AsyncFunctionDef


class Public(NamedTuple):
    """A public function that takes or returns arrays, and whether its docstring has a shape."""

    place: str
    documented: bool


def modules() -> dict[str, Path]:
    """Return the files of the package by the names of their modules."""
    files = {".".join(f.relative_to(SOURCES.parent).with_suffix("").parts): f for f in sorted(SOURCES.rglob("*.py"))}
    return {name.removesuffix(".__init__"): file for name, file in files.items()}


def imports(names: dict[str, Path]) -> dict[str, set[str]]:
    """Return the modules that each module imports, for types and inside functions included."""
    found = {}
    for name, file in names.items():
        package = name.split(".") if file.stem == "__init__" else name.split(".")[:-1]
        found[name] = set[str]()
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                found[name] |= {alias.name for alias in node.names}
            if isinstance(node, ast.ImportFrom):
                base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
                base = ".".join(part for part in (base, node.module) if part)
                parts = {f"{base}.{alias.name}" for alias in node.names}
                found[name] |= parts & names.keys() if parts <= names.keys() else parts | {base}
        found[name] = {other for other in found[name] & names.keys() if other != name}
    return found


def largest_cycle(edges: dict[str, set[str]]) -> int:
    """Return how many modules the largest strongly connected component has, 0 without a cycle."""
    try:
        TopologicalSorter(edges).prepare()
    except CycleError:
        reach = {name: reachable(edges, name) for name in edges}
        return max(sum(name in reach[other] for other in reach[name]) for name in edges if name in reach[name])
    return 0


def reachable(edges: dict[str, set[str]], start: str) -> set[str]:
    """Return what can be reached from a module by one import or more."""
    found, waiting = set[str](), [*edges[start]]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += edges[name]
    return found


def functions(tree: ast.Module) -> Iterator[tuple[str, Function]]:
    """Yield the public functions of a module and the public methods of its public classes."""
    for node in tree.body:
        if isinstance(node, Function) and not node.name.startswith("_"):
            yield node.name, node
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            for child in node.body:
                if isinstance(child, Function) and not child.name.startswith("_"):
                    yield f"{node.name}.{child.name}", child


def of_arrays() -> list[Public]:
    """Return the public functions that take or return arrays."""
    found = []
    for name, file in modules().items():
        tree = ast.parse(file.read_text())
        assigned = [node for node in tree.body if isinstance(node, ast.Assign)]
        values = {ast.unparse(node.targets[0]): ast.unparse(node.value) for node in assigned}
        aliases = [name for name, value in values.items() if ARRAY.search(value) and not value.startswith(NAMED)]
        array = re.compile(rf"\b({'|'.join([*aliases, 'NDArray', 'ndarray'])})\b")
        for function, node in functions(tree):
            arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            annotations = [ast.unparse(a) for a in (*(a.annotation for a in arguments), node.returns) if a is not None]
            if any(array.search(a) and not a.startswith(NAMED) for a in annotations):
                found.append(Public(f"{name}.{function}", bool(SHAPE.search(ast.get_docstring(node) or ""))))
    return found


def taking_slam() -> list[str]:
    """Return the functions outside slam/slam.py that take the whole Slam, in the packages below the logs."""
    below = ("association", "filter", "management", "models", "slam", "tracks")
    found = []
    for name, file in modules().items():
        if name.split(".")[1:2] and name.split(".")[1] in below and name != "kalmark.slam.slam":
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, Function) and any(a.arg == "slam" for a in node.args.args):
                    found.append(f"{name}.{node.name}")
    return found


def files_to_touch() -> dict[str, int]:
    """Return how many files CONTRIBUTING.md names for each kind of addition: alternatives count once."""
    rows = [line.split("|") for line in (ROOT / "CONTRIBUTING.md").read_text().splitlines() if line.startswith("| a")]
    return {cells[1].strip(): cells[2].count(";") + 1 for cells in rows}


def files_of_a_scan(with_ids: bool) -> set[str]:
    """Return the files that the calls of one scan enter, after a few scans of the same landmarks."""
    import kalmark as km

    files = set[str]()

    def enter(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(str(SOURCES)):
            files.add(str(Path(frame.f_code.co_filename).relative_to(SOURCES)))

    rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    slam = km.Slam([rover], None if with_ids else km.association.NearestNeighbour())
    for t_s in range(1, 7):
        scan = km.Scan(t_s, "rover", "lidar", y=[[4.2, 0.3], [5.0, -0.6]], ids=[7, 8] if with_ids else None)
        slam.process(km.Control(t_s, "rover", u=(0.0, 0.0)))
        sys.setprofile(enter if t_s == 6 else None)
        slam.process(scan)
        sys.setprofile(None)
    return files


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--missing", action="store_true")
    parser.add_argument("--scan", action="store_true")
    given, public = parser.parse_args(), of_arrays()
    if given.missing:
        print(*(one.place for one in public if not one.documented), sep="\n")
        return
    if given.scan:
        for name, with_ids in (("known ids", True), ("unknown ids", False)):
            print(f"files of one scan, {name}: {len(files_of_a_scan(with_ids))}")
        return
    names = modules()
    documented = sum(one.documented for one in public)
    print(f"lines {sum(len(file.read_text().splitlines()) for file in names.values())}, modules {len(names)}")
    print(f"modules in the largest import cycle: {largest_cycle(imports(names))}")
    print(f"functions that take the whole Slam: {len(taking_slam())}")
    for kind, count in files_to_touch().items():
        print(f"files to touch, {kind}: {count}")
    print(f"public functions with shapes: {documented} of {len(public)}, {documented / len(public):.1%}")


if __name__ == "__main__":
    main()
