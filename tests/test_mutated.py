"""A short run of `mutated.py`: nothing that is damaged breaks the program."""

import sys

import mutated
import pytest


@pytest.mark.skipif(sys.platform == "win32", reason="no limits of this kind")
@pytest.mark.slow
def test_damaged_inputs_are_read_or_refused():
    counts, faults = mutated.run(seed=1, first=0, count=1000)
    assert not faults, "\n".join(faults)
    assert counts["read"] > 100 and counts["refused"] > 100
