"""Arrays of one's own: what is taken, and what is refused by name."""

import ast
from pathlib import Path

import numpy as np
import pytest

import firenet_jax as fj
from firenet_jax.events import concatenate

T = np.array([10, 20, 20, 3_000_000])
X, Y, P = np.array([0, 5, 23, 7]), np.array([3, 0, 19, 8]), np.array([1, 0, 0, 1])
SIZE = {"width": 24, "height": 20}


def columns_of(recording):
    events = concatenate(list(recording.events()))
    return [getattr(events, name).tolist() for name in "txyp"]


EXPECTED = [T.tolist(), X.tolist(), Y.tolist(), P.astype(bool).tolist()]


@pytest.mark.parametrize("p", [P, P.astype(bool), 2 * P - 1, P.astype(np.float32), P.tolist()])
@pytest.mark.parametrize(
    "t, unit",
    [(T, None), (T, "us"), (T / 1e6, None), (T / 1e6, "s"), (T / 1e3, "ms"), (T / 1.0, "us"),
     (T.astype(np.uint32), None), (T.tolist(), None)],
)  # fmt: skip
def test_columns_of_every_kind(t, unit, p):
    recording = fj.recording(t, X.astype(np.uint16), Y.astype(np.float64), p, unit=unit, **SIZE)
    assert (recording.height, recording.width, recording.count) == (20, 24, 4)
    for _ in range(2):
        assert columns_of(recording) == EXPECTED


@pytest.mark.parametrize("kind", [np.int32, np.uint16, np.uint64, np.float32])
def test_units_are_applied_to_wide_numbers(kind):
    """int32 milliseconds overflow as microseconds after 36 minutes, float32 after 17 s."""
    late = 60_000 if kind == np.uint16 else 2**24 - 1 if kind == np.float32 else 2**31 - 1
    t = np.array([late - 2, late], kind)
    units = {"ms": 1000} if kind != np.float32 else {"us": 1, "ms": 1000}
    for unit, factor in units.items():
        recording = fj.recording(t, [1, 2], [3, 4], [0, 1], unit=unit, **SIZE)
        assert columns_of(recording)[0] == [factor * (late - 2), factor * late]
    if kind == np.uint64:
        with pytest.raises(ValueError, match="beyond 9007199254740 ms: is the unit right"):
            fj.recording(t + np.uint64(2**62), [1, 2], [3, 4], [0, 1], unit="ms", **SIZE)


def test_whole_floating_times_are_asked_about(tmp_path, caplog):
    fj.recording(T / 1e6 + 0.25, X, Y, P, **SIZE)
    assert not caplog.text
    fj.recording(T.astype(float), X, Y, P, **SIZE)
    assert "read as seconds, though whole ones" in caplog.text and 'unit="us"' in caplog.text
    caplog.clear()
    np.save(tmp_path / "a.npy", np.stack([T.astype(float), X, Y, P], 1))
    fj.open_recording(tmp_path / "a.npy", (20, 24))
    assert "store them as integers" in caplog.text


@pytest.mark.parametrize("names", ["txyp", ["timestamp", "x", "y", "polarity"]])
def test_a_structured_array(names):
    kind = np.dtype(
        [(name, kind) for name, kind in zip(names, ("i8", "u2", "u2", "?"), strict=True)]
    )
    array = np.array([*zip(T, X, Y, P, strict=True)], kind)
    assert columns_of(fj.recording(array, **SIZE)) == EXPECTED


def test_they_become_tensors():
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 10**6, 500))
    columns = rng.integers(0, 24, 500), rng.integers(0, 20, 500), rng.random(500) < 0.5
    recording = fj.recording(t, *columns, **SIZE)
    found = [(tensors.shape, times) for tensors, times in fj.event_tensors(recording, events=100)]
    assert found[0][0] == (5, 1, 20, 24, 5) and found[0][1].tolist() == t[99::100].tolist()


@pytest.mark.parametrize(
    "change, said",
    [
        ({"x": X[:3]}, r"one length are expected, not t \(4,\), x \(3,\)"),
        ({"t": T[::-1]}, "event 2: time runs backwards, from 3000000 to 20 us"),
        ({"x": [0, -10, 3, 4]}, "event 2: x is -10, but coordinates are 0 or more"),
        ({"x": [0, 24, 3, 4]}, "event 2: x is 24, outside the sensor of 24x20"),
        ({"y": [0, 1, 20, 4]}, "event 3: y is 20, outside the sensor of 24x20"),
        ({"x": [0, 1.5, 3, 4]}, "event 2: x is 1.5, expected a whole number"),
        ({"x": [0, 70_000, 3, 4]}, "event 2: x is 70000, expected a coordinate below"),
        ({"p": [0, 1, 2, 1]}, "event 3: the polarity is 2"),
        ({"t": [0.0, np.nan, 1.0, 2.0]}, "event 2: the time is nan"),
        ({"t": ["a", "b", "c", "d"]}, "t is <U1, expected numbers"),
        ({"x": ["a", "b", "c", "d"]}, "x is stored as <U1"),
        ({"t": [], "x": [], "y": [], "p": []}, "holds no events"),
        ({"unit": "ns"}, "unit is 'ns', expected one of s, ms, us"),
        ({"width": 0}, "width is 0"), ({"height": 20.5}, "height is 20.5"),
        ({"width": float("nan")}, "width is nan"), ({"height": "20"}, "height is '20', but"),
        ({"width": 10**6}, "width is 1000000, but is a number of pixels, at most 32768"),
        ({"width": 2**13, "height": 2**12}, "8192x4096 pixels, expected at most 16,777,216"),
        ({"x": None, "y": None, "p": None}, "pass t, x, y and p, or one structured array"),
        ({"x": None}, "pass t, x, y and p"),
        ({"t": np.ma.masked_array(T, [0, 1, 0, 0])}, "some entries are masked"),
        ({"t": np.zeros(3, [("a", "i4")]), "x": None, "y": None, "p": None}, "has the fields a,"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_at_once(change, said):
    choices = {"t": T, "x": X, "y": Y, "p": P, **SIZE} | change
    with pytest.raises(fj.RecordingError, match=said):
        fj.recording(**choices)


def test_columns_of_unequal_length_are_no_events():
    with pytest.raises(ValueError, match=r"columns differ in length: t \(3,\), x \(2,\)"):
        fj.Events.of([1, 2, 3], [0, 0], [0, 0], [1, 1])


def test_what_is_passed_for_weights_and_state_is_told_apart():
    weights, state = fj.load_weights(), fj.initial_state(1, 20, 24)
    tensors = np.zeros((1, 1, 20, 24, 5), np.float32)
    recording, event = fj.recording(T, X, Y, P, **SIZE), fj.Events.of([1], [2], [3], [1])
    for call, said in (
        (lambda: fj.reconstruct(weights.params, state, tensors), "pass Weights, as load_weights"),
        (lambda: fj.reconstruct(weights, None, tensors), "make it with initial_state"),
        (lambda: fj.reconstruct(weights, state, tensors.tolist()), "tensors is a list"),
        (lambda: fj.reconstruct(weights, state, tensors, [True]), "valid is a list"),
        (lambda: fj.step(weights, state, tensors[0]), "pass weights.params"),
        (lambda: fj.step(weights.params, None, tensors[0]), "make it with initial_state"),
        (lambda: fj.step(weights.params, state, tensors[0].tolist()), "event_tensor is a list"),
        (lambda: fj.step(weights.params, state, tensors[0], [True]), "exists is a list"),
        (lambda: fj.normalise(tensors.tolist()), "tensors is a list"),
        (lambda: fj.display(None, tensors[..., 0]), "make it with initial_display_state"),
        (lambda: fj.display(fj.initial_display_state(1), [[[[0.5]]]]), "images is a list"),
        (lambda: fj.pack(event), r"pass \[\[events\]\]"),
        (lambda: fj.pack([event]), r"pass \[\[events\]\]"),
        (lambda: fj.pack([[(1, 2, 3, True)]]), "not of a tuple"),
        (lambda: next(fj.images_at(weights.params, recording, [25])), "pass Weights"),
        (lambda: next(fj.images_at("w.npz", recording, [25])), "weights are a str: pass Weights"),
        (lambda: next(fj.images_at(weights, "a.txt", [25])), "pass what open_recording gives"),
        (lambda: next(fj.event_tensors("a.txt")), "pass what open_recording gives"),
    ):
        with pytest.raises(TypeError, match=said):
            call()
    assert fj.display(None, tensors[..., 0], settings=fj.Display(range="fixed"))[0] is None
    with pytest.raises(ValueError, match="come in order, but 21 us after 25 us"):
        list(fj.images_at(weights, recording, [25, 21]))
    for tensor, said in (
        (tensors, r"\(B, H, W, 5\), not \(1, 1, 20, 24, 5\)"), (tensors[0, 0], "B, H, W, 5"),
        (np.moveaxis(tensors[0], -1, 1), "B, H, W, 5"), (tensors[0, :, 1:], "the state is of"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=said):
            fj.step(weights.params, state, tensor)
    for exists in (np.array([255], np.uint8), np.ones((1, 1), bool), np.ones(2, bool)):
        with pytest.raises(ValueError, match=r"exists is .*, but must be bool \(1,\)"):
            fj.step(weights.params, state, tensors[0], exists)
    with pytest.raises(ValueError, match=r"\(..., H, W, bins\), not \(5,\)"):
        fj.normalise(tensors[0, 0, 0, 0])


def test_type_checkers_see_the_names_that_are_there():
    tree = ast.parse(Path(fj.__file__).read_text())
    seen = {
        alias.name: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    homes = {name: f"firenet_jax.{module}" for name, module in fj._HOME.items()}
    assert seen == homes | {"TYPE_CHECKING": "typing", "Any": "typing"}
    assert sorted(fj.__all__) == sorted(homes)


def test_version_and_a_short_repr_of_weights():
    assert fj.__version__.count(".") >= 2
    assert repr(fj.load_weights()) == "Weights(37,777 parameters, normalise=True)"
    numbers = fj.Weights({"kernel": 1.0, "bias": 2.0}, normalise=False)
    assert repr(numbers) == "Weights(2 parameters, normalise=False)"


@pytest.mark.parametrize(
    "unit, first, said",
    [
        ("s", 1000.0, "by 61 us"),
        (None, 1000.0, "by 61 us"),
        ("ms", 1e6, "by 62.5 us"),
        ("us", 3e7, "by 2 us"),
    ],
)
def test_times_of_few_digits_are_said(unit, first, said, caplog):
    t = np.array([first, first + 8, first + 16], np.float32)
    fj.recording(t, X[:3], Y[:3], P[:3], unit=unit, **SIZE)
    assert f"tells these times apart {said}" in caplog.text
    caplog.clear()
    fj.recording(np.array([0.5, 1.25, 7.0], np.float32), X[:3], Y[:3], P[:3], **SIZE)
    assert "apart" not in caplog.text
