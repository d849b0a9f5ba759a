"""How much of the package the stages import: ``python tests/studies/structure.py [SOURCE]``.

Printed are files and lines of the package, and of what the public stages with the filter, and the processor with the
tables, import, directly or not.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import paths

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


def main() -> None:
    """Print files and lines."""
    source = Path(sys.argv[1]) if len(sys.argv) > 1 else paths.ROOT / "src" / "railfix"
    texts = {path: path.read_text(encoding="utf-8") for path in sorted(source.rglob("*.py"))}
    trees = {path: ast.parse(text) for path, text in texts.items()}
    sizes = {path: len(text.splitlines()) for path, text in texts.items()}
    print(f"package         {sum(sizes.values())} lines in {len(sizes)} files")
    for title, modules in (("stages, filter", STAGES), ("processor", PROCESSOR)):
        closure = import_closure(trees, source, modules)
        print(f"{title:15s} {sum(sizes[path] for path in closure)} lines in {len(closure)} files that they import")
    for room in ("kernels/tracking", "tracking"):
        print(f"{room:15s} {sum(size for path, size in sizes.items() if path.parent == source / room)} lines")


if __name__ == "__main__":
    main()
