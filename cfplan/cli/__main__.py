"""`python -m cfplan.cli`, where the script `cfplan` is not on the path."""

from cfplan.cli import main

main()
