"""`cfplan doctor`: check that everything that a flight needs is installed."""

import logging
import platform
import sys
from contextlib import ExitStack
from importlib import metadata
from pathlib import Path

import click

from cfplan.cli import options
from cfplan.cli.output import Steps, print_json, print_table
from cfplan.errors import CfplanError
from cfplan.files.nearest import nearest
from cfplan.files.shipped import example_limits
from cfplan.steering.starting_vehicle import SIMULATED
from cfplan.version import __version__, commit

NEEDED = ("numpy", "scipy", "numba", "casadi", "cflib", "pydantic", "mcap", "pyarrow", "rerun-sdk")
OPTIONAL = {
    "torch": "training, planning needs none: pip install 'cfplan[learn]'",
    "scikit-learn": "the paper's baselines: pip install 'cfplan[studies]'",
    "motioncapture": "motion capture other than Vicon: pip install 'cfplan[mocap]'",
    "rosbags": "ROS bags in cfplan replay: pip install 'cfplan[ros]'",
    "pymavlink": "MAVLink logs in cfplan replay: pip install 'cfplan[mavlink]'",
}


@click.command(short_help="Check versions, packages, machine code and radio.", epilog="Example: cfplan doctor --json")
@click.option("--warm-up", "warm", is_flag=True, help="First compile everything that flights need, in parallel.")
@click.option("--safety", "safety_file", type=click.Path(path_type=Path), help="safety.yaml.  [default: the nearest]")
@click.option("--uri", help="Vehicle whose firmware and settings to check as preflight does; nothing is changed.")
@options.as_json
def doctor(warm: bool, safety_file: Path | None, uri: str | None, as_json: bool) -> int:
    """Show versions, packages, compiled functions and the radio, and report what is missing."""
    if warm:
        from cfplan.cli.warm_up import warm_up

        warm_up(safety_file or nearest(options.SAFETY_FILE, Path.cwd()) or example_limits(), Steps(as_json=as_json))
    checks = [
        _python(),
        *map(_package, NEEDED),
        *(_optional(name) for name in OPTIONAL),
        _machine_code(),
        _priority(),
        _radio(),
        *(_vehicle(uri, safety_file) if uri else ()),
    ]
    missing = [check for check in checks if check["verdict"] in ("missing", "refused")]
    if as_json:
        print_json({"cfplan": __version__, "commit": commit(), "checks": checks, "ok": not missing})
    else:
        rows = [[str(check[key]) for key in ("name", "found", "verdict", "hint")] for check in checks]
        print_table(
            f"cfplan {__version__}, commit {commit()[:12]}, on {platform.platform()}",
            ["", "found", "verdict", "hint"],
            rows,
        )
    return 5 if missing else 0


def _check(name: str, found: str, verdict: str = "ok", hint: str = "") -> dict[str, str]:
    return {"name": name, "found": found, "verdict": verdict, "hint": hint}


def _python() -> dict[str, str]:
    return _check("python", platform.python_version(), "ok" if sys.version_info >= (3, 11) else "missing")


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _package(name: str) -> dict[str, str]:
    version = _version(name)
    if version is None:
        return _check(name, "-", "missing", "pip install cfplan")
    return _check(name, version)


def _optional(name: str) -> dict[str, str]:
    version = _version(name)
    return _check(name, version or "-", "ok" if version else "optional", "" if version else OPTIONAL[name])


def _machine_code() -> dict[str, str]:
    """Check whether compiled functions can be cached for the next start."""
    from cfplan.machine_code import cache_folder, cache_writable, code_folder, count_functions

    if not cache_writable():
        hint = f"{cache_folder()} cannot be written: each command compiles anew; CFPLAN_CACHE names another folder"
        return _check("machine code", "-", "optional", hint)
    return _check("machine code", f"{count_functions()} functions in {code_folder()}")


def _priority() -> dict[str, str]:
    """Check whether setpoints can be sent ahead of other programs."""
    from cfplan.flight.real_time import STREAM_PRIORITY, may_use_fifo_scheduling

    if may_use_fifo_scheduling():
        return _check("priority", f"SCHED_FIFO, {STREAM_PRIORITY}")
    line = f"$USER - rtprio {STREAM_PRIORITY}"
    hint = (
        "setpoints wait for other programs; permit real-time scheduling by "
        f'`echo "{line}" | sudo tee /etc/security/limits.d/99-cfplan.conf`, then log in again'
    )
    return _check("priority", "ordinary", "optional", hint)


def _radio() -> dict[str, str]:
    """Check whether a Crazyradio is plugged in and may be used."""
    from cfplan.flight.radio.crazyradio import check_radio, find_radios

    try:
        check_radio("radio://0")
        return _check("radio", f"{len(find_radios())} Crazyradio")
    except CfplanError as error:
        return _check("radio", error.what, "optional", f"{error.hint}; sim:// flies without")


def _vehicle(uri: str, safety_file: Path | None) -> list[dict[str, str]]:
    """Return preflight's checks of a vehicle's firmware and settings. Raises LinkError, InputError."""
    from cfplan.flight.pilot.vehicle_survey import survey_vehicle
    from cfplan.flight.radio.connection import connect
    from cfplan.flight.radio.uri import check_vehicle_uri
    from cfplan.safety.limits_file import load_limits

    check_vehicle_uri(uri)
    logging.getLogger("cflib").setLevel(logging.CRITICAL)  # its tracebacks would hide the one-line error
    limits = load_limits(options.find_safety_file(safety_file, Path.cwd()))
    with ExitStack() as opened:
        drivers: list[type] = []
        if uri.startswith(SIMULATED):
            from cfplan.simulation.lab.lab import launch_lab
            from cfplan.simulation.lab.sim_driver import SimDriver

            opened.enter_context(launch_lab(limits.airframe, number=int(uri.removeprefix(SIMULATED)))).wait()
            drivers = [SimDriver]
        link = connect(uri, lambda message: None, drivers)
        opened.callback(link.close)
        found = survey_vehicle(link, limits)
    return [
        _check(
            check.name,
            f"{check.value}; {check.threshold}" if check.passed else f"{check.value}, must be {check.threshold}",
            "ok" if check.passed else "refused",
            check.hint,
        )
        for check in found
    ]
