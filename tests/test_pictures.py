"""`make pictures` draws every picture of docs/ anew."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
IMAGES = sorted((REPOSITORY / "docs" / "images").iterdir())
CURVES = REPOSITORY / "models" / "any" / "curves.png"  # of its training, by `cfplan train`
DRIVERS = [*Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json"), *Path("/etc/vulkan/icd.d").glob("lvp_icd*.json")]


def shown_images() -> set[Path]:
    """Return the pictures that pages show or lead to."""
    linked = {
        (page.parent / image).resolve()
        for page in PAGES
        for image in re.findall(r"\]\(([^)#\s]+\.(?:png|gif|svg))\)", page.read_text())
    }
    return linked - {CURVES}


def test_the_pictures_of_the_pages_are_those_that_commands_make():
    assert shown_images() == set(IMAGES)


@pytest.mark.slow
@pytest.mark.timeout(1200)  # four flights in real time
@pytest.mark.skipif(not DRIVERS, reason="no software Vulkan driver (Debian: mesa-vulkan-drivers)")
@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium (Debian: chromium)")
def test_make_pictures_draws_every_picture_of_the_pages(tmp_path):
    clone = tmp_path / "cfplan"
    subprocess.run(["git", "clone", "--quiet", REPOSITORY, clone], check=True)
    drawn = [clone / "docs" / "images" / image.name for image in IMAGES]
    for image in drawn:
        os.utime(image, (0, 0))
    done = subprocess.run(
        ["make", "--old-file=install", "pictures", f"VENV={sys.prefix}"],
        cwd=clone, env={**os.environ, "PYTHONPATH": str(clone)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert [image.name for image in drawn if not image.stat().st_mtime] == []
    assert all(image.stat().st_size > 10_000 for image in drawn)
