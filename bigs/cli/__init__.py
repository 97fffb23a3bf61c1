"""The command line `bigs`."""

import os

# numpy's matrices here are small: more threads spin while they wait for each other, and sums in another order
# are other bits. Read when numpy is loaded, so it comes first.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from bigs.cli.app import main as main
