"""`python -m studies NAME`: one study is one command and one JSON file; `pages` writes their tables into the pages."""

from studies.runner.machine import one_thread

one_thread()  # before anything imports numpy

from studies.runner.commands import main  # noqa: E402

main()
