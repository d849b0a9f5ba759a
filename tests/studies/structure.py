"""Count rooms, floors, imports, lines and classes of the package: ``python tests/studies/structure.py [SOURCE]``."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import paths


def imported_rooms(path: Path) -> set[str]:
    """Rooms that one file imports, wherever in the file the import stands."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name.split(".")[1] for name in names if name.startswith("railfix.")} - {"__version__"}


def room_of(path: Path, source: Path) -> str:
    """The first name below the package."""
    return path.relative_to(source).parts[0].removesuffix(".py")


def floors(graph: dict[str, set[str]]) -> int:
    """Length of the longest chain of imports; rooms in a circle count as one floor."""
    rest, count = {room: set(others) for room, others in graph.items()}, 0
    while rest:
        free = [room for room, others in rest.items() if not others & set(rest)]
        for room in free or list(rest):
            del rest[room]
        count += 1
    return count


def main() -> int:
    source = Path(sys.argv[1]) if len(sys.argv) > 1 else paths.ROOT / "src" / "railfix"
    files = [p for p in sorted(source.rglob("*.py")) if p.parent != source or not p.name.startswith("__")]
    graph: dict[str, set[str]] = {}
    for path in files:
        room = room_of(path, source)
        graph.setdefault(room, set()).update(imported_rooms(path) - {room})
    trees = [ast.parse(p.read_text(encoding="utf-8")) for p in source.rglob("*.py")]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    classes = [node for node in nodes if isinstance(node, ast.ClassDef)]
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef)]
    print(f"rooms           {len(graph)}")
    print(f"loose modules   {sum(p.parent == source for p in files)}")
    print(f"floors          {floors(graph)}")
    print(f"import arrows   {sum(len(others & set(graph)) for others in graph.values())}")
    print(f"files           {len(trees)}")
    print(f"lines           {sum(len(p.read_text(encoding='utf-8').splitlines()) for p in source.rglob('*.py'))}")
    print(f"dataclasses     {sum('dataclass' in ast.dump(d) for c in classes for d in c.decorator_list)}")
    print(f"__post_init__   {sum(f.name == '__post_init__' for f in functions)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
