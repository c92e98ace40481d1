"""The house: which module imports which, and how long files are."""

import ast
import importlib
from itertools import chain
from pathlib import Path

import pytest

import jaxid

PACKAGE = Path(jaxid.__file__).parent
ROOT = PACKAGE.parent

# A room is the first name below `jaxid`. It imports rooms of its own floor and of those below.
FLOORS = (
    {
        "arms",
        "chain",
        "compiling",
        "control",
        "display",
        "effects",
        "errors",
        "linear_algebra",
        "parameters",
        "recording",
        "signals",
        "storage",
    },
    {"exporting", "robots", "simulation"},
    {"estimate", "excitation", "noise"},
    {"discovery"},
    {"cli", "notebook", "report"},
    # The package's own namespace, and `python -m jaxid`.
    {"", "__main__"},
)
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}

# Physics knows what a parameter is, and no data.
NOUNS = ("arms", "effects")
FOR_NOUNS = {"chain", "errors", "linear_algebra", "parameters"}

LONGEST = 500


def module_of(path: Path) -> str:
    """The dotted name of a file of the package."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {module_of(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def room_of(module: str) -> str:
    """The first name below `jaxid`; nothing for `jaxid` itself."""
    return ".".join(module.split(".")[1:2])


def imports_in(text: str, module: str, is_package: bool) -> set[tuple[str, str]]:
    """Module and name of everything that a text imports from the package, in functions too."""
    base = module.split(".") if is_package else module.split(".")[:-1]
    found = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found |= {(alias.name, "") for alias in node.names if alias.name in FILES}
        elif isinstance(node, ast.ImportFrom):
            above = base[: len(base) - node.level + 1] if node.level else []
            source = ".".join([*above, *filter(None, [node.module])])
            for alias in node.names:
                whole = f"{source}.{alias.name}"
                if whole in FILES:
                    found.add((whole, ""))
                elif source in FILES:
                    found.add((source, alias.name))
    return found


IMPORTS = {
    module: imports_in(path.read_text(encoding="utf-8"), module, path.name == "__init__.py")
    for module, path in FILES.items()
}
MODULES = {module: {source for source, _ in found} for module, found in IMPORTS.items()}
ROOMS = {
    room: {
        room_of(source)
        for module, sources in MODULES.items()
        for source in sources
        if room_of(module) == room != room_of(source)
    }
    for room in map(room_of, FILES)
}


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules that import each other, directly or not (Tarjan 1972)."""
    number: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(module: str) -> None:
        number[module] = low[module] = len(number)
        stack.append(module)
        for other in sorted(graph[module]):
            if other not in number:
                visit(other)
                low[module] = min(low[module], low[other])
            elif other in stack:
                low[module] = min(low[module], number[other])
        if low[module] == number[module]:
            at = stack.index(module)
            group, stack[at:] = stack[at:], []
            if len(group) > 1 or module in graph[module]:
                found.append(sorted(group))

    for module in graph:
        if module not in number:
            visit(module)
    return found


def test_no_modules_import_each_other():
    assert circles(MODULES) == []


def test_no_rooms_import_each_other():
    assert circles(ROOMS) == []


@pytest.mark.parametrize(
    ("text", "package", "found"),
    [
        (
            "def f():\n    from ..report import write_report",
            False,
            {("jaxid.report", "write_report")},
        ),
        ("from .signals import fourier", True, {("jaxid.signals.fourier", "")}),
        ("from . import errors", True, {("jaxid.errors", "")}),
        ("import jaxid.report", False, {("jaxid.report", "")}),
        ("from jaxid import report", False, {("jaxid.report", "")}),
        ("import numpy\nfrom numpy import linalg", False, set()),
    ],
)
def test_imports_are_seen_wherever_they_stand(text, package, found):
    module = "jaxid" if package else "jaxid.discovery.story"
    assert imports_in(text, module, package) == found


def test_circles_are_seen():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a", "d"}}) == [
        ["a", "b", "c"],
        ["d"],
    ]
    assert circles({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []
    # The one that was there before: a story wrote itself as a page of the floor above.
    assert ["discovery", "report"] in circles(
        ROOMS | {"discovery": {*ROOMS["discovery"], "report"}}
    )


def test_rooms_keep_to_their_floors():
    assert set(ROOMS) == set(FLOOR)
    upward = [(r, o) for r, others in ROOMS.items() for o in others if FLOOR[o] > FLOOR[r]]
    assert upward == []


def test_arms_and_effects_know_parameters_alone():
    assert [(room, sorted(ROOMS[room] - FOR_NOUNS)) for room in NOUNS] == [(r, []) for r in NOUNS]


def test_what_is_private_stays_in_its_room():
    def is_private(source: str, name: str) -> bool:
        # `__main__` and the like are public.
        return any(
            part.startswith("_") and not part.startswith("__")
            for part in (*source.split("."), name)
        )

    across = [
        (module, source, name)
        for module, found in IMPORTS.items()
        for source, name in found
        if room_of(module) != room_of(source) and is_private(source, name)
    ]
    assert across == []


def test_no_module_is_hidden_behind_a_name_of_its_package():
    hidden = []
    for module in FILES:
        package, _, name = module.rpartition(".")
        # Importing `__main__` would run the command.
        if package and name != "__main__":
            imported = importlib.import_module(module)
            if getattr(importlib.import_module(package), name) is not imported:
                hidden.append(module)
    assert hidden == []


def test_files_are_short():
    if not (ROOT / "benchmarks").is_dir():
        pytest.skip("jaxid is installed without its checkout")
    paths = chain.from_iterable((ROOT / f).rglob("*.py") for f in ("jaxid", "tests", "benchmarks"))
    lines = {
        path.relative_to(ROOT).as_posix(): len(path.read_text(encoding="utf-8").splitlines())
        for path in paths
    }
    assert {name: count for name, count in lines.items() if count > LONGEST} == {}
