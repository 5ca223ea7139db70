"""Adds to the site README, the changes, linked files outside docs/, and the tables of the code and of results."""

import posixpath
import re
from pathlib import Path
from typing import Any

from code_tables import rendered  # beside this file
from mkdocs.structure.files import File, Files

from studies.runner.pages import with_results

REPOSITORY = Path(__file__).parent.parent
PAGES = {"README.md": "begin.md", "CHANGELOG.md": "changes.md"}  # and what they are called on the site
LINK = re.compile(r"(?<=\]\()(?!\w+:)[^)#\s]+")
COMMANDS = re.compile(r"(?<=\n\n)(?: {4}(?:\$ )?(?:cfplan|make|python|git) .*\n(?: {4} .*\n)*)+(?=\n)")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages, and each linked file under source/."""
    texts = {f"docs/{file.src_uri}": file.content_string for file in files if file.is_documentation_page()}
    for name, page in PAGES.items():
        texts[name] = (REPOSITORY / name).read_text()
        files.append(File.generated(config, page, content=_with_links_led(texts[name], name, page)))
    linked = {_inside(name, link) for name, text in texts.items() for link in LINK.findall(text)}
    for target in sorted(linked - set(PAGES)):
        if not target.startswith("docs/") and (REPOSITORY / target).is_file():
            files.append(File.generated(config, f"source/{target}", abs_src_path=str(REPOSITORY / target)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Render the tables, lead the links of docs/ that leave it to what on_files added, mark commands."""
    uri, markdown = page.file.src_uri, with_results(rendered(markdown), REPOSITORY)
    text = markdown if uri in PAGES.values() else _with_links_led(markdown, f"docs/{uri}", uri)
    return COMMANDS.sub(_as_shell, text + "\n")


def _as_shell(block: re.Match[str]) -> str:
    """Return a block of commands by its language: comments in grey, and long lines go on in the next one (site.css)."""
    return "```sh\n" + re.sub(r"^ {4}", "", block[0], flags=re.MULTILINE) + "```\n"


def _with_links_led(text: str, name: str, page: str) -> str:
    """Return the text of a file of the repository with its links as they must be on that page of the site."""

    def led(link: re.Match[str]) -> str:
        target = _inside(name, link[0])
        there = target.removeprefix("docs/") if target.startswith("docs/") else PAGES.get(target, f"source/{target}")
        return posixpath.relpath(there, posixpath.dirname(page) or ".")

    return LINK.sub(led, text)


def _inside(name: str, link: str) -> str:
    """Return the file of the repository that a link in another of its files names."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(name), link))
