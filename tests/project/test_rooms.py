"""The flow of the package is one-way: a room imports only from the floors below it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Final

from conftest import ROOT

SOURCE: Final = ROOT / "src" / "railfix"

#: The rooms (the packages below `railfix`), floor by floor. CONTRIBUTING.md draws the same.
FLOORS: Final[tuple[tuple[str, ...], ...]] = (
    ("core",),
    ("kernels",),
    ("gnss",),
    ("io",),
    ("track",),
    ("ranges",),
    ("positioning", "motion"),
    ("screens", "integrity"),
    ("tracking",),
    ("pipeline",),
    ("run",),
    ("simulate", "reference", "live"),
    ("ground",),
    ("evaluate",),
    ("report",),
    ("cli",),
)
FLOOR_OF: Final = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}


@cache
def _statements(path: Path) -> list[ast.Import | ast.ImportFrom | ast.FunctionDef | ast.AsyncFunctionDef]:
    """Imports and functions of a file, wherever in the file they stand."""
    kinds = (ast.Import, ast.ImportFrom, ast.FunctionDef, ast.AsyncFunctionDef)
    return [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, kinds)]


def _room(path: Path) -> str:
    """Room of a source file: the first name below the package."""
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def _imported_rooms(path: Path) -> set[str]:
    """Rooms that one file imports."""
    rooms: set[str] = set()
    for node in _statements(path):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: write imports with the package's name"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        rooms |= {name.split(".")[1] for name in names if name.startswith("railfix.")}
    return rooms - {"__version__"}


def _sources() -> list[Path]:
    return [p for p in sorted(SOURCE.rglob("*.py")) if p.parent != SOURCE or not p.name.startswith("__")]


@cache
def _graph() -> dict[str, set[str]]:
    graph: dict[str, set[str]] = {}
    for path in _sources():
        graph.setdefault(_room(path), set()).update(_imported_rooms(path) - {_room(path)})
    return graph


def test_every_room_has_a_floor() -> None:
    assert sorted(set(_graph()) - set(FLOOR_OF)) == [], "name the floor of a new room in FLOORS"


def test_a_room_imports_only_from_its_floor_or_below() -> None:
    wrong = [
        f"{room} (floor {FLOOR_OF[room]}) imports {other} (floor {FLOOR_OF[other]})"
        for room, others in _graph().items()
        for other in others
        if room in FLOOR_OF and other in FLOOR_OF and FLOOR_OF[other] > FLOOR_OF[room]
    ]
    assert wrong == []


def test_rooms_do_not_import_each_other_in_a_circle() -> None:
    rest = _graph()
    while True:
        imported = set().union(*rest.values()) if rest else set()
        outside = [room for room, others in rest.items() if not others & set(rest) or room not in imported]
        if not outside:
            break
        rest = {room: others - set(outside) for room, others in rest.items() if room not in outside}
    assert rest == {}, "these rooms import each other"


def _modules() -> dict[str, Path]:
    """Return the files by the names of their modules; the faces of packages, which only pass names on, are left out."""
    names = {p: ".".join(("railfix", *p.relative_to(SOURCE).with_suffix("").parts)) for p in SOURCE.rglob("*.py")}
    return {name: path for path, name in names.items() if not path.name.startswith("__")}


def find_circles(imports: dict[str, set[str]]) -> list[set[str]]:
    """Return the sets of modules that reach each other by imports, of two modules or more."""
    reached: dict[str, set[str]] = {}
    for start in imports:
        seen, waiting = set[str](), [start]
        while waiting:
            found = imports[waiting.pop()] - seen
            seen |= found
            waiting.extend(found)
        reached[start] = seen
    circles = [
        {other for other in reached[name] if name in reached[other]} for name in imports if name in reached[name]
    ]
    return [circle for i, circle in enumerate(circles) if circle not in circles[:i]]


def test_files_do_not_import_each_other_in_a_circle() -> None:
    """Imports for types alone count: a reader of either file needs the other."""
    modules = _modules()
    imports: dict[str, set[str]] = {name: set() for name in modules}
    for name, path in modules.items():
        for node in _statements(path):
            if isinstance(node, ast.Import):
                imports[name] |= {alias.name for alias in node.names} & modules.keys()
            elif isinstance(node, ast.ImportFrom) and node.module:
                named = {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
                imports[name] |= named & modules.keys()
    assert find_circles(imports) == []


def test_a_circle_of_files_is_found() -> None:
    assert find_circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [{"a", "b", "c"}]
    assert find_circles({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


def _exports(stub: Path) -> Iterator[str]:
    """Names that a package imports at their first use, its own parts left out."""
    for node in ast.walk(ast.parse(stub.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            yield from (item.asname or item.name for item in node.names)


def test_no_name_of_a_package_is_that_of_one_of_its_files() -> None:
    """Otherwise the first import decides which of the two the name is."""
    same = [
        f"{stub.parent.relative_to(SOURCE)}: {name}"
        for stub in sorted(SOURCE.rglob("__init__.pyi"))
        for name in _exports(stub)
        if (stub.parent / f"{name}.py").exists() or (stub.parent / name).is_dir()
    ]
    assert not same, same


def test_files_stay_small() -> None:
    large = {str(p.relative_to(ROOT)): n for p in _sources() if (n := len(p.read_text().splitlines())) > 450}
    assert large == {}, "is there a second room in these files?"


def _body_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function's body without its docstring."""
    body = function.body[1:] if ast.get_docstring(function) else function.body
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def test_functions_have_at_most_60_lines_of_body() -> None:
    long = {
        f"{path.relative_to(ROOT)}:{node.lineno} {node.name}": lines
        for path in SOURCE.rglob("*.py")
        for node in _statements(path)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and (lines := _body_lines(node)) > 60
    }
    assert long == {}, "which step of these functions has a name of its own?"
