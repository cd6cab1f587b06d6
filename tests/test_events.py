import numpy as np
import pytest

from firenet_jax.events import Events


@pytest.mark.parametrize("p", [[-1, 1], [0, 1], [False, True]])
@pytest.mark.parametrize("kind", [np.uint32, np.int64])
def test_columns_of_any_kind(p, kind):
    events = Events.of(np.array([7, 9], kind), [1, 2], [3, 4], p)
    assert (events.t.dtype, events.x.dtype, events.p.dtype) == (np.int64, np.int16, bool)
    assert events.p.tolist() == [False, True] and events.t.tolist() == [7, 9]


def test_seconds_are_no_times():
    with pytest.raises(ValueError, match="whole microseconds: round 1e6 times seconds"):
        Events.of([0.25, 0.75], [0, 0], [0, 0], [0, 1])
    assert len(Events.of([], [], [], [])) == 0
