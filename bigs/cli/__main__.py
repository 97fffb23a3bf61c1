"""The process `bigs`, or `python -m bigs.cli`."""

import gc

from bigs.cli.app import main


def run() -> None:
    """Run the command line as all that this process does."""
    try:
        main()
    finally:
        # At its end Python would look through every object of torch for cycles, which takes most of a second.
        gc.freeze()


# Worker processes import the main module again.
if __name__ == "__main__":
    run()
