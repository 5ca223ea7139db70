"""DatasetSpec: everything that determines the rows of a dataset, kept beside them as dataset.json.

A path's perturbed copies with the clean path's label are the paper's noise injection.
"""

import json
from dataclasses import asdict, dataclass, fields
from enum import StrEnum
from pathlib import Path

from cfplan import __version__
from cfplan.errors import InputError
from cfplan.files.atomic import atomic_write
from cfplan.geometry.path_families import USUAL, Family
from cfplan.geometry.path_file import PathShape
from cfplan.geometry.yaw import YawMode
from cfplan.safety.limit_sets import DATA_SETS, LimitSet
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import Airframe

SPEC_FILE = "dataset.json"
DRAWN, GIVEN = "drawn", "given"  # limits that are not a named set
_MAX_COUNT = 10_000_000  # paths, copies of one, rows of a shard
_MAX_WAYPOINTS, _MAX_NODES = 1000, 100_000
_SINCE = {"planner", "shape"}  # keys that datasets of older versions lack
_REMEDY = "give another folder, or make the dataset again"


class Relabel(StrEnum):
    """The label of a perturbed copy of a path."""

    SOLVE = "solve"  # its own solution
    KEEP = "keep"  # the clean path's label, as the paper's noise injection has it


class Labeller(StrEnum):
    """The planner whose solution is a path's label."""

    EXPERT = "expert"
    TOPPQUAD = "toppquad"  # the paper's


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetSpec:
    """The specification of a dataset: equal specs give equal rows, with any number of workers."""

    count: int  # clean paths
    seed: int
    limits: str = DRAWN
    """A limit set by name; `drawn`: limits and vehicle are drawn for each path; `given`: `airframe` and `plan`."""
    airframe: Airframe | None = None
    plan: PlanLimits | None = None
    families: tuple[Family, ...] = USUAL  # of the paths, in turn; empty with boxes
    boxes: tuple[tuple[float, float, float], ...] = ()
    """Sides, m, of where waypoints are drawn; paths take the boxes in turn, instead of families."""
    waypoints: tuple[int, int] = (3, 6)  # least and most
    shape: PathShape | None = PathShape.MIN_SNAP  # of the paths through waypoints; None: drawn for each path
    nodes: int = 100  # grid intervals
    yaw: YawMode | None = None  # None: drawn for each path
    epsilon: float = 0.0  # m, perturbation of the copies at each node
    copies: int = 0  # perturbed, of each path
    relabel: Relabel = Relabel.SOLVE
    planner: Labeller = Labeller.EXPERT
    shard_rows: int = 100
    version: str = __version__

    def __post_init__(self) -> None:
        low, high = self.waypoints
        wrong = [
            ("count", not 1 <= self.count <= _MAX_COUNT, f"from 1 to {_MAX_COUNT}"),
            ("seed", self.seed < 0, "at least 0"),
            ("limits", self.limits not in (*DATA_SETS, DRAWN, GIVEN), f"one of {', '.join((*DATA_SETS, DRAWN))}"),
            (
                "plan",
                (self.limits == GIVEN) != (None not in (self.plan, self.airframe)),
                "set exactly with given limits",
            ),
            ("boxes", not all(_is_box(box) for box in self.boxes), "of three lengths in m each"),
            ("families", bool(self.families) == bool(self.boxes), "empty exactly if boxes are set"),
            ("waypoints", not 2 <= low <= high <= _MAX_WAYPOINTS, f"2 to {_MAX_WAYPOINTS}, least first"),
            ("nodes", not 4 <= self.nodes <= _MAX_NODES, f"from 4 to {_MAX_NODES}"),
            ("copies", not 0 <= self.copies <= _MAX_COUNT, f"from 0 to {_MAX_COUNT}"),
            ("epsilon", not 0 <= self.epsilon < float("inf"), "at least 0"),
            ("epsilon", (self.epsilon > 0) != (self.copies > 0), "given together with copies"),
            ("shard_rows", not 1 <= self.shard_rows <= _MAX_COUNT, f"from 1 to {_MAX_COUNT}"),
        ]
        for name, is_wrong, allowed in wrong:
            if is_wrong:
                raise InputError(
                    f"{name} is {getattr(self, name)}; it must be {allowed}",
                    where="dataset",
                    hint="see `cfplan dataset make --help`",
                )

    @property
    def limit_set(self) -> LimitSet | None:
        """Return the vehicle and the limits of all rows; None where they are drawn."""
        if self.airframe is not None and self.plan is not None:
            return LimitSet(GIVEN, self.airframe, self.plan)
        return DATA_SETS.get(self.limits)

    @property
    def rows(self) -> int:
        """Return the number of rows: clean paths and their copies."""
        return self.count * (1 + self.copies)

    @property
    def shards(self) -> int:
        """Return the number of files that the rows fill."""
        return -(-self.rows // self.shard_rows)

    def shard(self, number: int) -> range:
        """Return the rows of one file."""
        return range(number * self.shard_rows, min(self.rows, (number + 1) * self.shard_rows))

    def save(self, folder: Path) -> None:
        """Write dataset.json atomically."""
        with atomic_write(folder / SPEC_FILE) as unfinished:
            unfinished.write_text(json.dumps(asdict(self), indent=2) + "\n")


def _is_box(sides: tuple[float, ...]) -> bool:
    return len(sides) == 3 and all(0 < side < float("inf") for side in sides)


def load_spec(folder: Path) -> DatasetSpec:
    """Read the spec of a dataset folder. Raises InputError where there is none or it cannot be read."""
    from pydantic import TypeAdapter  # slow to import

    file = folder / SPEC_FILE
    if not file.is_file():
        raise InputError(
            f"no {SPEC_FILE} there", where=str(folder), hint="make a dataset with `cfplan dataset make DIR`"
        )
    try:
        text = file.read_text(encoding="utf-8")
        content = json.loads(text)
        known = {field.name for field in fields(DatasetSpec)}
        if not isinstance(content, dict) or not known - _SINCE <= set(content) <= known:
            raise ValueError(f"its keys are not those of cfplan {__version__}")
        return TypeAdapter(DatasetSpec).validate_json(text, strict=True)
    except InputError as error:
        raise InputError(error.what, where=str(file), hint=_REMEDY) from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(file), hint="check its permissions") from None
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(
            f"not a dataset description: {' '.join(str(error).split())[:200]}", where=str(file), hint=_REMEDY
        ) from None


def require_same(existing: DatasetSpec, wanted: DatasetSpec, folder: Path) -> None:
    """Refuse to mix rows of two specs in one folder, naming the differences.

    Raises:
        InputError: the specs differ.
    """
    different = [
        f"{field.name} {getattr(existing, field.name)} there, {getattr(wanted, field.name)} here"
        for field in fields(DatasetSpec)
        if getattr(existing, field.name) != getattr(wanted, field.name)
    ]
    if different:
        raise InputError(
            f"holds another dataset: {'; '.join(different)}", where=str(folder), hint="give another folder"
        )
