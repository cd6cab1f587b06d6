from dataclasses import FrozenInstanceError
from pathlib import Path

import numpy as np
import pytest

from firenet_jax.errors import RecordingError
from firenet_jax.events import Events, checked, rate_in_words


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


def test_backwards_is_the_other_way_round():
    events = Events.of([5, 7, 12], [1, 2, 3], [4, 5, 6], [0, 0, 1])
    found = events.backwards()
    assert found.t.tolist() == [5, 10, 12]
    assert (found.x.tolist(), found.y.tolist()) == ([3, 2, 1], [6, 5, 4])
    assert found.p.tolist() == [False, True, True]


def test_a_thousand_events_a_second_are_a_kev():
    assert [rate_in_words(rate) for rate in (999, 1e3, 1e6)] == ["999 ev/s", "1 kev/s", "1 Mev/s"]


def passed(chunks, strict=True, width=24):
    """Times and places that `checked` passes on, and what it says."""
    said = []
    found = checked(
        chunks,
        Path("a"),
        18,
        width,
        strict=strict,
        say=lambda sentence, rows: said.append(sentence),
    )
    return [list(zip(part.t.tolist(), part.x.tolist(), strict=True)) for part in found], said


def row(t, x=1, y=2):
    return Events.of([t], [x], [y], [1])


def many(first, count=2000, then=()):
    """Right events, one a microsecond, and then some at these times."""
    t = [*range(first, first + count), *then]
    return Events.of(t, np.ones(len(t)), np.ones(len(t)), np.ones(len(t)))


def test_a_place_outside_is_named_where_two_events_have_one_time():
    with pytest.raises(RecordingError, match="x is 24"):
        passed([many(0, 3), row(2, x=24)])


def test_events_do_not_change():
    with pytest.raises(FrozenInstanceError):
        row(1).t = np.zeros(1)


def test_events_that_are_right_pass_as_they_are():
    found, said = passed([row(5), Events.empty(), row(5, x=23), row(9, x=0)])
    assert found == [[(5, 1)], [(5, 23)], [(9, 0)]] and not said


@pytest.mark.parametrize(
    "x, y, width, named",
    [
        (24, 2, 24, "x is 24, outside"), (-1, 2, 24, "x is -1, but"), (30, 40, 24, "x is 30, out"),
        (5, 18, 24, "y is 18, outside"), (23, -2, 24, "y is -2, but"), (0, 18, None, "y is 18, ou"),
        (-3, 1, None, "x is -3, but"),
    ],
)  # fmt: skip
def test_the_first_coordinate_that_is_wrong_is_named(x, y, width, named):
    with pytest.raises(RecordingError, match=f"a, event 2: {named}"):
        passed([row(1), row(2, x, y)], width=width)


def test_an_error_is_said_once_by_what_is_raised():
    """Even where rows were left out before it."""
    said = []
    bad = many(5000, count=500, then=[1, 2, 3, 4])
    found = checked([many(0, then=[10]), bad], Path("a"), 18, 24, strict=False,
                    say=lambda *what: said.append(what))  # fmt: skip
    with pytest.raises(RecordingError, match="event 2502: time runs backwards"):
        list(found)
    assert not said


def test_time_goes_on_from_the_last_event_that_was_kept():
    """After a chunk of which a row was left out, as after one that was right."""
    found, said = passed([many(0, then=[10]), many(1998, count=9000)], strict=False)
    times = [t for part in found for t, _ in part]
    assert times == [*range(2000), *range(1999, 10998)]
    assert len(said) == 1 and "left out: 2 of 11,001 events" in said[0]


def test_what_is_right_comes_before_the_error_that_ends_the_reading():
    """Although the end of a chunk waits for the next one."""
    found = checked([many(0), many(5000, count=500), many(0)], Path("a"), 18, 24)
    assert [len(next(found)), len(next(found)), len(next(found))] == [1000, 1000, 500]
    with pytest.raises(RecordingError, match="event 2501: time runs backwards, from 5499 to 0"):
        next(found)


def test_as_few_as_possible_are_left_out_across_chunks():
    """Of two chunks, the end of the first or the beginning of the second."""
    late = [many(0, then=[9000]), many(2000, then=[9000, 9001]), many(4000), many(6000)]
    found, said = passed(late, strict=False)
    assert [t for part in found for t, _ in part] == list(range(8000))
    assert len(said) == 1 and "left out: 3 of 8,003 events" in said[0]
    early = [many(0), many(2000), many(1998, count=1, then=range(4000, 6000))]
    found, said = passed(early, strict=False)
    assert [t for part in found for t, _ in part] == [*range(4000), *range(4000, 6000)]
