"""`cfplan fly`: plan, certify, rehearse, fly, record."""

import math
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cfplan.cli import options
from cfplan.cli.confirm import confirmed
from cfplan.cli.flight_progress import FlightProgress
from cfplan.cli.output import Steps, print_json, print_table
from cfplan.cli.rehearsal import PlannedFlight, PlanOptions, certify_bytes, obtain_plan, rehearse
from cfplan.cli.vehicle import check_uris, look_at_hardware, vehicle
from cfplan.cli.watchers import check_watchers, watchers
from cfplan.errors import CfplanError, ExitCode

if TYPE_CHECKING:
    from cfplan.flight.pilot.outcome import FlightOutcome
    from cfplan.flight.telemetry import Telemetry
    from cfplan.recording.header import RecordHeader

PROMISED_LATENESS = 2e-3  # s, of all setpoints but one in a hundred
_PATH_SAMPLES = 500  # of the drawn path


@click.command(
    short_help="Plan, certify, rehearse, fly and record a path.",
    epilog="""\b
Examples:
  cfplan fly flights/figure8.yaml
  cfplan fly flights/figure8.yaml --speed 0.3
  cfplan fly flights/figure8.yaml --live --mavlink udp:127.0.0.1:14550

Keys in the air: space lands, Esc cuts the motors; Ctrl-C once lands, twice cuts.""",
)
@options.path_or_plan
@options.planning
@click.option("--uri", default="sim://0", show_default=True, help="The vehicle; sim:// is the virtual Crazyflie.")
@click.option(
    "--mocap",
    "mocap_uri",
    help="The vehicle in motion capture, as vicon://192.168.1.2/cf1. sim:// has poses of its own; "
    "vicon://lab/cf1 takes them through a virtual Vicon.",
)
@click.option(
    "--records",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("records"),
    show_default=True,
    help="Folder in which the flight's record gets a folder of its own.",
)
@click.option("--live", is_flag=True, help="Show the flight in rerun while it goes on.")
@click.option(
    "--mavlink",
    help="Tell a ground station of the flight and obey its orders to stop, as udp:127.0.0.1:14550, where it listens.",
)
@click.option("--yes", is_flag=True, help="Do not ask before hardware flies.")
@options.as_json
def fly(
    path_or_plan: Path,
    safety_file: Path | None,
    planner: str,
    nodes: int | None,
    speed_factor: float | None,
    uri: str,
    mocap_uri: str | None,
    records: Path,
    live: bool,
    mavlink: str | None,
    yes: bool,
    as_json: bool,
) -> int:
    """Fly along PATH: plan, certify, rehearse, then take off, stream the flight, land, and keep a record."""
    from cfplan.safety.limits_file import load_limits

    steps = Steps(as_json=as_json)
    check_uris(uri, mocap_uri)
    check_watchers(live=live, mavlink=mavlink)
    look_at_hardware(uri, mocap_uri, load_limits(options.find_safety_file(safety_file, path_or_plan)).pose, steps)
    flight = obtain_plan(path_or_plan, PlanOptions(safety_file, planner, nodes, speed_factor), steps)
    encoded = certify_bytes(flight, steps)
    rehearsed = rehearse(flight, encoded, steps)

    from cfplan.flight.pilot.mission import mission_of
    from cfplan.flight.pilot.process import fly as fly_mission
    from cfplan.flight.setpoints.stop_certificate import certify_stops
    from cfplan.planning.plan_file import save_plan
    from cfplan.recording.reader import read_record
    from cfplan.recording.summary import summarise
    from cfplan.recording.writer import RecordWriter, new_record_folder, write_summary

    with steps.step("stops") as said:
        mission = mission_of(encoded, flight.limits)
        stops = certify_stops(mission.stops, flight.limits, mission.rate)
        stops.require(flight.limits)
        said.append(
            f"a certified way to stop from each of {stops.count} setpoints, {stops.as_planned} within the plan's limits"
        )
    if not confirmed(flight.name, mission, uri, records, yes=yes, speed_factor=speed_factor):
        click.echo("not flown", err=True)
        return int(ExitCode.ENDED_BY_PILOT)
    with vehicle(uri, mocap_uri, flight.limits) as (drivers, pose_source):
        folder = new_record_folder(records, flight.name)
        progress = FlightProgress(duration=mission.duration, steps=steps)
        try:
            save_plan(flight.plan, folder / "plan.parquet", {"name": flight.name, "path file": str(path_or_plan)})
            header = _header(flight, uri, path_or_plan)
            with (
                RecordWriter(folder, header) as writer,
                watchers(header, folder, live=live, mavlink=mavlink) as watching,
                progress,
            ):
                outcome = fly_mission(
                    mission,
                    uri=uri,
                    drivers=drivers,
                    pose_source=pose_source,
                    on_telemetry=_all(writer.write, progress.show, *watching.listeners),
                    more_orders=watching.orders,
                )
        except CfplanError:
            if progress.heard_vehicle:
                steps.say(f"what was recorded: {folder}")
            else:
                shutil.rmtree(folder)  # there was no flight
            raise
    if writer.failure:
        steps.failed("record", writer.failure)
    for failure in watching.failures():
        steps.failed("watching", failure)
    summary = {"uri": uri, "outcome": _outcome_to_dict(outcome), **summarise(read_record(folder)).to_json()}
    write_summary(folder, summary)

    if as_json:
        document = {"record": str(folder), "plan": flight.to_dict(), **summary}
        print_json(document | {"dry_run_max_deviation": rehearsed.deviation})
    else:
        if outcome.checks and outcome.exit_code == ExitCode.PREFLIGHT:
            _print_checks(outcome)
        _print_outcome(flight, outcome, summary, rehearsed.deviation)
        click.echo(f"record: {folder}")
        click.echo(f"replay: cfplan replay {shlex.quote(str(folder))}")
    if outcome.exit_code is not ExitCode.OK:
        click.echo(f"{click.style('error:', fg='red')} {outcome.reason}", err=True)
    return int(outcome.exit_code)


def _all(*listeners: "Callable[[Telemetry], None]") -> "Callable[[Telemetry], None]":
    """Tell each of them."""

    def tell(message: "Telemetry") -> None:
        for listener in listeners:
            listener(message)

    return tell


def _header(flight: PlannedFlight, uri: str, source: Path) -> "RecordHeader":
    import numpy as np

    from cfplan.recording.header import FlightBounds, header_under
    from cfplan.recording.writer import wall_time_at_zero

    plan, limits = flight.plan, flight.limits
    return header_under(
        limits,
        name=flight.name,
        uri=uri,
        planner=plan.planner,
        bounds=FlightBounds(
            speed=limits.flight.speed.brake,
            acceleration=limits.flight.acceleration.brake,
            body_rate=limits.flight.angular_velocity.brake,
            deviation=limits.flight.deviation.brake,
            lateness=PROMISED_LATENESS,
            pose_age=limits.pose.age_warning,
            battery_voltage=limits.battery.under_load,
        ),
        travel_time=plan.trajectory.duration,
        path=plan.path(np.linspace(0.0, plan.path.end, _PATH_SAMPLES)),
        wall_time_at_zero=wall_time_at_zero(),
        provenance={"path file": str(source), "planner": plan.planner},
    )


def _outcome_to_dict(outcome: "FlightOutcome") -> dict[str, Any]:
    return {
        "exit_code": int(outcome.exit_code),
        "reason": outcome.reason,
        "rung": outcome.rung.name.lower(),
        "flown": outcome.flown,
        "settled_after": outcome.settled_after if math.isfinite(outcome.settled_after) else None,
        "lateness_p99": outcome.lateness.p99,
        "lateness_max": outcome.lateness.max,
        "deviation_max": outcome.deviation.max,
        "deviation_rms": outcome.deviation.rms,
        "setpoints_skipped": outcome.lateness.skipped,
        "telemetry_dropped": outcome.telemetry_dropped,
        "preflight": [
            {"name": check.name, "value": check.value, "threshold": check.threshold, "passed": check.passed}
            for check in outcome.checks
        ],
    }


def _print_checks(outcome: "FlightOutcome") -> None:
    rows = [
        [
            check.name,
            check.value,
            check.threshold,
            "ok" if check.passed else "FAILED",
            "" if check.passed else check.hint,
        ]
        for check in outcome.checks
    ]
    print_table("Preflight", ["check", "value", "must be", "verdict", "hint"], rows)


def _print_outcome(flight: PlannedFlight, outcome: "FlightOutcome", summary: dict[str, Any], rehearsed: float) -> None:
    settled = f"{outcome.settled_after:.2f} s" if math.isfinite(outcome.settled_after) else "–"
    rows = [
        ["ended", outcome.reason],
        ["preflight", f"{sum(check.passed for check in outcome.checks)} of {len(outcome.checks)} checks passed"],
        ["travel time, planned", f"{flight.plan.trajectory.duration:.2f} s"],
        ["travel time, streamed", f"{outcome.flown:.2f} s"],
        ["settled after", settled],
        ["deviation, dry run", f"{100 * rehearsed:.1f} cm max"],
        ["deviation, flown", f"{100 * outcome.deviation.max:.1f} cm max, {100 * outcome.deviation.rms:.1f} cm rms"],
        ["lateness of setpoints", f"{1e3 * outcome.lateness.p99:.2f} ms p99, {1e3 * outcome.lateness.max:.2f} ms max"],
        ["battery", f"{summary['battery_start']} → {summary['battery_end']} V"],
    ]
    print_table("Flight", ["", "value"], rows)
