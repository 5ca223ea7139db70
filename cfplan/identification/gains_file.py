"""Read the gains that a controller flew with, from a YAML file of `name: value` lines."""

from dataclasses import fields, replace
from pathlib import Path

from cfplan.errors import InputError
from cfplan.files.yaml_with_places import read_plain
from cfplan.flight.firmware import MellingerGains
from cfplan.identification.replay import Controller
from cfplan.simulation.engine.lee import LEE_GAINS, LeeGains

_MELLINGER_GAINS = tuple(each.name for each in fields(MellingerGains))


def read_gains(file: Path) -> Controller:
    """Return the controller of the gains in a file: Lee's by the names of ctrlLee, Mellinger's by those of `firmware`.

    Gains left out have the firmware's defaults; other keys, such as notes of an experiment, are ignored. Raises
    InputError if the file names no gain, or if a value is not a number.
    """
    values = read_plain(file)
    by_lee = {name: values[name] for name in LEE_GAINS if name in values}
    by_mellinger = {name: values[name] for name in _MELLINGER_GAINS if name in values}
    named = by_lee if len(by_lee) > len(by_mellinger) else by_mellinger
    if not set(named) - {"mass"}:
        raise InputError(
            "it names no gains",
            where=str(file),
            hint="write one a line, as `KR_x: 0.007` of the Lee or `kR_xy: 70000` of the Mellinger controller",
        )
    for name, value in named.items():
        if isinstance(value, bool) or not isinstance(value, float | int):
            message = f"{name} must be a number, not {value!r}"
            raise InputError(message, where=str(file), hint=f"write it as `{name}: 0.1`")
    gains = {name: float(value) for name, value in named.items()}
    return Controller(replace(LeeGains(), **gains) if named is by_lee else replace(MellingerGains(), **gains))
