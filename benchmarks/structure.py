"""Counts of the structure of the sources, and their ratchet: no count of docs/architecture.md may rise.

    python benchmarks/structure.py [--missing | --check | --write]

Without an option the counts are printed, with the files and the calls of functions, compiled ones included, that a
control and a scan of a robot that moves enter.  `--check` compares them with the table of docs/architecture.md and
exits with 1 if one is above its limit, or so far below that the limit has to follow; `--write` lowers the limits.  A
limit is raised by hand, with its reason in the same line: one above that of an earlier version, as git has it, is
refused where the reason is still the same.  `--missing` lists the public functions whose docstring
states no shape: one that takes or returns an array (by its annotations; mappings of named arrays excepted) has a
docstring with a shape, such as (K, 3) or (n,).
"""

from __future__ import annotations

import argparse
import ast
import io
import math
import os
import re
import subprocess
import sys
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

ROOT = Path(__file__).parent.parent
SOURCES = ROOT / "src" / "kalmark"
LIMITS = ROOT / "docs" / "architecture.md"
ROW = re.compile(r"^\| (?P<name>[^|]+?) \| (?P<limit>\d+) \|(?P<why>[^|]*)\|$", re.MULTILINE)
VERSIONS = 20  # of the limits, with which they are compared
SLACK = 0.002  # of a limit, by which a count may be below it
QUESTIONS = ("what", "which", "how", "where", "why", "when", "whether")
FIGURATIVE = re.compile(
    r"\b(anew|asleep|awake|beyond doubt|believ\w+|blame\w*|foresee\w*|foresight|honest\w*|hopeless|knows?|leans?"
    r"|leaning|news|says?|said|sick|sight(?:ing|ings|ed)|tells?|told|wakes?|wants?)\b",
    re.IGNORECASE,
)
SUBJECTS = re.compile(  # of sentences, but of no questions
    r"(?:^|[.:!?]\s+|(?:^|\n)[\s*#|-]+|\n\d\. )\**(What)\b(?![^.?|]*\?)"
)
CODE = re.compile(r"```.*?```|`[^`]*`", re.DOTALL)
PLUGINS = ("bags", "datasets", "diagnosis", "viewer", "vision")
IMPORTS = ("import_module", "__import__")
WHOLE = re.compile(r"\b(State|Slam|Estimate)\b")  # the types of the slam and its state
MANY_BRANCHES, MANY_ARGUMENTS, OFTEN = 15, 7, 3
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
    """Return the modules that each module imports: for types, inside functions and by `import_module` included."""
    found = {}
    for name, file in names.items():
        package = name.split(".") if file.stem == "__init__" else name.split(".")[:-1]
        found[name] = set[str]()
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                found[name] |= {alias.name for alias in node.names}
            if isinstance(node, ast.Call) and called(node) in IMPORTS:
                found[name] |= {*texts(node.args)}
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


def called(node: ast.Call) -> str:
    """Return the name of the function that is called, without what it is an attribute of."""
    return str(getattr(node.func, "id", getattr(node.func, "attr", "")))


def docstrings(tree: ast.Module) -> Iterator[str]:
    """Yield the docstrings of a module, its classes, functions and fields, and the texts of `Annotated`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr):
            yield from texts([node.value])
        if isinstance(node, ast.Subscript) and ast.unparse(node.value).endswith("Annotated"):
            yield from (text for text in texts(ast.walk(node.slice)) if " " in text)


def texts(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Yield those of some nodes that are texts."""
    yield from (str(n.value) for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str))


def prose() -> Iterator[str]:
    """Yield the texts and comments of sources and examples and the pages of the documentation, without code."""
    for file in (*modules().values(), *(ROOT / "examples").glob("*.py")):
        source = file.read_text()
        yield from (CODE.sub("", text) for text in texts(ast.walk(ast.parse(source))) if " " in text)
        tokens = tokenize.generate_tokens(io.StringIO(source).readline)
        yield from (token.string for token in tokens if token.type == tokenize.COMMENT)
    for page in (*(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md")):
        yield CODE.sub("", page.read_text())


def figures_of_speech(text: str) -> list[str]:
    """Return the places of a text with words that the glossary replaces, or that begin a sentence with `What`."""
    found = (match for words in (FIGURATIVE, SUBJECTS) for match in words.finditer(text))
    return [text[max(match.start() - 40, 0) : match.end() + 40] for match in found]


def branches(node: ast.AST) -> int:
    """Return the branch points below a node: also conditional expressions, `and`, `or`, comprehensions, handlers."""
    number = 0
    for x in ast.walk(node):
        number += isinstance(x, ast.If | ast.IfExp | ast.For | ast.While | ast.ExceptHandler | ast.Assert)
        number += isinstance(x, ast.match_case)
        if isinstance(x, ast.BoolOp):
            number += len(x.values) - 1
        if isinstance(x, ast.comprehension):
            number += 1 + len(x.ifs)
    return number


def of_function(node: Function) -> Iterator[str]:
    """Yield the names of the counts that a function belongs to."""
    args, points = node.args, branches(node)
    every = [*args.posonlyargs, *args.args, *args.kwonlyargs]
    own = bool(args.args) and args.args[0].arg in ("self", "cls")
    if len(every) - own >= MANY_ARGUMENTS:
        yield f"functions of {MANY_ARGUMENTS} arguments or more"
    if any(a.arg in ("slam", "state") or (a.annotation and WHOLE.search(ast.unparse(a.annotation))) for a in every):
        yield "functions that take the slam or its state whole"
    if points > MANY_BRANCHES:
        yield f"functions over {MANY_BRANCHES} branch points"
    yield "functions"
    yield from ["branch points"] * points


def of_node(node: ast.AST) -> Iterator[str]:
    """Yield the names of the counts that a node of a syntax tree belongs to."""
    yield "syntax nodes"
    if isinstance(node, Function):
        yield from of_function(node)
    elif isinstance(node, ast.ClassDef):
        yield "classes"
        if any("Protocol" in ast.unparse(base) for base in node.bases):
            yield "protocols"
    elif isinstance(node, ast.Call):
        if called(node) in ("isinstance", "hasattr", "getattr"):
            yield "calls of isinstance, hasattr, getattr"
        if called(node) in IMPORTS and any(text.split(".")[0] == SOURCES.name for text in texts(node.args)):
            yield "imports hidden from the contract"


def of_module(tree: ast.Module) -> Iterator[str]:
    """Yield the name of the count of named numbers and texts, once for each of a module."""
    for x in tree.body:
        targets = x.targets if isinstance(x, ast.Assign) else [x.target] if isinstance(x, ast.AnnAssign) else []
        for target in targets:
            pairs = [(target, getattr(x, "value", None))]
            if isinstance(target, ast.Tuple) and isinstance(pairs[0][1], ast.Tuple):
                pairs = [*zip(target.elts, pairs[0][1].elts, strict=False)]
            for name, value in pairs:
                is_named = isinstance(name, ast.Name) and name.id.isupper()
                if is_named and isinstance(value, ast.Constant | ast.UnaryOp | ast.BinOp):
                    yield "named numbers and texts"


def counts() -> dict[str, int]:
    """Return the counts by their names."""
    files = [*modules().values()]
    trees = [ast.parse(file.read_text()) for file in files]
    core = [tree for file, tree in zip(files, trees, strict=True) if file.relative_to(SOURCES).parts[0] not in PLUGINS]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    public = [node.name for node in nodes if isinstance(node, Function) and not node.name.startswith("_")]
    stems = Counter(file.stem for file in files if file.stem != "__init__")
    found = Counter(name for node in nodes for name in of_node(node))
    found.update(name for tree in trees for name in of_module(tree))
    found["syntax nodes of the core"] = sum(1 for tree in core for _ in ast.walk(tree))
    heads = [text.lower().split()[0] for tree in trees for text in docstrings(tree) if text.strip()]
    found["docstrings that begin with a question word"] = sum(head in QUESTIONS for head in heads)
    found["words that the glossary replaces, sentences of `What`"] = sum(len(figures_of_speech(t)) for t in prose())
    homes = Counter(node.name for tree in trees for node in tree.body if isinstance(node, Function))
    found["functions of modules that share their name"] = sum(n for n in homes.values() if n > 1)
    found["file names used more than once"] = sum(n for n in stems.values() if n > 1)
    found[f"public names of {OFTEN} functions or more"] = sum(n >= OFTEN for n in Counter(public).values())
    found["modules in the largest import cycle"] = largest_cycle(imports(modules()))
    found["public functions of arrays without shapes"] = sum(not one.documented for one in of_arrays())
    return found


def of_a_scan() -> None:
    """Print the files and calls that a control and a scan of a robot that moves enter, after a few of its scans.

    The scan observes two landmarks again and one for the first time.
    """
    import kalmark as km

    def enter(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(str(SOURCES)):
            entered.append(frame.f_code.co_filename)

    for kind, ids in (("known", [7, 8, 9]), ("unknown", None)):
        rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
        slam, entered = km.Slam([rover], km.association.NearestNeighbour() if ids is None else None), list[str]()
        for t_s in range(1, 7):
            x = 0.1 * t_s
            places = [(4 - x, 1), (4 - x, -3), (6 - x, 4)][: 3 if t_s == 6 else 2]
            y = [[math.hypot(*place), math.atan2(place[1], place[0])] for place in places]
            sys.setprofile(enter if t_s == 6 else None)
            slam.process(km.Control(t_s, "rover", u=(0.1, 0.0)))
            slam.process(km.Scan(t_s, "rover", "lidar", y=y, ids=ids and ids[: len(y)]))
            sys.setprofile(None)
        print(f"files that a control and a scan of {kind} ids enter\t{len({*entered})}")
        print(f"calls of a control and a scan of {kind} ids\t{len(entered)}")


def traced() -> dict[str, int]:
    """Return the counts of `of_a_scan`, made where nothing is compiled, so that compiled functions are entered too."""
    command = [sys.executable, __file__, "--scan"]
    done = subprocess.run(command, env=os.environ | {"NUMBA_DISABLE_JIT": "1"}, stdout=subprocess.PIPE, check=True)
    rows = (line.split("\t") for line in done.stdout.decode().splitlines())
    return {name: int(number) for name, number in rows}


def against_limits(text: str, found: dict[str, int]) -> list[str]:
    """Return a line for each count that is not within its limit in a text, above or too far below."""
    limits, wrong = {row["name"]: int(row["limit"]) for row in ROW.finditer(text)}, []
    for name, number in (dict.fromkeys(limits, 0) | found).items():
        if name not in limits or number > limits[name]:
            wrong.append(f"{name}: {number}, at most {limits.get(name)}: remove some, or raise it with the reason")
        elif number < limits[name] * (1 - SLACK) - 1:
            wrong.append(f"{name}: {number}, at most {limits[name]}: lower the limit by --write")
    return wrong


def earlier_versions() -> list[str]:
    """Return the latest texts of docs/architecture.md that git has, none where there is no git or no history."""

    def git(*command: str) -> str:
        try:
            return subprocess.run(["git", *command], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        except (OSError, subprocess.CalledProcessError):
            return ""

    file = LIMITS.relative_to(ROOT)
    commits = git("log", "--first-parent", f"-{VERSIONS}", "--format=%H", "--", str(file)).split()
    return [git("show", f"{commit}:{file}") for commit in commits]


def raised_without_reason(text: str, earlier: Iterable[str]) -> list[str]:
    """Return a line for each limit of a text that is above that of an earlier one and has the same reason, or none."""
    now, wrong = {row["name"]: row for row in ROW.finditer(text)}, {}
    for old in (row for version in earlier for row in ROW.finditer(version)):
        new = now.get(old["name"], old)
        if int(new["limit"]) > int(old["limit"]) and new["why"].strip() in ("", old["why"].strip()):
            limits = f"{old['limit']} to {new['limit']}"
            wrong[old["name"]] = f"{old['name']}: the limit rose from {limits}, expected a reason of its own"
    return [*wrong.values()]


def lowered(text: str, found: dict[str, int]) -> str:
    """Return the text of docs/architecture.md with the limits that are above their counts lowered to these."""

    def row(old: re.Match[str]) -> str:
        name, limit = old["name"], int(old["limit"])
        return f"| {name} | {min(limit, found.get(name, 0))} |{old['why']}|"

    return ROW.sub(row, text)


def main() -> int:
    """Print the counts, or hold them against their limits."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for option in ("--missing", "--check", "--write", "--scan"):
        parser.add_argument(option, action="store_true", help=argparse.SUPPRESS if option == "--scan" else None)
    given = parser.parse_args()
    if given.scan:
        of_a_scan()
        return 0
    if given.missing:
        print(*(one.place for one in of_arrays() if not one.documented), sep="\n")
        return 0
    found = counts() | traced()
    if given.write:
        LIMITS.write_text(lowered(LIMITS.read_text(), found))
    if given.check:
        text, earlier = LIMITS.read_text(), earlier_versions()
        wrong = against_limits(text, found) + raised_without_reason(text, earlier)
        print(*wrong, *(() if earlier else ["git has no earlier limits: none are compared with them"]), sep="\n")
        return 1 if wrong else 0
    print(*(f"{name}: {number}" for name, number in found.items()), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
