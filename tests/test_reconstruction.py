import re
from functools import partial
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_network import random_run
from test_tensors import random_events

from firenet_jax.checkpoint import convert
from firenet_jax.events import Events
from firenet_jax.instants import Step
from firenet_jax.network import Weights, initial_params, initial_state
from firenet_jax.pictures import Display, Range, display, initial_display_state
from firenet_jax.reconstruction import (
    Network,
    events_to_pictures,
    initial_session,
    looks_of,
    padding,
    reconstruct,
)
from firenet_jax.tensors import normalise as normalised
from firenet_jax.tensors import pack, voxelise

pytestmark = pytest.mark.usefixtures("each_way")


@pytest.mark.parametrize("chunk", [1, 3, 7])
@pytest.mark.parametrize("published", [False, pytest.param(True, marks=pytest.mark.reference)])
def test_streamed_in_chunks_equals_one_scan(chunk, published, request):
    """With weights whose images are about 1, as the bound of 1e-6 supposes."""
    _, tensors = random_run(steps=15, batch=1)
    weights = Weights(initial_params(jax.random.key(0)), True)
    if published:
        weights = convert(request.getfixturevalue("reference") / "firenet_published.pth")
    final, expected = reconstruct(weights, initial_state(1, 23, 31), tensors)
    state, images = initial_state(1, 23, 31), []
    for start in range(0, 15, chunk):
        state, part = reconstruct(weights, state, tensors[start : start + chunk])
        images.append(part)
    np.testing.assert_allclose(np.concatenate(images), expected, atol=1e-6)
    np.testing.assert_allclose(state.g1, final.g1, atol=1e-6)


def test_batched_with_longer_and_shorter_ones_equals_alone():
    _, tensors = random_run(steps=9, batch=3)
    weights, lengths = Weights(initial_params(jax.random.key(0)), True), (4, 9, 0)
    valid = jnp.arange(9)[:, None] < jnp.array([lengths])
    state, images = reconstruct(weights, initial_state(3, 23, 31), tensors, valid)
    for b, length in enumerate(lengths):
        alone = initial_state(1, 23, 31)
        if length:
            alone, expected = reconstruct(weights, alone, tensors[:length, b : b + 1])
            np.testing.assert_allclose(images[:length, b], expected[:, 0], atol=1e-6)
        for ours, theirs in zip(state, alone, strict=True):
            np.testing.assert_allclose(ours[b], theirs[0], atol=1e-6)


def test_without_recurrence_every_window_starts_from_zero():
    params, tensors = random_run(steps=4, batch=1)
    weights = Weights(params, True)
    state, images = reconstruct(weights, initial_state(1, 23, 31), tensors, recurrent=False)
    assert not state.g1.any()
    for t in range(4):
        expected = reconstruct(weights, initial_state(1, 23, 31), tensors[t : t + 1])[1]
        np.testing.assert_allclose(images[t], expected[0], atol=1e-6)


def test_weights_decide_about_normalisation():
    params, tensors = random_run(steps=2, batch=1)
    scaled = []
    for normalise in (True, False):
        weights = Weights(params, normalise)
        run = [reconstruct(weights, initial_state(1, 23, 31), k * tensors)[1] for k in (1, 5)]
        scaled.append(float(np.abs(run[0] - run[1]).max()))
    assert scaled[0] < 1e-4 < scaled[1]


def test_wrong_shapes_are_named():
    weights = Weights(initial_params(jax.random.key(0)), True)
    with pytest.raises(ValueError, match=r"event tensors are \(T, B, H, W, 5\)"):
        reconstruct(weights, initial_state(1, 8, 8), jnp.zeros((2, 8, 8, 5)))
    with pytest.raises(ValueError, match=r"event tensors are \(T, B, H, W, 5\)"):
        reconstruct(weights, initial_state(1, 8, 8), jnp.zeros((2, 1, 8, 8, 4)))
    with pytest.raises(ValueError, match="initial_state"):
        reconstruct(weights, initial_state(1, 8, 9), jnp.zeros((2, 1, 8, 8, 5)))


@pytest.mark.parametrize(
    "kind, exact",
    [("float16", True), ("bool", True), ("uint16", True), ("int32", False), ("float64", False)],
)
def test_numbers_are_taken_if_float32_holds_them_exactly(kind, exact):
    weights, state = Weights(initial_params(jax.random.key(0)), True), initial_state(1, 8, 9)
    with jax.enable_x64(kind.endswith("64")):
        tensors = jax.ShapeDtypeStruct((2, 1, 8, 9, 5), kind)
        if exact:
            after, images = jax.eval_shape(reconstruct, weights, state, tensors)
            assert images.dtype == after.g1.dtype == jnp.float32 and images.shape == (2, 1, 8, 9)
        else:
            with pytest.raises(ValueError, match=f"event tensors are of type {kind}, which"):
                jax.eval_shape(reconstruct, weights, state, tensors)


@pytest.mark.parametrize("valid, said", [
    (np.ones((3, 2), bool), None), (np.ones((3, 1), bool), None), (None, None),
    (np.ones((2, 3), bool), r"valid is \(2, 3\)"), (np.ones(3, bool), r"valid is \(3,\)"),
    (np.ones((1, 2), bool), r"valid is \(1, 2\)"), (np.ones((3, 2)), "valid is float"),
])  # fmt: skip
def test_which_windows_exist_is_said_for_each_or_for_all_side_by_side(valid, said):
    weights = Weights(initial_params(jax.random.key(0)), True)
    arguments = weights, initial_state(2, 8, 9), jnp.zeros((3, 2, 8, 9, 5)), valid
    if said:
        with pytest.raises(ValueError, match=said):
            reconstruct(*arguments)
    else:
        assert jax.eval_shape(reconstruct, *arguments)[1].shape == (3, 2, 8, 9)


def test_machine_code_is_taken_unless_one_says_otherwise():
    weights, state = Weights(initial_params(jax.random.key(0)), True), initial_state(1, 8, 9)

    def has_a_choice(**choices):
        call = partial(reconstruct, **choices)
        return "machine_code_or_xla" in str(
            jax.make_jaxpr(call)(weights, state, jnp.zeros((2, 1, 8, 9, 5)))
        )

    assert has_a_choice() and has_a_choice(recurrent=False)
    assert not has_a_choice(machine_code=False)


@pytest.mark.parametrize("steps", [1, 2])
def test_the_state_that_is_passed_stays_as_it_is(steps):
    """So the same windows can be seen again from there."""
    params, tensors = random_run(steps=steps, batch=1)
    weights = Weights(params, True)
    state, _ = reconstruct(weights, initial_state(1, 23, 31), tensors)
    before = np.array(state.g1), np.array(state.g2)
    runs = [reconstruct(weights, state, tensors) for _ in range(2)]
    np.testing.assert_array_equal(runs[0][1], runs[1][1])
    for kept, now in zip(before, state, strict=True):
        np.testing.assert_array_equal(kept, now)


def test_how_the_network_runs_if_nothing_is_said():
    assert Network() == Network(recurrent=True, bfloat16=False, pad=1, color=False)
    assert len({Network(), Network(), Network(pad=2)}) == 2  # arguments of a compiled function


def test_looks_of_recordings_side_by_side():
    """What is missing counts as kept, from the last state alone."""
    nothing = Events.empty()
    one = [Step(nothing, None, 1.0), Step(nothing, 30, 0.25), Step(nothing, 40, 0.5)]
    looks, share = looks_of([one, [], [Step(nothing, 7, 0.75)]], 4)
    assert looks.dtype == bool and share.dtype == np.float32
    assert looks.T.tolist() == [[False, True, True, False], [False] * 4, [True] + [False] * 3]
    assert share.T.tolist() == [[1, 0.25, 0.5, 1], [1] * 4, [0.75, 1, 1, 1]]


def test_works_inside_a_users_jit_and_vmap():
    """Weights are a pytree whose `normalise` is static."""
    params, tensors = random_run(steps=2, batch=1)
    expected = reconstruct(Weights(params, True), initial_state(1, 23, 31), tensors)[1]
    images = jax.jit(lambda w, s, x: reconstruct(w, s, x)[1])(
        Weights(params, True), initial_state(1, 23, 31), tensors
    )
    np.testing.assert_allclose(images, expected, atol=1e-6)


@pytest.mark.parametrize("size", [(180, 240), (16, 32), (17, 31), (1, 1)])
def test_padding_reaches_the_next_multiple(size):
    for length, (before, after) in zip(size, padding(*size, 16), strict=True):
        assert (length + before + after) % 16 == 0
        assert 0 <= before - after <= 1 and before + after < 16
    assert padding(180, 240, 16) == ((6, 6), (0, 0))
    assert padding(*size, 1) == ((0, 0), (0, 0))


def chunks_of(windows, chunk):
    for start in range(0, len(windows), chunk):
        part = windows[start : start + chunk]
        rows = [[events] for events in part] + [[Events.empty()]] * (chunk - len(part))
        yield pack(rows), np.arange(chunk)[:, None] < len(part), len(part)


@pytest.mark.parametrize("kind", get_args(Range))
def test_pictures_do_not_depend_on_the_chunk(kind):
    rng = np.random.default_rng(0)
    windows = [random_events(rng, 20 + 10 * k, 20, 24) for k in range(13)]
    weights = Weights(initial_params(jax.random.key(0)), True)
    runs = []
    for chunk in (13, 4):
        session, shown = initial_session(1, 20, 24, Network()), []
        for events, valid, count in chunks_of(windows, chunk):
            session, pictures = events_to_pictures(
                weights, session, events, valid, height=20, width=24,
                settings=Display(range=kind),
            )  # fmt: skip
            shown.append(pictures[:count])
        runs.append((np.concatenate(shown), session))
    difference = np.abs(runs[0][0].astype(int) - runs[1][0])
    assert difference.max() <= 1 and (difference > 0).mean() < 1e-3
    for ours, theirs in zip(jax.tree.leaves(runs[0][1]), jax.tree.leaves(runs[1][1]), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_preview_shows_the_events_beside_the_reconstruction():
    events = Events.of([0, 5, 9], [1, 2, 3], [4, 5, 6], [True, False, True])
    weights = Weights(initial_params(jax.random.key(0)), True)
    valid = np.ones((1, 1), bool)
    args = weights, initial_session(1, 20, 24, Network()), pack([[events]]), valid
    _, plain = events_to_pictures(*args, height=20, width=24)
    _, both = events_to_pictures(*args, height=20, width=24, preview=True)
    assert both.shape == (1, 1, 20, 48, 3)
    np.testing.assert_array_equal(both[0, 0, :, 24:], np.stack([plain[0, 0]] * 3, -1))
    assert both[0, 0, 4, 1].tolist() == [0, 0, 255]  # ON: blue
    assert both[0, 0, 5, 2].tolist() == [255, 0, 0]  # OFF: red
    assert both[0, 0, 0, 0].tolist() == [255, 255, 255]


def test_events_become_pictures_without_a_word_from_the_host():
    """One program: nothing in it waits for Python or copies to or from another memory."""
    weights = Weights(initial_params(jax.random.key(0)), True)
    packed = pack([[random_events(np.random.default_rng(t), 50, 8, 9)] for t in range(3)])
    session = initial_session(1, 8, 9, Network())
    size = {"height": 8, "width": 9, "settings": Display(range="extremes")}
    lowered = events_to_pictures.lower(weights, session, packed, np.ones((3, 1), bool), **size)
    program = lowered.compile().as_text()
    assert " while(" in program  # the scan; so the names below would be found too
    for talk in ("infeed", "outfeed", " send(", " recv(", "copy-start", "callback"):
        assert talk not in program


def test_accelerators_normalise_all_windows_at_once_and_cpus_one_by_one():
    """What a program is for decides, not what this machine has."""
    weights = Weights(initial_params(jax.random.key(0)), True)
    packed = pack([[random_events(np.random.default_rng(t), 50, 8, 9)] for t in range(3)])
    more = initial_session(1, 8, 9, Network()), packed, np.ones((3, 1), bool)
    size = {"height": 8, "width": 9}
    programs = {w: events_to_pictures.trace(Weights(weights.params, w), *more, **size)
                for w in (True, False)}  # fmt: skip

    def roots(platform, wanted=True):
        """How many axes what a root is taken of has: (T, B, 1, 1, 1) or (B, 1, 1, 1)."""
        text = programs[wanted].lower(lowering_platforms=(platform,)).as_text()
        found = re.findall(r"stablehlo.r?sqrt .*tensor<((?:\d+x)+)f32>", text)
        return {sizes.count("x") for sizes in found}

    assert 5 in roots("cuda") and 4 not in roots("cuda")
    assert 5 not in roots("cpu")
    assert not roots("cuda", wanted=False) & {4, 5}  # nor where nothing is to be normalised


def test_the_pictures_network_runs_as_it_is_told():
    rng = np.random.default_rng(1)
    windows = [[random_events(rng, 300, 20, 24)] for _ in range(3)]
    weights = Weights(initial_params(jax.random.key(0)), True)

    def pictures(windows, network):
        session, valid = initial_session(1, 20, 24, network), np.ones((len(windows), 1), bool)
        _, found = events_to_pictures(
            weights, session, pack(windows), valid, height=20, width=24, network=network
        )
        return np.asarray(found, int)

    plain, alone = pictures(windows, Network()), pictures(windows[2:], Network())
    assert np.abs(pictures(windows, Network(recurrent=False))[2:] - alone).max() <= 1
    assert np.abs(plain[2:] - alone).max() > 3
    rough = np.abs(pictures(windows, Network(bfloat16=True)) - plain)
    assert rough.any() and rough.mean() < 3


@pytest.mark.parametrize("pad, above, below, left, right", [(16, 7, 6, 5, 4), (2, 1, 0, 1, 0)])
def test_pictures_are_cut_out_of_the_reflected_ones(pad, above, below, left, right):
    """19x23 pixels become 32x32, and 20x24."""
    weights = Weights(initial_params(jax.random.key(0)), True)
    packed = pack([[random_events(np.random.default_rng(2), 300, 19, 23)]])
    network, valid = Network(pad=pad), np.ones((1, 1), bool)
    session = initial_session(1, 19, 23, network)
    _, found = events_to_pictures(
        weights, session, packed, valid, height=19, width=23, network=network
    )
    tensors = np.asarray(normalised(voxelise(packed, height=19, width=23)))
    padded = np.pad(tensors, ((0, 0), (0, 0), (above, below), (left, right), (0, 0)), "reflect")
    raw = Weights(weights.params, normalise=False)
    images = reconstruct(raw, initial_state(1, *padded.shape[2:4]), jnp.asarray(padded))[1]
    whole = np.asarray(display(initial_display_state(1), images)[1])
    expected = whole[..., above : above + 19, left : left + 23]
    assert np.abs(np.asarray(found, int) - expected).max() <= 1
    _, found = events_to_pictures(
        weights, session, packed, valid, height=19, width=23, network=network, raw=True
    )
    expected = images[..., above : above + 19, left : left + 23]
    np.testing.assert_allclose(found, expected, atol=2e-5)
