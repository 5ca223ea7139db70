"""What comes with cfplan beside its code: the models, the examples of flights/ and their safety.yaml."""

from functools import cache
from importlib import metadata
from pathlib import Path

from cfplan.errors import InputError

_CHECKOUT = Path(__file__).parents[2]


@cache
def shipped_folder() -> Path:
    """Return the folder that holds models/, flights/ and safety.yaml: a checkout, or where pip put them."""
    if (_CHECKOUT / "pyproject.toml").is_file():
        return _CHECKOUT
    for file in metadata.files("cfplan") or ():
        if file.parts[-2:] == ("cfplan", "safety.yaml"):
            return Path(str(file.locate())).resolve().parent
    raise InputError(
        "its models and examples are missing", where="this installation of cfplan", hint="install it again with pip"
    )


def example_limits() -> Path:
    """Return the safety.yaml of the examples."""
    return shipped_folder() / "safety.yaml"


def example(name: str) -> Path:
    """Return the path file of an example, as `figure8`.

    Raises:
        InputError: there is no such example; the hint lists them.
    """
    found = {file.stem: file for file in (shipped_folder() / "flights").glob("*.yaml")}
    if name not in found:
        raise InputError("no such example", where=name, hint=f"there are {', '.join(sorted(found))}")
    return found[name]
