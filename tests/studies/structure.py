"""Sizes of the package and its documents: ``python tests/studies/structure.py [SOURCE]``.

Rooms, floors, imports, lines, the longest files and parameter lists, participles as names of functions, names that
several classes have, and words of the documents.
"""

from __future__ import annotations

import ast
import re
import sys
from collections import Counter
from pathlib import Path

import paths

DOCUMENTS = paths.ROOT / "docs"
#: First words of names that end in -ed and are none, and participles that do not.
NOT_PARTICIPLES = {"need", "feed", "speed", "seed", "embed", "exceed", "bed"}
#: Standard verbs of docstrings.
VERBS = set(
    "add advance append apply assemble build check choose collect combine compare compute connect convert copy "
    "correct count create decode describe detect draw encode estimate evaluate exclude fill find fit follow format "
    "generate get give handle hold insert interpolate join judge keep leave list load locate map match measure "
    "merge move note open parse plot position predict prepare print process put raise read receive record register "
    "reject remove replace report require reset resolve restore return rotate run save scale search select send "
    "serve set show simulate smooth solve sort split start stop store take test track update validate wait warn "
    "wrap write yield".split()
)
IRREGULAR = set("told given taken made found known written left sent held kept drawn chosen".split())


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


def is_participle(name: str) -> bool:
    """Whether a function is named by a participle: `prepared_line`, `sorted_by`, not `read_line` or `feed`."""
    first = name.strip("_").split("_")[0]
    return (first.endswith("ed") and first not in NOT_PARTICIPLES) or first in IRREGULAR


def is_property(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Whether a function is read like a field, so that its docstring is a noun."""
    return any("property" in ast.unparse(each) for each in function.decorator_list)


def first_words(function: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    """Return the words of the docstring of a function."""
    return re.findall(r"\w+", ast.get_docstring(function) or "")


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """How many parameters a function has, but for `self` and `cls`."""
    given = function.args
    every = [*given.posonlyargs, *given.args, *given.kwonlyargs, *(a for a in (given.vararg, given.kwarg) if a)]
    return sum(argument.arg not in ("self", "cls") for argument in every)


#: Modules of the public stages by hand with the filter, and of the processor with the tables of results.
STAGES = (
    "ranges.corrected", "ranges.sources", "positioning.approximate", "positioning.inter_system", "positioning.line_fix",
    "integrity.fault_exclusion", "integrity.protection.solution_separation", "screens.elevation", "tracking.filter",
)  # fmt: skip
PROCESSOR = ("pipeline.processor", "pipeline.result_tables")


def import_closure(trees: dict[Path, ast.Module], source: Path, modules: tuple[str, ...]) -> set[Path]:
    """Return the files that modules of the package import, directly or not, and their own."""
    names = {".".join(path.relative_to(source).with_suffix("").parts): path for path in trees}
    found: set[Path] = set()
    waiting = [names[module] for module in modules]
    while waiting:
        path = waiting.pop()
        if path in found:
            continue
        found.add(path)
        for node in ast.walk(trees[path]):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "kernels":
                # kernels are imported where they are called, so is their file counted
                waiting.extend(names[each] for each in (f"kernels.{node.attr}",) if each in names)
            if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("railfix"):
                continue
            if node.module == "railfix" and path.name != "__init__.py":
                continue
            inner = (node.module or "").removeprefix("railfix").lstrip(".")
            for name in (inner, *(f"{inner}.{alias.name}".lstrip(".") for alias in node.names)):
                # a face imports its names where they are asked for: each name counts as its own file
                waiting.extend(names[each] for each in (name, f"{name}.__init__") if each in names)
                stub = source / inner.replace(".", "/") / "__init__.pyi"
                if stub.exists():
                    waiting.extend(_behind_face(stub, inner, {alias.name for alias in node.names}, names))
    return found


def _behind_face(stub: Path, package: str, wanted: set[str], names: dict[str, Path]) -> list[Path]:
    """Return the files that names of a lazily imported package come from."""
    found = []
    for node in ast.parse(stub.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and wanted & {alias.name for alias in node.names}:
            module = f"{package}.{node.module}"
            found.extend(names[each] for each in (module, f"{module}.__init__") if each in names)
    return found


def main() -> int:
    source = Path(sys.argv[1]) if len(sys.argv) > 1 else paths.ROOT / "src" / "railfix"
    files = [p for p in sorted(source.rglob("*.py")) if p.parent != source or not p.name.startswith("__")]
    graph: dict[str, set[str]] = {}
    for path in files:
        room = room_of(path, source)
        graph.setdefault(room, set()).update(imported_rooms(path) - {room})
    trees = {p: ast.parse(p.read_text(encoding="utf-8")) for p in sorted(source.rglob("*.py"))}
    nodes = [(node, path) for path, tree in trees.items() for node in ast.walk(tree)]
    classes = [node for node, _ in nodes if isinstance(node, ast.ClassDef)]
    functions = [(node, path) for node, path in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    sizes = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in trees}
    named = Counter(node.name for node in classes)
    twice = sorted(f"{name} x{count}" for name, count in named.items() if count > 1)
    participles = [node.name for node, _ in functions if is_participle(node.name)]
    print(f"rooms           {len(graph)}")
    print(f"loose modules   {sum(p.parent == source for p in files)}")
    print(f"floors          {floors(graph)}")
    print(f"import arrows   {sum(len(others & set(graph)) for others in graph.values())}")
    print(f"files           {len(trees)}")
    print(f"lines           {sum(sizes.values())}")
    for title, modules in (("stages, filter", STAGES), ("processor", PROCESSOR)):
        closure = import_closure(trees, source, modules)
        print(f"{title:15s} {sum(sizes[path] for path in closure)} lines in {len(closure)} files that they import")
    print(f"dataclasses     {sum('dataclass' in ast.dump(d) for c in classes for d in c.decorator_list)}")
    print(f"__post_init__   {sum(node.name == '__post_init__' for node, _ in functions)}")
    print(f"participles     {len(participles)} of {len(functions)} functions")
    print(f"..._of          {sum(node.name.endswith('_of') for node, _ in functions)}")
    first = [words[0].lower() for node, _ in functions if not is_property(node) and (words := first_words(node))]
    print(f"verbs first     {sum(word in VERBS for word in first)} of {len(first)} docstrings of functions")
    print(f"class names     {len(twice)} in several files: {', '.join(twice)}")
    print("longest files")
    for path, size in sorted(sizes.items(), key=lambda item: -item[1])[:8]:
        print(f"  {size:6d}  {path.relative_to(source)}")
    print("longest parameter lists")
    for node, path in sorted(functions, key=lambda item: -parameters(item[0]))[:8]:
        print(f"  {parameters(node):6d}  {node.name} ({path.relative_to(source)}:{node.lineno})")
    tokens = {path: path.read_text(encoding="utf-8").split() for path in sorted(DOCUMENTS.rglob("*.md"))}
    documents = {path: sum(bool(re.search(r"\w", token)) for token in found) for path, found in tokens.items()}
    every = sum(len(found) for found in tokens.values())
    print(f"words           {sum(documents.values())} in {len(documents)} documents ({every} with the bars of tables)")
    for path, words in sorted(documents.items(), key=lambda item: -item[1])[:8]:
        print(f"  {words:6d}  {path.relative_to(DOCUMENTS)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
