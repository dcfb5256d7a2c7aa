# SPDX-License-Identifier: Apache-2.0
"""The structure of the code base as a table: code lines, files, import chains and exported names of each package.

    python tools/structure.py [--root DIR] [--against REV] [--chains]

Code lines hold code: no blank lines, comments, docstrings or vendored files. `web` counts the JavaScript,
CSS and HTML of all packages. A chain is the longest sequence of modules of a package in which each imports the next;
imports for type checking and `__init__.py` files do not count. `--against` prints another revision next to the working
tree, `--chains` the modules of each longest chain.
"""

from __future__ import annotations

import argparse
import ast
import functools
import io
import re
import subprocess
import sys
import tarfile
import tempfile
import tokenize
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
WEB = (".js", ".mjs", ".css", ".html", ".j2")
#: Comments of JavaScript, CSS, HTML and Jinja; strings and template literals are matched first, so that they stay.
WEB_COMMENT = re.compile(
    r"""("(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*'|`(?:\\.|[^`\\])*`)|/\*.*?\*/|<!--.*?-->|\{#.*?#\}|(?<![:\\])//[^\n]*""",
    re.DOTALL,
)
_NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


@dataclass(frozen=True)
class Row:
    """Figures of a package or folder; None where there are none."""

    lines: int
    files: int
    chain: tuple[str, ...] | None = None
    exported: int | None = None


def python_lines(source: str) -> int:
    """Count the code lines of a Python file."""
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)) and node.body:
            first = node.body[0]
            value = first.value if isinstance(first, ast.Expr) else None
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                docstrings.update(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    return len(lines - docstrings)


def web_lines(source: str) -> int:
    """Count the code lines of a JavaScript, CSS or HTML file."""
    return sum(bool(line.strip()) for line in WEB_COMMENT.sub(lambda match: match[1] or "", source).splitlines())


def shell_lines(source: str) -> int:
    """Count the code lines of a shell script."""
    return sum(bool(line.strip()) and not line.lstrip().startswith("#") for line in source.splitlines())


def code_lines(path: Path) -> int:
    """Count the code lines of a file; 0 for kinds of files that are not counted."""
    count = {".py": python_lines, ".sh": shell_lines, **dict.fromkeys(WEB, web_lines)}.get(path.suffix)
    return count(path.read_text(encoding="utf-8")) if count else 0


def is_vendored(path: Path) -> bool:
    """Return whether a file is somebody else's: it is in a folder `vendor` or minified."""
    return "vendor" in path.parts or ".min." in path.name


def packages(root: Path) -> list[str]:
    """Return the names of the suite's import packages."""
    return sorted(path.parent.name for path in root.glob("openarm_*/__init__.py"))


@functools.cache
def imports(path: Path) -> tuple[tuple[str, int, bool], ...]:
    """Return the absolute names that a module imports, each with its line and whether it is for type checking only.

    Raises:
        ValueError: The module has a relative import.
    """
    text = path.read_text(encoding="utf-8")
    nodes = list(ast.walk(ast.parse(text)))
    for_types = {
        id(inner)
        for node in (nodes if "TYPE_CHECKING" in text else ())
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    found: list[tuple[str, int, bool]] = []
    for node in nodes:
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno, id(node) in for_types) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                raise ValueError(f"{path}:{node.lineno}: relative import; write the name of the package")
            found += [(f"{node.module}.{alias.name}", node.lineno, id(node) in for_types) for alias in node.names]
    return tuple(found)


def imported_names(path: Path) -> dict[str, int]:
    """Return the names that a module imports, with the line; imports for type checking are left out."""
    return {name: line for name, line, for_types in imports(path) if not for_types}


def module_imports(root: Path, package: str) -> dict[str, set[str]]:
    """Return for each module of a package the modules of the same package that it imports."""
    paths = [path for path in (root / package).rglob("*.py") if path.name not in ("__init__.py", "setup.py")]
    modules = {".".join(path.relative_to(root).with_suffix("").parts): path for path in paths}
    found: dict[str, set[str]] = {}
    for module, path in modules.items():
        names = imported_names(path)
        candidates = {name if name in modules else name.rpartition(".")[0] for name in names}
        found[module] = (candidates & modules.keys()) - {module}
    return found


def package_imports(root: Path) -> dict[str, set[str]]:
    """Return for each package the other packages that its modules import."""
    known = set(packages(root))
    return {
        package: {
            name.partition(".")[0]
            for path in (root / package).rglob("*.py")
            if path.name != "setup.py"
            for name in imported_names(path)
        }
        & (known - {package})
        for package in known
    }


def circles(graph: Mapping[str, Iterable[str]]) -> list[list[str]]:
    """Return the groups of nodes of a graph that reach each other (Tarjan's strongly connected components)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in graph[node]:
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            at = stack.index(node)
            if len(stack) - at > 1:
                found.append(sorted(stack[at:]))
            del stack[at:]

    for node in graph:
        if node not in index:
            visit(node)
    return found


def longest_chain(graph: Mapping[str, Iterable[str]]) -> tuple[str, ...]:
    """Return the longest chain of a graph; an import that closes a circle is not followed."""
    known: dict[str, tuple[str, ...]] = {}

    def chain(node: str, above: frozenset[str]) -> tuple[str, ...]:
        if node not in known:
            below = (chain(other, above | {node}) for other in sorted(graph[node]) if other not in above | {node})
            known[node] = (node, *max(below, key=len, default=()))
        return known[node]

    return max((chain(node, frozenset()) for node in sorted(graph)), key=len, default=())


def exported(package: Path) -> int:
    """Return how many names the `__init__.py` of a package exports, as `import Name as Name`."""
    tree = ast.parse((package / "__init__.py").read_text(encoding="utf-8"))
    aliases = [alias for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names]
    return sum(alias.asname == alias.name for alias in aliases)


def structure(root: Path) -> dict[str, Row]:
    """Return the rows of the table for a checkout.

    Args:
        root: Its folder; every file below the package folders and tools/ counts.
    """
    rows: dict[str, Row] = {}
    web: list[Path] = []
    names = packages(root)
    for name in (*names, "tools"):
        files = [
            path for path in sorted((root / name).rglob("*")) if path.is_file() and "__pycache__" not in path.parts
        ]
        files = [path for path in files if not is_vendored(path.relative_to(root))]
        web += [path for path in files if path.suffix in WEB]
        code = [path for path in files if path.suffix in (".py", ".sh")]
        is_package = name != "tools"
        rows[name] = Row(
            lines=sum(map(code_lines, code)),
            files=len(code),
            chain=longest_chain(module_imports(root, name)) if is_package else None,
            exported=exported(root / name) if is_package else None,
        )
    rows["openarm_* (sum)"] = Row(sum(rows[n].lines for n in names), sum(rows[n].files for n in names))
    rows["web"] = Row(sum(map(code_lines, web)), len(web))
    return rows


def table(rows: Mapping[str, Row], before: Mapping[str, Row] | None = None) -> str:
    """Return the rows as a Markdown table, each figure after the one of another revision if that is given."""

    def cell(name: str, pick: str) -> str:
        values = [str(figure(rows, name, pick))]
        if before is not None:
            values.insert(0, str(figure(before, name, pick)))
        return " → ".join(values) if set(values) != {""} else ""

    def figure(of: Mapping[str, Row], name: str, pick: str) -> object:
        value = getattr(of[name], pick) if name in of else "–"
        return "" if value is None else len(value) if isinstance(value, tuple) else value

    names = [*(name for name in (before or {}) if name not in rows), *rows]
    lines = ["| folder | code lines | files | longest import chain | names exported |", "|---|---|---|---|---|"]
    for name in names:
        lines.append(
            f"| {name} | " + " | ".join(cell(name, pick) for pick in ("lines", "files", "chain", "exported")) + " |"
        )
    return "\n".join(lines)


def _revision(root: Path, revision: str, folder: Path) -> Path:
    """Write a revision of a checkout into a folder."""
    archive = subprocess.run(["git", "-C", str(root), "archive", revision], check=True, stdout=subprocess.PIPE).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        tar.extractall(folder, filter="data")
    return folder


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--root", type=Path, default=ROOT, help="a checkout")
    parser.add_argument("--against", metavar="REV", help="a revision of git to print next to it")
    parser.add_argument("--chains", action="store_true", help="print the modules of each longest chain")
    options = parser.parse_args()
    rows = structure(options.root)
    before = None
    if options.against:
        with tempfile.TemporaryDirectory() as folder:
            before = structure(_revision(options.root, options.against, Path(folder)))
    print(table(rows, before))
    if options.chains:
        for name, row in rows.items():
            if row.chain:
                print(f"\n{name}: " + " → ".join(module.partition(".")[2] for module in row.chain))
    for name in packages(options.root):
        for circle in circles(module_imports(options.root, name)):
            print(f"\ncircle of imports: {', '.join(circle)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
