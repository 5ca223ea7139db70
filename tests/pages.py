"""The commands that README and docs/ show, and the test that runs each."""

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from markdown_it import MarkdownIt

REPOSITORY = Path(__file__).parents[1]
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
BEGINNINGS = ("cfplan ", "make ", "python ", "git ", 'eval "$(', "_CFPLAN_COMPLETE=")  # of a command in a block
FORM = re.compile(r"…|\b[A-Z]{3,}\b|<\w+>")  # in a sentence: names what is to be put there, as `dataset make DIR`
MENTIONED = ("init --mass", "fly --on-board", "doctor --uri", "dataset make --planner toppquad")  # options in sentences

# The first pattern that a command matches says which test runs it; the files' own tests hold that they do.
AS_SHOWN = "tests/cli/test_commands_of_the_pages.py::test_a_command_ends_well_as_it_is_shown"
FLOWN = "tests/cli/test_commands_of_the_pages.py::test_a_flight_lands_as_it_is_shown"
AGAIN = "tests/cli/test_fly_again.py::test_a_second_flight_goes_as_it_is_shown"
FLEETS = "tests/integration/test_fleet_in_real_time.py::test_a_fleet_lands_as_it_is_shown"
STEERED = "tests/cli/test_commands_of_the_pages.py::test_waypoints_are_flown_as_it_is_shown"
COMPLETED = "tests/cli/test_commands_of_the_pages.py::test_completion_is_set_up_as_it_is_shown"
ROOM = "tests/cli/test_virtual_in_real_time.py::test_a_second_terminal_flies_one_of_two_vehicles_by_its_own_poses"
MEASURED = "tests/cli/test_long_commands.py::test_what_takes_long_ends_well_in_small"
FROM_A_CLONE = "tests/test_packaging.py::test_make_fly_in_a_new_clone_lands_and_is_never_silent_for_ten_seconds"
PICTURES = "tests/test_pictures.py::test_make_pictures_draws_every_picture_of_the_pages"
VALIDATED = "tests/identification/test_validate_command.py::test_a_microsd_log_is_predicted_and_its_vehicle_written"
BY_CI = ".ci/run"
RUN_BY = (
    (r"--help$", AS_SHOWN),
    (r"cfplan (virtual|mocap)\b|--uri udp:|cfplan doctor --uri", ROOM),
    (r"python -m cfplan fly …$", AS_SHOWN),
    (r"cfplan fly --waypoints", STEERED),
    (r"cfplan fly flights/fleets/", FLEETS),
    (r"cfplan fly .*--after", AGAIN),
    (r"cfplan fly", FLOWN),
    (r"cfplan (dataset|train|bench|robustness)|python -m studies", MEASURED),
    (r"cfplan (init|plan|check|sim|export|replay|report|identify|doctor)\b", AS_SHOWN),
    (r"cfplan validate\b", VALIDATED),
    (r"eval|_CFPLAN_COMPLETE", COMPLETED),
    (r"git clone|make fly$", FROM_A_CLONE),
    (r"make pictures$", PICTURES),
    (r"make (test|lint site)$", BY_CI),
)


class Shown(NamedTuple):
    """A command that a page shows."""

    page: str
    line: str  # without $ and comment, and with lines joined that a backslash continues
    block: bool  # in a block of code; else inside a sentence, where it may be named by its beginning alone

    @property
    def whole(self) -> bool:
        """Return whether it can be typed as it stands."""
        named = re.fullmatch(r"cfplan (?:dataset )?[\w-]+|python -m studies( [\w-]+)?", self.line)
        return self.block or not (named or FORM.search(self.line) or self.line.removeprefix("cfplan ") in MENTIONED)


@cache
def shown_commands() -> tuple[Shown, ...]:
    """Return every command of every page, once a page."""
    return tuple(dict.fromkeys(shown for page in PAGES for shown in _of_page(page)))


def run_by(line: str) -> str | None:
    """Return the test that runs a command, or None where there is none."""
    return next((test for pattern, test in RUN_BY if re.search(pattern, line)), None)


def lines_for(test: str) -> list[str]:
    """Return the commands that this test must run, each once."""
    return sorted({shown.line for shown in shown_commands() if shown.whole and run_by(shown.line) == test})


def _of_page(page: Path) -> Iterator[Shown]:
    text, name = page.read_text(encoding="utf-8"), page.relative_to(REPOSITORY).as_posix()
    for token in MarkdownIt().parse(text):
        if token.type in ("code_block", "fence") and token.info.strip() not in ("python", "yaml"):
            for line in token.content.replace("\\\n", " ").splitlines():
                command = line.strip().removeprefix("$ ")
                if command.startswith(BEGINNINGS):
                    yield Shown(name, _without_comment(command), True)
    for span in re.findall(r"`((?:cfplan|python -m studies) [^`\n]+)`", text):
        yield Shown(name, _without_comment(span), False)


def _without_comment(line: str) -> str:
    return " ".join(re.sub(r"\s#.*", "", line).split())
