"""Packages import those above them in the design's list, rooms of a package likewise, and each by its face alone.

Studies import cfplan, and are imported by nothing but tests.
"""

import ast
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path

import pytest
from sources import FILES, PACKAGE, STUDIES, STUDY_FILES, nodes, tree

LAYERS = [
    "files", "geometry", "vehicle", "safety", "planners", "learning", "planning", "flight", "simulation",
    "preparation", "air", "recording", "identification", "steering", "cli",
]  # fmt: skip
# Modules and rooms of a package, in order: each may import those before it. Modules not named stand together.
MODULES = "its other modules"
ROOMS = {
    "planners": [MODULES, "solver", "expert", "baselines"],
    "flight": [MODULES, "setpoints", "on_board", "radio", "mocap", "pilot", "fleet"],
    "simulation": ["timed_fault", "engine", "virtual_crazyflie", "virtual_vicon", "lab", MODULES],
    "recording": ["plausible", "importers", MODULES, "rerun", "report", "mavlink"],
}

TESTS = {"tests", *(file.stem for file in Path(__file__).parent.glob("*.py"))}  # as tests import them


@cache
def names(file: Path) -> list[tuple[str, ...]]:
    """What a file imports, anywhere in it: the parts of each name."""
    found = []
    for node in nodes(file):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative imports hide what is imported"
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return [tuple(name.split(".")) for name in found]


@cache
def imports(file: Path) -> list[tuple[str, ...]]:
    """What a file imports of cfplan: the parts of each module's name, without the first."""
    found = []
    for first, *parts in names(file):
        if first == "cfplan":
            while parts and not (
                PACKAGE.joinpath(*parts).is_dir() or PACKAGE.joinpath(*parts).with_suffix(".py").exists()
            ):
                parts.pop()
            found.append(tuple(parts))
    return found


def room_of(parts: tuple[str, ...]) -> tuple[str, ...]:
    """The innermost package in which a module lies."""
    return parts if PACKAGE.joinpath(*parts).is_dir() else parts[:-1]


@cache
def face(room: tuple[str, ...]) -> set[str]:
    """What a room's __init__.py says that others may import."""
    for node in tree(PACKAGE.joinpath(*room, "__init__.py")).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            return set(ast.literal_eval(node.value))
    return set()


def place(package: str, member: str) -> int:
    order = ROOMS[package]
    return order.index(member if member in order else MODULES)


@pytest.mark.parametrize("layer", LAYERS)
def test_a_package_imports_only_those_above_it(layer):
    allowed = set(LAYERS[: LAYERS.index(layer) + 1])
    for file in (PACKAGE / layer).rglob("*.py"):
        layers = {parts[0] for parts in imports(file) if parts and parts[0] in LAYERS}
        assert layers <= allowed, f"{file} reaches downwards"


@pytest.mark.parametrize("package", ROOMS)
def test_a_room_imports_only_those_above_it(package):
    for file in (PACKAGE / package).rglob("*.py"):
        inside = file.relative_to(PACKAGE / package).with_suffix("").parts
        if inside == ("__init__",):
            continue
        for parts in imports(file):
            if len(parts) > 1 and parts[0] == package and parts[1] != inside[0]:
                assert place(package, parts[1]) <= place(package, inside[0]), f"{file} reaches down to {parts[1]}"


@pytest.mark.parametrize("file", FILES + STUDY_FILES, ids=lambda file: str(file.relative_to(PACKAGE.parent)))
def test_a_file_imports_other_rooms_by_their_face(file):
    own = file.relative_to(PACKAGE).parent.parts if file in FILES else ("studies",)
    for parts in imports(file):
        for depth in range(1, len(parts)):
            room, name = parts[:depth], parts[depth]
            if own[:depth] != room:
                assert name in face(room), f"{file} imports {'.'.join(parts)}, which {'.'.join(room)} does not offer"


def test_cfplan_imports_neither_studies_nor_tests():
    for file in FILES:
        assert not {name[0] for name in names(file)} & {"studies", *TESTS}, f"{file} needs a checkout"


def defined(files: Iterable[Path]) -> set[str]:
    """Return the names that files define or assign, attributes of self included."""
    found = set()
    for node in (each for file in files for each in nodes(file)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and ast.unparse(node.value) == "self":
            found.add(node.attr)
    return found


def patched(call: ast.Call) -> list[str]:
    """Return the name that a call patches, if it does."""
    if not ast.unparse(call.func).endswith(("setattr", "patch", "patch.object")):
        return []
    return [each.value.split(".")[-1] for each in call.args if isinstance(getattr(each, "value", None), str)]


def used(program: ast.AST) -> Iterator[str]:
    """Yield the attributes, imports and patched names of a program, and of programs that it has as strings."""
    for node in ast.walk(program):
        if isinstance(node, ast.Attribute):
            yield node.attr
        elif isinstance(node, ast.ImportFrom):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.Call):
            yield from patched(node)
        elif isinstance(node, ast.Constant) and "import " in str(node.value):
            with suppress(SyntaxError):
                yield from used(ast.parse(node.value))


def test_tests_use_no_private_names_and_patch_no_constants():
    """Promises are held through what modules offer, so that all that is behind may change."""
    ours = defined(FILES + STUDY_FILES)
    private = {name for name in ours if name.startswith("_") and not name.endswith("__")}
    constants = {name for name in ours if name.isupper()}
    for file in Path(__file__).parent.rglob("*.py"):
        assert not {*used(tree(file))} & (private - defined([file])), f"{file} uses private names"
        calls = [node for node in nodes(file) if isinstance(node, ast.Call)]
        assert not {name for call in calls for name in patched(call)} & constants, f"{file} patches constants"


def test_studies_import_no_tests_and_their_runner_imports_no_study():
    for file in STUDY_FILES:
        assert not {name[0] for name in names(file)} & TESTS, f"{file} imports tests"
    for file in (STUDIES / "runner").glob("*.py"):
        found = {name[1] for name in names(file) if name[0] == "studies"}
        assert found <= {"COMMANDS", "STUDIES", "runner"}, f"{file} imports a study"


def test_every_face_names_what_there_is():
    for init in PACKAGE.rglob("__init__.py"):
        if init.parent == PACKAGE:
            continue
        for name in face(init.parent.relative_to(PACKAGE).parts):
            assert (init.parent / name).is_dir() or (init.parent / f"{name}.py").exists() or name in init.read_text()


def test_every_package_is_in_the_list():
    assert {p.name for p in PACKAGE.iterdir() if p.is_dir() and p.name != "__pycache__"} == set(LAYERS)


def test_shared_modules_import_no_layer():
    for file in set(PACKAGE.glob("*.py")) - {
        PACKAGE / "__main__.py",  # which runs the command line
        PACKAGE / "__init__.py",  # which names what programs use
    }:
        layers = {parts[0] for parts in imports(file) if parts and parts[0] in LAYERS}
        assert layers == set(), f"{file} belongs to a layer"


def test_no_module_imports_itself_by_way_of_others():
    graph = {file.relative_to(PACKAGE).with_suffix("").parts: {*imports(file)} for file in FILES}
    done: set[tuple[str, ...]] = set()

    def visit(module: tuple[str, ...], way: list[tuple[str, ...]]) -> None:
        assert module not in way, " → ".join(".".join(parts) for parts in [*way[way.index(module) :], module])
        if module in done:
            return
        for other in graph.get(module, graph.get((*module, "__init__"), set())):
            visit(other, [*way, module])
        done.add(module)

    for module in graph:
        visit(module, [])


def test_a_public_class_name_occurs_once():
    places: dict[str, list[str]] = {}
    for file in FILES:
        for node in nodes(file):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(f"{file.relative_to(PACKAGE)}:{node.lineno}")
    assert {name: found for name, found in places.items() if len(found) > 1} == {}


MOST_PARAMETERS, MOST_LINES = 6, 60
AS_THEY_ARE_CALLED = ("njit", "jitable", "click")  # compiled functions take arrays one by one, commands their options


def functions():
    """Yield (place, function) of cfplan and studies."""
    for file in [*FILES, *STUDY_FILES]:
        for node in nodes(file):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                yield f"{file}:{node.lineno} {node.name}", node


def test_no_function_has_more_than_sixty_lines():
    assert not [place for place, node in functions() if node.end_lineno - node.lineno >= MOST_LINES]


def test_no_function_has_more_than_six_positional_parameters():
    long = {}
    for place, node in functions():
        taken = [each.arg for each in (*node.args.posonlyargs, *node.args.args) if each.arg not in ("self", "cls")]
        decorators = " ".join(map(ast.unparse, node.decorator_list))
        if len(taken) > MOST_PARAMETERS and not any(word in decorators for word in AS_THEY_ARE_CALLED):
            long[place] = taken
    long = {place: taken for place, taken in long.items() if "_context" not in taken}  # called by numba itself
    assert not long
