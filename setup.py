"""Writes the commit into what is built; all else is in pyproject.toml."""

import subprocess
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

HERE = Path(__file__).parent
COMMIT = "cfplan/commit.txt"


def write_commit(folder: str) -> None:
    """Write the commit below `folder`; an archive of the sources has it already, and no repository."""
    command = ["git", "-C", str(HERE), "rev-parse", "HEAD"]
    if (HERE / ".git").exists():
        found = subprocess.run(command, capture_output=True, text=True, check=False)
        if found.returncode == 0:
            Path(folder, COMMIT).write_text(found.stdout)


class Build(build_py):
    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            write_commit(self.build_lib)


class Archive(sdist):
    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        super().make_release_tree(base_dir, files)
        write_commit(base_dir)


setup(cmdclass={"build_py": Build, "sdist": Archive})
