"""Tables of errors for docs/errors.md: what the sources can say, with the meanings of docs/error-meanings.yaml."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from cfplan.errors import ExitCode
from cfplan.files.yaml_with_places import read_plain
from cfplan.studies.error_texts import GAP, ErrorText, all_errors

TITLES = ("what is printed", "what it means, and the cure", "exit code")
Meanings = Mapping[str, Sequence["Meaning"]]  # by module


@dataclass(frozen=True, slots=True)
class Meaning:
    """What the page says of one message beside what the sources say."""

    says: str  # as the sources have it, or as it comes from elsewhere
    means: str = ""
    cure: str = ""  # in place of a hint that is not written out in the sources
    printed: Sequence[str] = ()  # in place of the messages of its row, where the sources leave too much out


@dataclass(frozen=True, slots=True)
class ErrorRow:
    """A row of the page."""

    module: str
    messages: tuple[str, ...]
    means: str
    cures: tuple[str, ...]
    code: ExitCode | None

    def cells(self) -> list[str]:
        """Return the row as Markdown."""
        cure = "; or: ".join(self.cures)
        means = f"{self.means} " if self.means else ""
        code = "that of the flight" if self.code is None else str(int(self.code))
        return ["<br>".join(map(_code, self.messages)), f"{means}**Cure:** {cure}", code]


def read_meanings(folder: Path) -> Meanings:
    """Return what docs/error-meanings.yaml of `folder` says. Raises InputError."""
    content = read_plain(folder / "docs" / "error-meanings.yaml")
    return {module: [Meaning(**entry) for entry in entries or ()] for module, entries in content.items()}


def error_table(modules: Sequence[str], meanings: Meanings) -> tuple[list[str], list[list[str]]]:
    """Return titles and cells of the errors of these modules, each row once."""
    cells = [row.cells() for module in modules for row in rows_of(module, meanings)]
    return [*TITLES], [cell for number, cell in enumerate(cells) if cell not in cells[:number]]


def rows_of(module: str, meanings: Meanings) -> Iterator[ErrorRow]:
    """Go through the errors of a module."""
    texts = [text for text in all_errors() if text.module == module]
    said = {message for text in texts if not text.says_nothing for message in text.messages}
    told = meanings.get(module, ())
    passed_on = [meaning for meaning in told if meaning.says not in said]
    for text in texts:
        if not text.says_nothing:
            yield _row(text, [meaning for meaning in told if meaning.says in text.messages])
            continue
        for meaning in passed_on:
            yield _row(replace(text, messages=(meaning.says,)), [meaning])
        passed_on = []  # one row for all places of a module that pass errors on


def _row(text: ErrorText, told: Sequence[Meaning]) -> ErrorRow:
    means = " ".join(dict.fromkeys(meaning.means for meaning in told if meaning.means))
    printed = tuple(message for meaning in told for message in meaning.printed)
    cures = tuple(dict.fromkeys(meaning.cure for meaning in told if meaning.cure))
    return ErrorRow(
        text.module, printed or text.messages, means, cures or tuple(h for h in text.hints if h != GAP), text.code
    )  # fmt: skip


def _code(text: str) -> str:
    return f"`` {text} ``" if "`" in text else f"`{text}`"
