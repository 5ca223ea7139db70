"""Write a page about validated flights: predicted and measured deviations, and the effect of each piece of physics."""

import html
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cfplan.files.atomic import check_new_file, write_atomically
from cfplan.identification.validate import Comparison, Validation
from cfplan.recording.plots import FLOWN, WANTED
from cfplan.recording.report.charts import Curve, time_chart
from cfplan.recording.report.page import html_page, html_table
from cfplan.version import __version__

_CENTIMETRES = 100.0
_NOISE = 0.02  # m of measured rms, below which noise of poses and sensors is as large as what is predicted


def comparison_rows(found: Comparison) -> list[tuple[str, str, str, str]]:
    """Return the rows of predicted against measured distances from the reference."""
    pairs = [
        ("rms", found.measured_rms, found.predicted_rms), ("largest", found.measured_largest, found.predicted_largest),
        *((f"rms along {name}", found.measured_axes[axis], found.predicted_axes[axis])
          for axis, name in enumerate("xyz")),
    ]  # fmt: skip
    return [
        (name, f"{measured * _CENTIMETRES:.1f} cm", f"{predicted * _CENTIMETRES:.1f} cm", f"{predicted / measured:.2f}")
        for name, measured, predicted in pairs
    ]


def ablation_rows(validation: Validation) -> list[tuple[str, str, str, str]]:
    """Return rows that compare predictions without each part of the physics."""
    models = {"the full model": validation.comparison}
    models |= {f"without {name}": each for name, each in validation.ablations.items()}
    return [
        (name, f"{each.ratio:.2f}", f"{each.correlation:.3f}", f"{each.explained:.0%}") for name, each in models.items()
    ]


ABLATION_COLUMNS = ("model", "ratio", "correlation", "explained")
COMPARISON_COLUMNS = ("", "measured", "predicted", "ratio")


def measured_rows(validation: Validation) -> list[tuple[str, str]]:
    """Return rows of the quantities measured in the log, then of those that it does not show."""
    measured = validation.measured
    units = {"position": "m", "velocity": "m/s", "tilt": "rad"}
    rows = list(measured.found.items())
    rows += [
        (f"error of estimated {name}", f"{value:.3g} {units[name]} rms") for name, value in measured.estimate.items()
    ]
    rows += [("not shown", reason) for reason in measured.unknown]
    return rows + [("unlike", difference) for difference in measured.unlike]


def verdict(validation: Validation) -> str:
    """Describe whether the prediction holds."""
    found = validation.comparison
    agreed = f"rms {found.ratio:.2f} and largest {found.largest_ratio:.2f} of the measured"
    holds = "holds" if found.passes else "does not hold"
    noise = "" if found.passes or found.measured_rms > _NOISE else "; a deviation so small is mostly noise"
    return f"{holds}: {agreed}, correlation {found.correlation:.3f}{noise}"


def validation_to_dict(validation: Validation) -> dict[str, Any]:
    """Return a validation as plain data."""
    return {
        "name": validation.log.name,
        "holds": validation.comparison.passes,
        "commands": {"thrust": validation.recomputed.thrust, "torque": validation.recomputed.torque},
        "comparison": asdict(validation.comparison)
        | {"ratio": validation.comparison.ratio, "largest_ratio": validation.comparison.largest_ratio},
        "ablations": {name: asdict(each) | {"ratio": each.ratio} for name, each in validation.ablations.items()},
        "measured": dict(validation.measured.found),
        "unknown": list(validation.measured.unknown),
        "unlike": list(validation.measured.unlike),
        "estimate": dict(validation.measured.estimate),
    }


def write_validation_page(validations: Sequence[Validation], file: Path, *, overwrite: bool = False) -> None:
    """Write the page atomically. Raises InputError if it exists or cannot be written."""
    check_new_file(file, overwrite=overwrite)
    title = validations[0].log.name if len(validations) == 1 else f"{len(validations)} flights"
    body = f"<h1>{html.escape(title)}: predicted against measured</h1>" + "".join(map(_section, validations))
    write_atomically(file, html_page(f"{title}: validation", body, __version__).encode())


def _section(validation: Validation) -> str:
    log, wanted = validation.log, validation.reference.at(validation.log.time)[:, :3]
    charts = []
    for axis, name in enumerate("xyz"):
        curves = [
            Curve("measured", log.time, _CENTIMETRES * (log.state[:, axis] - wanted[:, axis]), FLOWN),
            Curve("predicted", log.time, _CENTIMETRES * (validation.predicted[:, axis] - wanted[:, axis]), WANTED),
        ]
        charts.append(time_chart(f"Deviation along {name}, cm", curves))
    commands = validation.recomputed
    compared = html_table("numbers", comparison_rows(validation.comparison), heads=COMPARISON_COLUMNS)
    return (
        f"<h2>{html.escape(log.name)}</h2><p>{html.escape(verdict(validation))}</p>"
        f'<div class="charts">{"".join(charts)}</div>'
        f"<h3>Distance from the reference</h3>{compared}"
        f"<h3>What each piece explains</h3>{html_table('numbers', ablation_rows(validation), heads=ABLATION_COLUMNS)}"
        f"<h3>The vehicle</h3>{html_table('provenance', measured_rows(validation))}"
        f"<p>The stated gains explain {commands.explained:.1%} of the logged commands' variance.</p>"
    )
