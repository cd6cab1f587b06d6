"""`python -m firenet_jax` -> `firenet`, for where that is not on the path."""

import sys

from firenet_jax.cli import program

if __name__ == "__main__":
    sys.exit(program())
