"""`cfplan replay`: look at flights in rerun."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cfplan.cli import options
from cfplan.cli.output import Steps, print_json
from cfplan.errors import InputError

if TYPE_CHECKING:
    from cfplan.recording.importers.mocap_log import LoggedSubject
    from cfplan.recording.overlay import Reference, Trial

EPILOG = """\b
Examples:
  cfplan replay records                                              list the flights
  cfplan replay records/20261122-094221-figure8                      look at one
  cfplan replay records/20261122-094221-figure8 --save flight.rrd    for later: rerun flight.rrd
  cfplan replay records/20261122-094221-figure8 --gif flight.gif     for a page or a talk
  cfplan replay records/20261122-094221-figure8 records/20261122-101500-figure8
  cfplan replay vicon.csv --subject cf1 --plan records/20261122-094221-figure8
  cfplan replay vicon.csv --subject cf1 --plan flights/figure8.yaml"""

_OF_A_VIEW = "plan_file", "safety_file", "names", "angles", "save", "png", "figure", "gif", "moment", "force"


@click.command(short_help="Look at flights and logs in rerun.", epilog=EPILOG)
@click.argument("flights", metavar="FLIGHT...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--plan",
    "plan_file",
    type=click.Path(path_type=Path),
    help="Plan to compare the flights with: of a record, a plan file, or a path file, planned as by `cfplan fly`.",
)
@click.option(
    "--safety",
    "safety_file",
    type=click.Path(path_type=Path),
    help="Limits for --plan.  [default: as for `cfplan fly`]",
)
@click.option("--subject", "names", multiple=True, help="Subject of a mocap log to show; repeatable.  [default: all]")
@click.option(
    "--angles",
    type=click.Choice(["helical", "euler"]),
    help="Kind of the three angles in a Vicon CSV, if its header does not say.",
)
@click.option("--save", type=click.Path(path_type=Path), help="Rerun file to write instead of opening the viewer.")
@click.option("--png", type=click.Path(path_type=Path), help="Picture of the view to write; needs no screen.")
@click.option("--figure", type=click.Path(path_type=Path), help="Figure of a record to write: .png, .pdf or .svg.")
@click.option("--gif", type=click.Path(path_type=Path), help="GIF to write: a record's flight along its path.")
@click.option(
    "--at",
    "moment",
    type=float,
    help="Time of the picture, s.  [default: the middle of the path; of a fleet, where two are nearest]",
)
@click.option("--force", is_flag=True, help="Overwrite the file.")
@options.as_json
def replay(
    flights: tuple[Path, ...],
    plan_file: Path | None,
    safety_file: Path | None,
    names: tuple[str, ...],
    angles: str | None,
    save: Path | None,
    png: Path | None,
    figure: Path | None,
    gif: Path | None,
    moment: float | None,
    force: bool,
    as_json: bool,
) -> None:
    """Replay a FLIGHT in rerun, or several as trials in one view.

    Each is a record (its folder, or its flight.mcap) or a log of motion capture: Vicon CSV, a Crazyflie's microSD log,
    CSV of t, x, y, z, a ROS bag, or a MAVLink .tlog. The folder of a fleet's flight shows all its vehicles. The flights
    in a folder of records are listed.
    """
    from cfplan.cli.flights_list import flights_in, print_flights
    from cfplan.recording.fleet_record import is_fleet_record
    from cfplan.recording.reader import is_record

    one = len(flights) == 1 and plan_file is None
    one_fleet, one_record = one and is_fleet_record(flights[0]), one and is_record(flights[0])
    if not one_fleet and len(flights) == 1 and (records := flights_in(flights[0])):
        options.refuse(_OF_A_VIEW, "a folder of records is only listed", "name one of its flights")
        return print_flights(records, as_json=as_json)
    steps, files = Steps(as_json=as_json), Files(save, png, figure, gif, moment, force)
    files.check(one_record=one_record)
    _refuse_unused(flights, plan_file)
    if one_fleet:
        document = _replay_fleet(flights[0], files, steps)
    elif one_record:
        document = _replay_record(flights[0], files, steps)
    else:
        document = _replay_trials(flights, _reference(plan_file, safety_file, steps), names, angles, files, steps)
    if as_json:
        print_json(document | files.to_json())


def _refuse_unused(flights: tuple[Path, ...], plan_file: Path | None) -> None:
    """Raise InputError for limits without a path to plan, or for options of logs with records alone."""
    from cfplan.recording.fleet_record import is_fleet_record
    from cfplan.recording.reader import is_record

    if plan_file is None:
        options.refuse(("safety_file",), "limits are needed only for the path of --plan", "leave it out")
    if all(is_record(each) or is_fleet_record(each) for each in flights):
        options.refuse(("names", "angles"), "this is for logs of motion capture, not for records", "leave it out")


@dataclass(frozen=True, slots=True)
class Files:
    """The files to write; without any, the viewer opens."""

    save: Path | None
    png: Path | None
    figure: Path | None  # of one record
    gif: Path | None  # likewise
    moment: float | None  # s on the timeline, of the picture
    force: bool

    def check(self, *, one_record: bool) -> None:
        """Raise InputError if the options do not go together, or a figure could not be written."""
        if self.moment is not None and (self.png is None or not abs(self.moment) < 1e6):
            raise InputError("--at says when a picture is taken, in s", hint="add --png flight.png")
        from cfplan.files.atomic import check_new_file

        for file, suffix in ((self.save, ".rrd"), (self.png, ".png")):
            if file is not None:
                check_new_file(file, suffix, overwrite=self.force)
        if self.figure is not None:
            from cfplan.planning.figure import check_figure_file

            check_figure_file(self.figure, overwrite=self.force)
        if self.gif is not None:
            from cfplan.recording.animation import check_animation_file

            check_animation_file(self.gif, overwrite=self.force)
        if (drawn := self.figure or self.gif) and not one_record:
            raise InputError("a figure is of one record", where=str(drawn), hint="name one record, without --plan")

    def to_json(self) -> dict[str, str | None]:
        """Return the names of the files; None for those not requested."""
        files = {"rrd": self.save, "png": self.png, "figure": self.figure, "gif": self.gif}
        return {kind: str(file) if file else None for kind, file in files.items()}

    def make(
        self, steps: Steps, write: "Callable[..., None]", picture: "Callable[..., tuple[str, ...]]", show: Callable
    ) -> None:
        """Write the files, or show the flight in the viewer."""
        if self.save is not None:
            with steps.step("rerun file") as results:
                write(self.save, overwrite=self.force)
                results.append(f"{self.save} ({_size(self.save)}); open it with: rerun {self.save}")
        if self.png is not None:
            with steps.step("picture") as results:
                complaints = picture(self.png, moment=self.moment, overwrite=self.force)
                results.append(f"{self.png} ({_size(self.png)})")
                results.extend(complaints)
        if self.save is None and self.png is None and self.figure is None and self.gif is None:
            with steps.step("viewer"):
                show()


def _size(file: Path) -> str:
    return f"{file.stat().st_size / 1e6:.1f} MB"


def _replay_record(place: Path, files: Files, steps: Steps) -> dict[str, Any]:
    from cfplan.recording.reader import read_record
    from cfplan.recording.rerun.record_view import picture, show, write_rrd
    from cfplan.recording.summary import summarise

    with steps.step("read") as results:
        flight = read_record(place)
        results.append(f"{flight.header.name}, {flight.duration:.1f} s, {len(flight.setpoints.time)} setpoints")
        if flight.truncated:
            results.append("truncated: data after the last complete chunk is lost")
    if files.figure is not None:
        from cfplan.planning.figure import save_figure
        from cfplan.recording.flight_figure import draw_flight

        with steps.step("figure") as results:
            save_figure(draw_flight(flight), files.figure, overwrite=files.force)
            results.append(str(files.figure))
    if files.gif is not None:
        from cfplan.recording.animation import animate_flight, save_animation

        with steps.step("animation") as results:
            save_animation(animate_flight(flight), files.gif, overwrite=files.force)
            results.append(f"{files.gif} ({_size(files.gif)})")
    files.make(steps, partial(write_rrd, flight), partial(picture, flight), partial(show, flight))
    return {"record": str(place), **(summarise(flight).to_json() if steps.as_json else {})}


def _replay_fleet(folder: Path, files: Files, steps: Steps) -> dict[str, Any]:
    from cfplan.cli.recorded_fleet import read_fleet
    from cfplan.recording.rerun.fleet_view import picture_fleet, show_fleet, write_fleet

    fleet = read_fleet(folder, steps)
    files.make(steps, partial(write_fleet, fleet), partial(picture_fleet, fleet), partial(show_fleet, fleet))
    return {"record": str(folder), **fleet.to_json()}


def _reference(plan_file: Path | None, safety_file: Path | None, steps: Steps) -> "Reference | None":
    if plan_file is None:
        return None
    from cfplan.cli.reference_plan import reference_plan

    return reference_plan(plan_file, safety_file, steps)


def _replay_trials(
    flights: tuple[Path, ...],
    reference: "Reference | None",
    names: tuple[str, ...],
    angles: str | None,
    files: Files,
    steps: Steps,
) -> dict[str, Any]:
    from cfplan.recording.rerun.overlay_view import picture_overlay, show_overlay, write_overlay

    trials: list[Trial] = []
    descriptions: list[dict[str, Any]] = []
    for place in flights:
        for trial, description in _trials(place, reference, names, angles, steps):
            trials.append(trial)
            descriptions.append({"file": str(place), "name": trial.name, **description})
    files.make(steps, partial(write_overlay, trials), partial(picture_overlay, trials), partial(show_overlay, trials))
    return {"trials": descriptions}


def _trials(
    place: Path, reference: "Reference | None", names: tuple[str, ...], angles: str | None, steps: Steps
) -> "list[tuple[Trial, dict[str, Any]]]":
    """Return the trials of one file with a description each, aligned with the reference if there is one."""
    from cfplan.recording.overlay import subject_of_record, trial_of_record, trial_of_subject
    from cfplan.recording.reader import is_record, read_record

    if is_record(place):
        with steps.step("read") as results:
            record = read_record(place)
            name = place.resolve().name if place.is_dir() else place.resolve().parent.name
            results.append(f"{name}, {record.duration:.1f} s, {len(record.poses.time)} poses")
        if reference is None:
            return [(trial_of_record(record, name), {"format": "cfplan record", "truncated": record.truncated})]
        about = {"format": "cfplan record", "truncated": record.truncated}
        return [_laid(subject_of_record(record, name), reference, about, steps)]

    subjects, about = _read_log(place, names, angles, steps)
    if reference is None:
        return [(trial_of_subject(subject), {**about, "duration": subject.duration}) for subject in subjects]
    return [_laid(subject, reference, about, steps) for subject in subjects]


def _read_log(
    place: Path, names: tuple[str, ...], angles: str | None, steps: Steps
) -> "tuple[tuple[LoggedSubject, ...], dict[str, Any]]":
    from cfplan.recording.importers.formats import read_log
    from cfplan.recording.importers.vicon_header import Rotations

    with steps.step("read") as results:
        log = read_log(place, rotations=Rotations(angles) if angles else None)
        subjects = log.select(names, where=str(place))
        results.append(f"{log.format}: {', '.join(subject.name for subject in subjects)}")
        results.extend(
            f"{subject.name} unseen in {100 * (1 - subject.seen.mean()):.1f} % of {subject.duration:.1f} s"
            for subject in subjects
            if not subject.seen.all()
        )
        results.extend(log.notes)
    return subjects, {"format": log.format, "truncated": log.truncated, "notes": list(log.notes)}


def _laid(
    subject: "LoggedSubject", reference: "Reference", about: dict[str, Any], steps: Steps
) -> "tuple[Trial, dict[str, Any]]":
    from dataclasses import asdict

    from cfplan.recording.overlay import align, trial_of_subject

    with steps.step("align") as results:
        found = align(subject, reference)
        results.append(f"{subject.name}: {found}")
        if not found.alike:
            results.append(f"it does not look like a flight of {reference.name}")
    return trial_of_subject(subject, reference, found.offset), {**about, "alignment": asdict(found)}
