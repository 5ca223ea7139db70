"""The sources that a study's figures depend on, and their digest: a result of other sources is out of date.

The sources are the study's module, all modules of cfplan and studies that it imports, directly or not, and the shipped
models and limits. Comments, docstrings, layout, imports for type checkers alone, and a package's `__init__.py`, which
only lists what the package offers, do not count; nor does this module.
"""

import ast
import copy
import hashlib
from functools import cache
from pathlib import Path

from cfplan.version import REPOSITORY

DATA = ("models", "safety.yaml")
PACKAGES = ("cfplan", "studies")


@cache
def sources_digest(module: str) -> str:
    """Return the digest of everything that a study's figures depend on; `module` is a name such as studies.flights."""
    digest = hashlib.sha256()
    for file in sorted(each for each in _closure(module) if each.name != "__init__.py" and each != Path(__file__)):
        digest.update(f"{file.relative_to(REPOSITORY)}\n{_code_digest(file)}\n".encode())
    for top in DATA:
        found = [REPOSITORY / top] if (REPOSITORY / top).is_file() else sorted((REPOSITORY / top).rglob("*"))
        for file in found:
            if file.is_file():
                digest.update(f"{file.relative_to(REPOSITORY)}\n".encode() + file.read_bytes())
    return digest.hexdigest()


def _closure(module: str) -> set[Path]:
    first = _file_of(module)
    waiting, found = [first] if first else [], set[Path]()
    while waiting:
        file = waiting.pop()
        if file not in found:
            found.add(file)
            waiting += _imported(file)
    return found


@cache
def _imported(file: Path) -> list[Path]:
    names: set[str] = set()
    for node in ast.walk(_tree(file)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.update((node.module, *(f"{node.module}.{alias.name}" for alias in node.names)))
    files = (_file_of(name) for name in names if name.partition(".")[0] in PACKAGES)
    return [each for each in files if each is not None]


def _file_of(module: str) -> Path | None:
    """Return the file of a module, or None if the name is an attribute of a module."""
    path = REPOSITORY.joinpath(*module.split("."))
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


@cache
def _tree(file: Path) -> ast.Module:
    return _WithoutTypeChecking().visit(ast.parse(file.read_text(encoding="utf-8")))


class _WithoutTypeChecking(ast.NodeTransformer):
    """Removes `if TYPE_CHECKING:` with its body, which never runs."""

    def visit_If(self, node: ast.If) -> ast.AST | None:
        return None if ast.unparse(node.test) == "TYPE_CHECKING" else self.generic_visit(node)


@cache
def _code_digest(file: Path) -> str:
    tree = copy.deepcopy(_tree(file))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [each for each in body if not _is_documentation(each)]  # type: ignore[attr-defined]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def _is_documentation(node: ast.AST) -> bool:
    """Return whether a statement is a string, or the list `__all__`."""
    if isinstance(node, ast.Assign):
        return [ast.unparse(target) for target in node.targets] == ["__all__"]
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
