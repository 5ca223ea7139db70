"""Packages import those above them in the design's list, never those below."""

import ast
from pathlib import Path

import pytest

LAYERS = [
    "geometry", "vehicle", "safety", "expert", "learning", "planning", "flight", "simulation", "recording", "studies",
    "cli",
]  # fmt: skip
PACKAGE = Path(__file__).parent.parent / "cfplan"


def imported_layers(file: Path) -> set[str]:
    """The cfplan packages that a file imports, anywhere in it."""
    names: list[str] = []
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative imports hide what is imported"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    parts = [name.split(".") for name in names if name.startswith("cfplan.")]
    return {part[1] for part in parts if part[1] in LAYERS}


@pytest.mark.parametrize("layer", LAYERS)
def test_a_package_imports_only_those_above_it(layer):
    allowed = set(LAYERS[: LAYERS.index(layer) + 1])
    for file in (PACKAGE / layer).rglob("*.py"):
        assert imported_layers(file) <= allowed, f"{file} reaches downwards"


def test_every_package_is_in_the_list():
    assert {p.name for p in PACKAGE.iterdir() if p.is_dir() and p.name != "__pycache__"} == set(LAYERS)


def test_shared_modules_import_no_layer():
    for file in PACKAGE.glob("*.py"):
        assert imported_layers(file) == set(), f"{file} belongs to a layer"
