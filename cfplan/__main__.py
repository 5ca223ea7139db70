"""`python -m cfplan`, where the script `cfplan` is not on the path."""

from cfplan.cli import main

main()
