from dataclasses import FrozenInstanceError
from pathlib import Path

import numpy as np
import pytest

from firenet_jax.errors import RecordingError
from firenet_jax.events import (
    BINS,
    MAX_TIME,
    Events,
    Recording,
    Rows,
    checked,
    concatenate,
    counted,
    rate_in_words,
    until_damage,
)


@pytest.mark.parametrize("p", [[-1, 1], [0, 1], [False, True]])
@pytest.mark.parametrize("kind", [np.uint32, np.int64])
def test_columns_of_any_kind(p, kind):
    events = Events.of(np.array([7, 9], kind), [1, 2], [3, 4], p)
    assert (events.t.dtype, events.x.dtype, events.p.dtype) == (np.int64, np.int16, bool)
    assert events.p.tolist() == [False, True] and events.t.tolist() == [7, 9]


def test_seconds_are_no_times():
    with pytest.raises(ValueError, match="whole microseconds: round 1e6 times seconds"):
        Events.of([0.25, 0.75], [0, 0], [0, 0], [0, 1])
    for time in (2.0**64, np.uint64(2**64 - 1), np.nan, -np.inf):
        with pytest.raises(ValueError, match="whole microseconds"):
            Events.of(np.array([time]), [0], [0], [0])
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


def rows_of(events, *bad):
    """As a reader gives them: these rows are no events."""
    return Rows(events, np.isin(np.arange(len(events)), bad), RecordingError("what the file says"))


def recording_of(*chunks):
    return Recording(Path("a"), "test", 18, 24, lambda: iter(chunks))


@pytest.mark.parametrize("made", [row(1), rows_of(row(1)), recording_of()])
def test_events_do_not_change(made):
    with pytest.raises(FrozenInstanceError):
        setattr(made, next(iter(made.__dataclass_fields__)), np.zeros(1))


@pytest.mark.parametrize("make", [lambda: row(1), lambda: rows_of(row(1))])
def test_chunks_are_compared_as_objects_and_are_small(make):
    """Compared column by column they would be neither equal nor not; there are millions of them."""
    one, other = make(), make()
    assert one == one and one != other and len({one, other}) == 2
    assert not hasattr(one, "__dict__")


def test_what_a_recording_is_unless_its_file_says_more():
    recording = recording_of(row(1))
    assert recording.pixels == 18 * 24
    assert recording.inferred is recording.grey is False
    assert recording.count is recording.frames is recording.triggers() is None


def test_numbers_that_the_paper_and_float64_set():
    """Five bins; times that a float of 64 bits tells apart, and the first two that it does not."""
    assert BINS == 5
    assert float(MAX_TIME - 1) < float(MAX_TIME) == float(MAX_TIME + 1)


def test_columns_of_the_right_kind_are_not_copied():
    t = np.arange(5)
    events = Events.of(t, np.int16(t), np.int16(t), t > 2)
    assert np.shares_memory(events.t, t)
    assert concatenate([events]) is events


def test_chunks_are_joined_and_with_them_what_is_wrong():
    joined = concatenate([many(0, 3), many(5, 2)])
    assert joined.t.tolist() == [0, 1, 2, 5, 6] and len(joined) == 5
    wrong = rows_of(many(5, 2), 1)
    joined = concatenate([many(0, 3), wrong, rows_of(many(7, 2), 0)])
    assert joined.events.t.tolist() == [0, 1, 2, 5, 6, 7, 8] and len(joined) == 7
    assert joined.bad.tolist() == [False] * 4 + [True, True, False] and joined.error is wrong.error


def test_one_is_no_plural():
    assert [counted(n, "event") for n in (0, 1, 2000)] == ["0 events", "1 event", "2,000 events"]


def test_events_that_are_right_pass_as_they_are():
    found, said = passed([row(5), Events.empty(), row(5, x=23), row(9, x=0)])
    assert found == [[(5, 1)], [(5, 23)], [(9, 0)]] and not said
    one_time = Events.of([9] * 4, [0, 23, 0, 23], [0, 0, 17, 17], [0, 1, 0, 1])
    assert passed([row(-MAX_TIME), one_time])[0] == [[(-MAX_TIME, 1)], [(9, 0), (9, 23)] * 2]


def test_what_is_wrong_is_not_passed_over_unless_one_says_so():
    with pytest.raises(RecordingError, match="a, event 5001: time runs backwards"):
        list(checked([many(0, 5000), row(4)], Path("a"), None, None))


@pytest.mark.parametrize("width, outside", [(24, 4), (None, 3)])
def test_places_just_outside_are_left_out_and_those_just_inside_stay(width, outside):
    x, y = np.array([0, 23, 0, 23, -1, 5, 24, 5]), np.array([0, 0, 17, 17, 5, -1, 5, 18])
    edges = Events.of(np.full(8, 9000), x, y, x > 5)
    found, said = passed([many(0, 8000), edges], strict=False, width=width)
    inside = (x >= 0) & (y >= 0) & (y < 18) & ((x < 24) | (width is None))
    assert [x for part in found for t, x in part if t == 9000] == x[inside].tolist()
    assert said[0].startswith("a, event 8005: x is -1") and f"left out: {outside} of" in said[0]


def test_one_in_a_thousand_may_be_wrong_and_the_first_of_them_is_said():
    chunks = [many(0, 999, [5]), many(2000, 999, [1]), many(9000, 998, [2, 3])]
    found, said = passed(chunks[:2], strict=False)
    assert sum(map(len, found)) == 1998
    assert said[0].startswith("a, event 1000: time runs backwards, from 998 to 5 us")
    with pytest.raises(RecordingError, match="event 2999: time runs backwards, from 9997 to 2"):
        passed(chunks, strict=False)


def test_rows_that_the_file_damages_are_left_out_and_told_in_its_words():
    chunks = [many(0), rows_of(many(2000), 7), many(4000)]
    found, said = passed(chunks, strict=False)
    assert [t for part in found for t, _ in part] == [t for t in range(6000) if t != 2007]
    assert said == ["what the file says; left out: 1 of 6,000 events"]
    with pytest.raises(RecordingError, match="what the file says"):
        passed(chunks)
    with pytest.raises(RecordingError, match="event 2001: x is 30, outside"):  # its own fault
        passed([many(0), rows_of(concatenate([row(2000, x=30), many(2001, 5)]), 3)])


@pytest.mark.parametrize("strict", [True, False])
@pytest.mark.parametrize("before", [0, 1, 2500])
def test_damage_ends_the_reading_after_what_comes_before_it(strict, before):
    def chunks():
        yield many(0, before)
        raise RecordingError("torn")

    said, seen = [], []
    found = checked(chunks(), Path("a"), 18, 24, strict=strict, say=lambda *what: said.append(what))
    if strict or not before:
        with pytest.raises(RecordingError, match="torn"):
            seen.extend(found)
        assert not said
    else:
        seen.extend(found)
        assert said == [(f"torn; what comes before is read: {counted(before, 'event')}", before)]
    assert sum(map(len, seen)) == before


def test_damage_and_what_was_left_out_are_both_said():
    def chunks():
        yield rows_of(many(0), 7)
        raise RecordingError("torn")

    said = []
    found = checked(chunks(), Path("a"), 18, 24, strict=False, say=lambda *what: said.append(what))
    assert sum(map(len, found)) == 1999
    ((sentence, rows),) = said
    assert rows == 2000 and "torn; what comes before is read: 1,999 events" in sentence
    assert "what the file says; left out: 1 of 2,000 events" in sentence


def test_a_first_look_ends_at_damage_and_raises_it_only_if_there_is_nothing_else():
    def chunks(*before):
        yield from before
        raise RecordingError("torn")

    assert [len(part) for part in until_damage(chunks(many(0, 3), row(7)))] == [3, 1]
    for before in ((), (Events.empty(),)):
        with pytest.raises(RecordingError, match="torn"):
            list(until_damage(chunks(*before)))


def test_a_microsecond_backwards_is_backwards_too():
    found, said = passed([many(0, 2000, [1998]), many(2000)], strict=False)
    assert [t for part in found for t, _ in part] == list(range(4000))
    assert "from 1999 to 1998 us" in said[0] and "left out: 1 of 4,001" in said[0]
    wrong = Events.of([*range(2000, 2003), 2001, *range(2003, 5000)], *np.ones((3, 3001)))
    assert "left out: 1 of 5,001" in passed([many(0), wrong], strict=False)[1][0]


@pytest.mark.parametrize("seed", range(20))
def test_what_is_left_out_is_the_least_that_can_be(seed):
    """As many stay as the longest sequence in order has, found by looking at all pairs."""
    late = np.random.default_rng(seed).integers(7994, 8006, 7)
    found, _ = passed([many(0, 8000), Events.of(late, *np.ones((3, 7))), many(8005)], strict=False)
    kept = np.array([t for part in found for t, _ in part])
    assert (np.diff(kept) >= 0).all()
    times, longest = [*range(7980, 8000), *late.tolist(), 8005], []
    for k, time in enumerate(times):
        longest.append(1 + max((longest[i] for i in range(k) if times[i] <= time), default=0))
    assert len(kept) == 7980 + longest[-1] + 1999


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
    one = [many(0, then=[9000]), many(2000, 2), many(9001)]
    assert "left out: 1 of 4,003 events" in passed(one, strict=False)[1][0]


@pytest.mark.parametrize(
    "t, x, message",
    [([0], [65541], "x must be whole numbers of pixels"), ([0], [1.7], "x must be whole"),
     ([0], [np.nan], "x must be whole"), ([np.inf], [1], "whole microseconds"),
     ([[0, 1]], [[1, 2]], r"of shape \(N,\), not \(1, 2\)"),
     (["1"], [1], "of numbers, but t are not"), ([0], [1j], "but x are not"),
     ([0], ["1"], "of numbers, but x are not")],
)  # fmt: skip
def test_columns_that_would_become_other_events_are_refused(t, x, message):
    y = p = np.ones_like(np.asarray(t), int)
    with pytest.raises(ValueError, match=message):
        Events.of(t, x, y, p)


@pytest.mark.parametrize(
    "p, message",
    [([1, 2], "-1 and 1, not 1 to 2"), (np.array([255, 1], np.uint8), "not 1 to 255"),
     ([np.nan, 1.0], "-1 and 1"), ([0.5, 1.0], "-1 and 1"), (["0", "1"], "but p are not")],
)  # fmt: skip
def test_polarities_of_another_kind_are_refused(p, message):
    with pytest.raises(ValueError, match=message):
        Events.of([0, 1], [0, 0], [0, 0], p)
