"""`python -m bigs.cli`."""

from bigs.cli.app import main

# Worker processes import the main module again.
if __name__ == "__main__":
    main()
