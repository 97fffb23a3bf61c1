"""`python -m bigs.cli`."""

from bigs.cli.app import main

main()
