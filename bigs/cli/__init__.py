"""The command line `bigs`."""

from bigs.cli.app import main as main
