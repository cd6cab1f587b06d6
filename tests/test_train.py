import dataclasses
import hashlib
import itertools
import json
import shutil
import signal
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from processes import FEW_OPTIMISATIONS, finish, start, together

from firenet_jax.checkpoint import load_weights, save_weights
from firenet_jax.errors import CheckpointError, FirenetError, OutputError
from firenet_jax.events import Events
from firenet_jax.network import Weights, initial_params
from firenet_jax.simulation.curricula import window_bounds
from firenet_jax.simulation.scenes import SceneSettings
from firenet_jax.simulation.sensor import FAULTY, SensorSettings
from firenet_jax.simulation.sequences import Simulation, simulate
from firenet_jax.simulation.textures import load_textures
from firenet_jax.storage.files import locked
from firenet_jax.storage.sequence_file import Picture, write_sequence
from firenet_jax.training import run as train
from firenet_jax.training import settings as train_settings
from firenet_jax.training import step as train_steps
from firenet_jax.training.batches import NO_AUGMENT, Augment
from firenet_jax.training.log import Log
from firenet_jax.training.losses import Loss
from firenet_jax.training.run import Train, first_state, run
from firenet_jax.training.step import images_of, train_step

# Few terms compile sooner; those left out are tested in test_losses.py, and below by heart.
SHORT = Loss(l1=1, nlpd=0, haarpsi=0, l0=1)


def tiny(folder, **kwargs):
    choices = {
        "steps": 6, "batch": 2, "crop": 32, "windows": 3, "warmup": 1,
        "textures": 4, "log_every": 1, "validate_every": 3, "save_every": 0.0,
        "loss": SHORT, "scene": SceneSettings(objects=0),
    }  # fmt: skip
    if "data" in kwargs:  # of simulated sequences
        del choices["textures"], choices["scene"]
    return Train(folder, **(choices | kwargs))


def entries(folder):
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def losses(folder):
    return [(e["step"], e["kind"], e["loss"]) for e in entries(folder)]


def steps_of(folder):
    return [step for step, kind, _ in losses(folder) if kind == "train"]


class Killed(Exception):
    pass


@pytest.mark.slow
def test_a_killed_run_goes_on_as_if_nothing_had_happened(tmp_path, monkeypatch, capsys):
    # The same for both, so that it is compiled once. The state of this optimiser includes muon's.
    settings = tiny(tmp_path / "run", optimiser="centred")
    run(settings)
    expected = losses(tmp_path / "run")
    assert steps_of(tmp_path / "run") == [1, 2, 3, 4, 5, 6]
    (tmp_path / "run").rename(tmp_path / "whole")

    original = train.train_step

    def dies(state, *args):
        if int(state.step) == 4:
            raise Killed
        return original(state, *args)

    with monkeypatch.context() as patch:
        patch.setattr(train, "train_step", dies)
        with pytest.raises(Killed):
            run(settings)
    run(settings)
    assert losses(tmp_path / "run") == expected
    assert "best validation loss" in capsys.readouterr().out

    ours, theirs = (load_weights(tmp_path / name) for name in ("whole", "run"))
    jax.tree.map(np.testing.assert_array_equal, ours.params, theirs.params)


TOGETHER = """
import sys
import threading
from pathlib import Path
from firenet_jax.training.losses import Loss
from firenet_jax.simulation.scenes import SceneSettings
from firenet_jax.simulation.sensor import SensorSettings
from firenet_jax.training.run import Train, run

folder, chain, *where = sys.argv[1:]
coordinator, processes, process = (where[0], int(where[1]), int(where[2])) if where else [None] * 3
run(Train(Path(folder), batch=4, crop=32, windows=3, textures=4, log_every=1,
    validate_every=10, save_every=1e9, loss=Loss(nlpd=0, haarpsi=0, l0=1),
    scene=SceneSettings(objects=0), sensor=SensorSettings(noise=(1.0, 10.0)),
    optimiser="centred", chain=int(chain),
    coordinator=coordinator, processes=processes, process=process), stop=10)
"""


@pytest.mark.slow
def test_four_devices_and_two_processes_learn_what_one_device_learns(tmp_path):
    chain = 2
    finish(start(TOGETHER, tmp_path / "one", chain, **FEW_OPTIMISATIONS))
    finish(start(TOGETHER, tmp_path / "four", chain, devices=4, **FEW_OPTIMISATIONS))
    together(TOGETHER, tmp_path / "two", chain, **FEW_OPTIMISATIONS)

    one, four, two = (entries(tmp_path / name) for name in ("one", "four", "two"))
    assert len(one) == 11
    for others in (four, two):
        for entry, other in zip(one, others, strict=True):
            assert (other["step"], other["kind"]) == (entry["step"], entry["kind"])
            assert other["loss"] == pytest.approx(entry["loss"], rel=1e-5), entry
            if entry["kind"] == "train":  # Adam would not tell a gradient from a multiple of it
                assert other["gradient"] == pytest.approx(entry["gradient"], rel=1e-2), entry
            # Of sequences with other numbers of images that count, too.
            assert other["temporal"] == pytest.approx(entry["temporal"], rel=1e-3), entry
    for name in ("one", "four", "two"):
        assert (tmp_path / name / "weights.npz").exists()


TERMINATED = """
import os, signal, sys, time
import jax
from firenet_jax.devices import join
join(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
jax.devices()
os.kill(os.getpid(), signal.SIGTERM)
time.sleep(20)
"""


def test_one_of_several_processes_ends_when_it_is_told_to():
    with pytest.raises(AssertionError, match=f"exit -{signal.SIGTERM:d}"):
        together(TERMINATED, processes=1)


def test_a_batch_that_devices_cannot_share_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(jax, "device_count", lambda: 3)
    with pytest.raises(ValueError, match="shared by 3 devices"):
        run(tiny(tmp_path))


@pytest.mark.slow
def test_learns_one_batch_by_heart(tmp_path):
    """The same sequences again and again: the loss must fall a long way."""
    settings = tiny(tmp_path, steps=60, warmup=5, learning_rate=3e-3, loss=Loss(l0=1))
    textures = jnp.asarray(load_textures(None, 4, 64, 0, procedural=1.0))
    state, key, seen = first_state(settings), jax.random.key(0), []
    train_step.clear_cache()
    for _ in range(60):
        step = state.step
        state, terms = train_step(
            state._replace(step=jnp.int32(0)), (key, textures), settings.step_settings
        )
        state = state._replace(step=step + 1)
        seen.append(float(terms["loss"]))
    assert np.mean(seen[-5:]) < 0.6 * np.mean(seen[:5])
    assert train_step._cache_size() == 1


def test_runs_that_differ_in_paths_compile_one_step(tmp_path, monkeypatch):
    """Tracing comes before compiling: what is not traced anew is not compiled anew."""
    traced, loss_of = [], train_steps.loss_of

    def counted(*args):
        traced.append(args)
        return loss_of(*args)

    monkeypatch.setattr(train_steps, "loss_of", counted)
    train_step.clear_cache()
    state, source = first_state(tiny(tmp_path)), (jax.random.key(0), jnp.zeros((4, 64, 64)))
    for asked in (
        tiny(tmp_path / "one"),
        tiny(tmp_path / "two", images=tmp_path, weights=tmp_path, seed=3, save_every=9.0),
    ):
        train_step.eval_shape(state, source, asked.step_settings)
    assert len(traced) == 1
    train_step.eval_shape(state, source, tiny(tmp_path, clip=0.5).step_settings)
    assert len(traced) == 2  # the count counts
    train_step.clear_cache()


def test_nothing_that_a_compiled_step_depends_on_is_a_path(tmp_path):
    def leaves(value):
        if dataclasses.is_dataclass(value):
            return [
                leaf for f in dataclasses.fields(value) for leaf in leaves(getattr(value, f.name))
            ]
        return [value]

    assert not any(isinstance(leaf, Path) for leaf in leaves(tiny(tmp_path).step_settings))


def simulated_steps(asked, key, textures, count):
    """Tensors of the first steps, and which states were warm before each."""
    make = jax.jit(partial(train_steps._simulated, settings=asked.step_settings))
    state, seen, warm = first_state(asked), [], []
    for step in range(count):
        data, carried, known = make(key, textures, state=state._replace(step=jnp.int32(step)))
        state = state._replace(carried=carried)
        seen.append(data.tensors)
        warm.append(known.tolist())
    return seen, warm


@pytest.mark.slow
@pytest.mark.optimised
def test_sequences_of_a_batch_are_of_different_ages_and_go_on_where_they_were(tmp_path):
    asked = tiny(tmp_path, chain=4, sensor=replace(FAULTY, mid_recording=True))
    settings = asked.step_settings
    textures, key = jnp.asarray(load_textures(None, 4, 64, 0, procedural=1.0)), jax.random.key(1)
    lengths = train_steps._lengths(settings)
    assert lengths.tolist() == [2, 4]

    seen, warm = simulated_steps(asked, key, textures, 4)
    assert warm == [[False, False], [True, True], [False, True], [True, True]]

    def whole(number, windows):
        numbers = jnp.full(2, number, jnp.int32)
        *both, durations = train_steps._setups(
            key, textures, settings, jnp.asarray(lengths), numbers
        )
        bounds = window_bounds(durations, windows)
        return simulate(*both, bounds, height=32, width=32, renderings=5)[1].tensors

    seen, first = np.concatenate(seen), whole(0, 12)
    # Two programs: rounding moves one event in ten thousand, by up to 6e-4 of its weight.
    for part, alone in ((seen[:, 1], first[:, 1]), (seen[:6, 0], first[:6, 0]),
                        (seen[6:, 0], whole(1, 6)[:, 0])):  # fmt: skip
        np.testing.assert_allclose(part, alone, atol=1e-3)
        assert (np.abs(part - alone) > 1e-4).mean() < 1e-4
    assert not np.allclose(seen[6:, 0], first[6:, 0], atol=0.5)


@pytest.mark.slow
def test_sequences_to_and_fro_are_the_same_windows_in_every_step(tmp_path):
    asked = tiny(tmp_path, chain=4, windows=6, to_and_fro=1.0, loss=Loss(l0=2))
    textures, key = jnp.asarray(load_textures(None, 4, 64, 0, procedural=1.0)), jax.random.key(1)
    seen, warm = simulated_steps(asked, key, textures, 3)
    assert warm == [[False, False], [True, True], [False, True]]  # lengths are 2 and 4
    for now in seen:
        np.testing.assert_array_equal(now[3:], -now[2::-1, ..., ::-1])
        assert jnp.abs(now).sum((0, 2, 3, 4)).min() > 0
    np.testing.assert_array_equal(seen[0], seen[1])
    np.testing.assert_array_equal(seen[1][:, 1], seen[2][:, 1])
    assert not np.allclose(seen[1][:, 0], seen[2][:, 0], atol=0.5)


def frozen_run(folder, frozen=("gru2", "head"), **choices):
    """(settings, state, data) of a run with frozen blocks."""
    loss = Loss(l1=1.0, nlpd=0.0, haarpsi=0.0, lambda_tc=0.0, l0=0)
    settings = tiny(folder, windows=2, frozen=frozen, loss=loss, **choices)
    state, shape = first_state(settings), (2, 2, 16, 16)
    data = Simulation(
        jax.random.normal(jax.random.key(0), (*shape, 5)), jnp.full(shape, 0.3),
        jnp.zeros((*shape, 2)), jnp.ones(shape, bool),
    )  # fmt: skip
    return settings, state, data


@pytest.mark.slow
@pytest.mark.parametrize("optimiser", ["muon", "centred", "adam"])
def test_frozen_parts_keep_the_weights_they_start_from(tmp_path, optimiser):
    frozen = ("head", "gru1.gates", "gru2")
    settings, state, data = frozen_run(tmp_path, frozen, optimiser=optimiser)
    update = jax.jit(partial(train_steps._updated, settings=settings.step_settings, warm=False))
    after, *_ = update(state._replace(step=jnp.int32(1)), data, None)
    after, *_ = update(after, data, None)  # the rate of the first step is 0
    same = jax.tree.map(lambda a, b: bool((a == b).all()), after.params, state.params)
    gates, candidate = (all(jax.tree.leaves(same["gru1"].pop(k))) for k in ("gates", "candidate"))
    assert gates and not candidate
    del same["gru1"]
    for name, block in same.items():
        assert all(jax.tree.leaves(block)) == (name in settings.frozen), name


def test_blocks_beside_frozen_ones_learn_what_they_would(tmp_path):
    settings, state, data = frozen_run(tmp_path)

    def gradients(settings):
        energy = partial(train_steps.loss_of, settings=settings.step_settings)
        return jax.jit(jax.grad(lambda p: energy(p, data, None, False)[0]))(state.params)

    ours, all_of_them = gradients(settings), gradients(replace(settings, frozen=()))
    still = {name: jax.tree.map(jnp.zeros_like, ours[name]) for name in settings.frozen}
    expected = all_of_them | still
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6), ours, expected)


@pytest.mark.slow
def test_remat_and_bfloat16_change_little(tmp_path):
    settings = tiny(tmp_path)
    params = first_state(settings).params
    tensors = jax.random.normal(jax.random.key(1), (3, 1, 16, 16, 5))

    def energy(settings, params):
        return (images_of(params, tensors, settings.step_settings)[1] ** 2).sum()

    def gradient(settings):
        return jax.jit(jax.grad(partial(energy, settings)))(params)

    def kept(**choices):
        """Bytes of what the gradient needs of the forward pass."""
        back = jax.eval_shape(
            lambda params: jax.vjp(partial(energy, replace(settings, **choices)), params)[1], params
        )
        return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(back))

    for half in (False, True):  # on a CPU these keep different things without remat
        assert kept(bfloat16=half, remat=True) < 0.7 * kept(bfloat16=half)
    exact, again = gradient(settings), gradient(replace(settings, remat=True))
    rough = gradient(replace(settings, bfloat16=True))
    off = []
    for a, b, c in zip(*map(jax.tree.leaves, (exact, again, rough)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5 * np.abs(a).max())
        off.append(np.abs(a - c).max() / np.abs(a).max())
    assert 1e-3 < max(off) < 0.1


@pytest.fixture
def scores(monkeypatch):
    """Runs in which nothing is computed: each step adds one to the parameters, and a validation
    gives these scores."""
    given = {"loss": 1.0}

    def step(state, source, settings):
        params = jax.tree.map(lambda leaf: leaf + 1, state.params)
        return state._replace(params=params, step=state.step + 1), {"loss": 0.0}

    monkeypatch.setattr(train, "train_step", step)
    monkeypatch.setattr(train, "validate", lambda *_: (given, ()))
    monkeypatch.setattr(train, "sources_of", lambda *_: (itertools.repeat(0), [lambda: 0]))
    monkeypatch.setattr(Log, "show", lambda *_: None)
    return given


def begun(folder, settings):
    """A run's folder before its first step."""
    train._check_folder(folder, settings)
    train._keep_settings(folder, settings)


def test_a_run_that_began_with_other_weights_is_told(tmp_path, caplog):
    params = initial_params(jax.random.key(0))
    path, folder = tmp_path / "w.npz", tmp_path / "run"
    save_weights(path, Weights(params, normalise=True))
    begun(folder, tiny(folder, weights=path))
    train._check_folder(folder, tiny(folder, weights=path))
    assert "has changed" not in caplog.text
    save_weights(path, Weights(jax.tree.map(lambda leaf: leaf + 1, params), normalise=True))
    for _ in range(2):  # it began with the first ones, however often it goes on
        caplog.clear()
        begun(folder, tiny(folder, weights=path))
        assert "w.npz has changed since the run in" in caplog.text
    path.unlink()
    caplog.clear()
    begun(folder, tiny(folder, weights=path))
    save_weights(path, Weights(params, normalise=True))
    begun(folder, tiny(folder, weights=path))
    assert "has changed" not in caplog.text


def test_a_run_goes_on_without_the_weights_that_it_began_with(tmp_path, caplog, scores):
    weights = Weights(initial_params(jax.random.key(7)), normalise=True)
    for name in ("all", "parts"):
        save_weights(tmp_path / "w.npz", weights)
        choices = {"weights": tmp_path / "w.npz", "steps": 4, "save_every": 1e9}
        if name == "parts":
            run(tiny(tmp_path / name, **choices), stop=2)
            (tmp_path / "w.npz").unlink()
        run(tiny(tmp_path / name, **choices))
    assert "going on after step 2" in caplog.text and steps_of(tmp_path / "parts") == [1, 2, 3, 4]
    last = (load_weights(tmp_path / name / "last.npz").params for name in ("all", "parts"))
    jax.tree.map(np.testing.assert_array_equal, *last)


def test_the_folder_of_a_simulation_is_none_of_a_run(tmp_path):
    (tmp_path / "settings.json").write_text('{"seed": 0, "sequences": 5}')
    with pytest.raises(OutputError, match="is a folder of something else: choose another"):
        train._check_folder(tmp_path, tiny(tmp_path))


def test_other_settings_do_not_continue_a_run(tmp_path):
    begun(tmp_path, tiny(tmp_path))
    train._check_folder(tmp_path, tiny(tmp_path))
    with pytest.raises(ValueError, match=r"other settings \(seed was 0, now 1\)"):
        train._check_folder(tmp_path, tiny(tmp_path, seed=1))
    with pytest.raises(ValueError, match=r"\(loss.l1 was 1, now 0.5\)"):
        train._check_folder(tmp_path, tiny(tmp_path, loss=replace(SHORT, l1=0.5)))
    # how often it is looked at says nothing about what is computed
    train._check_folder(tmp_path, tiny(tmp_path, log_every=7, save_every=60.0, validate_every=4))


@pytest.mark.skipif(sys.platform == "win32", reason="no locks of this kind")
def test_a_run_that_is_still_going_on_is_left_alone(tmp_path):
    begun(tmp_path, tiny(tmp_path))
    (tmp_path / "log.jsonl").write_text('{"step": 5}\n')
    with locked(tmp_path), pytest.raises(ValueError, match="another run is writing it"):
        run(tiny(tmp_path))
    assert (tmp_path / "log.jsonl").read_text() == '{"step": 5}\n'


def test_an_output_that_is_a_file(tmp_path):
    (tmp_path / "taken").write_text("mine")
    with pytest.raises(ValueError, match="taken is a file, but a run needs a folder"):
        run(tiny(tmp_path / "taken"))


def test_a_run_that_failed_before_its_first_step_blocks_no_folder(tmp_path):
    with pytest.raises(ValueError, match="no such folder"):
        run(tiny(tmp_path / "run", images=tmp_path / "typo"))
    train._check_folder(tmp_path / "run", tiny(tmp_path / "run"))


def test_a_run_older_than_an_option_goes_on_if_that_stands_at_its_default(tmp_path):
    begun(tmp_path, tiny(tmp_path))
    path = tmp_path / "settings.json"
    older = json.loads(path.read_text())
    del older["remat"], older["scene"]["hdr"]
    path.write_text(json.dumps(older))
    other = tiny(tmp_path).scene
    with pytest.raises(ValueError, match="other settings"):
        train._check_folder(tmp_path, tiny(tmp_path, scene=replace(other, hdr=0.5)))
    train._check_folder(tmp_path, tiny(tmp_path))
    path.write_text('{"steps": 1')
    with pytest.raises(ValueError, match="settings.json is damaged"):
        train._check_folder(tmp_path, tiny(tmp_path))


def test_another_process_never_sees_half_of_the_settings(tmp_path, monkeypatch):
    settings, write, looks = Train(output=tmp_path), Path.write_bytes, []

    def write_with_a_look_in_between(path, content):
        write(path, content[:10])
        with monkeypatch.context() as other:
            other.setattr(train, "is_first", lambda: False)
            train._check_folder(tmp_path, settings)
        looks.append(path)
        write(path, content)

    monkeypatch.setattr(Path, "write_bytes", write_with_a_look_in_between)
    train._keep_settings(tmp_path, settings)
    assert [path.name for path in tmp_path.iterdir()] == ["settings.json"]
    assert len(looks) == 1


def test_weights_that_expect_other_tensors_are_refused(tmp_path):
    path = tmp_path / "plus.npz"
    save_weights(path, Weights(initial_params(jax.random.key(0)), normalise=False))
    with pytest.raises(ValueError, match="plus.npz expects tensors that are not normalised"):
        first_state(tiny(tmp_path, weights=path))


def test_the_log_forgets_what_comes_after_the_checkpoint(tmp_path):
    log = Log(tmp_path, 0)
    for step in range(1, 5):
        log.write(step, "validation", {"loss": jnp.float32(10 - step)})
    assert [entry["step"] for entry in Log(tmp_path, 2).entries] == [1, 2]
    assert Log(tmp_path, 2).best() == 8


def test_a_log_whose_last_line_is_half_written_goes_on(tmp_path):
    Log(tmp_path, 0).write(1, "validation", {"loss": jnp.float32(3)})
    with (tmp_path / "log.jsonl").open("a") as file:
        file.write('{"step": 2, "kind": "val')
    log = Log(tmp_path, 5)
    log.write(6, "validation", {"loss": jnp.float32(2)})
    assert [entry["step"] for entry in entries(tmp_path)] == [1, 6]


def test_a_damaged_log_keeps_what_is_whole(tmp_path):
    log = Log(tmp_path, 0)
    for step in (1, 2):
        log.write(step, "validation", {"loss": jnp.float32(10 - step)})
    first, second = (tmp_path / "log.jsonl").read_bytes().splitlines()
    wrong = [
        b'{"step": \xff\xfe}', b'{"kind": "validation", "loss": 1}', b"[]", b"7", b"null", b"",
        b'{"step": ' + b"9" * 10**6 + b"}", b"[" * 10**5, b'{"step": "2"}', b'{"step": true}',
        b'{"step": 1, "kind": "validation"}', b'{"step": 1, "kind": "validation", "loss": "x"}',
        b'{"step": 1, "kind": "validation", "loss": {}}',
        b'{"step": 1, "kind": "validation", "loss": 1' + b"0" * 400 + b"}",
    ]  # fmt: skip
    (tmp_path / "log.jsonl").write_bytes(b"\n".join([first, *wrong, second]))
    log = Log(tmp_path, 5)
    assert [entry["step"] for entry in log.entries] == [1, 2] and log.best() == 8
    (tmp_path / "log.jsonl").write_text(
        '{"step": 1, "kind": "validation", "loss": NaN}\n{"step": 2}\n'
    )
    assert Log(tmp_path, 5).best() == float("inf")


def test_curves_that_cannot_be_written_are_said_and_hold_nothing_up(tmp_path, caplog, monkeypatch):
    """They are written by a thread, which a full disk ends: the queue would fill, and wait."""
    refused = Mock(side_effect=OSError(28, "No space left on device"))
    log = Log(tmp_path, 0)
    with monkeypatch.context() as patch:
        patch.setattr("tensorboardX.record_writer.RecordWriter.write", refused)
        log.write(1, "train", {str(k): k for k in range(40)})
        until = time.monotonic() + 60
        while log.failed is None and time.monotonic() < until:
            time.sleep(0.01)
        with pytest.raises(OutputError, match="tensorboard: cannot write .No space left"):
            log.write(2, "train", {"loss": 1.0})
        log.close()
    assert "curves are not whole (No space left on device)" in caplog.text


def test_a_short_run_warms_up_in_fewer_steps(tmp_path):
    assert train_settings.warming_up(Train(tmp_path, steps=30)) == 6
    assert train_settings.warming_up(Train(tmp_path)) == 200
    assert train_settings.warming_up(Train(tmp_path, steps=1)) == 0
    assert train_settings.warming_up(Train(tmp_path, steps=30, warmup=20)) == 20
    assert train_settings.warming_up(Train(tmp_path, steps=300, warmup=200)) == 200


def test_ctrl_c_is_answered_while_a_step_is_being_taken(caplog, interrupts):
    """Python's own handlers wait for the end of what is in C and does not look for signals."""
    main, begun = threading.get_ident(), time.time()
    timer = threading.Timer(0.05, lambda: signal.pthread_kill(main, signal.SIGINT))
    with train._interruptible() as pressed:
        timer.start()
        hashlib.pbkdf2_hmac("sha256", b"", b"", 3_000_000)
        took = time.time() - begun
        assert pressed == [signal.SIGINT]
    (said,) = caplog.records
    assert "ends with this step and saves it" in said.message
    assert said.created - begun < 0.9 * took
    assert signal.set_wakeup_fd(-1) == -1
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_finished_run_is_lengthened_and_ctrl_c_saves(
    tmp_path, monkeypatch, caplog, interrupts, scores
):
    run(tiny(tmp_path, steps=2))
    with pytest.raises(ValueError, match="steps was 2, now 1"):
        run(tiny(tmp_path, steps=1, warmup=0))
    original = train.train_step

    def pressed(state, *args):
        if int(state.step) == 3:
            signal.raise_signal(signal.SIGINT)
        return original(state, *args)

    with monkeypatch.context() as patch:
        patch.setattr(train, "train_step", pressed)
        (tmp_path / "weights.npz").unlink()
        (tmp_path / "last.npz").unlink()
        with pytest.raises(KeyboardInterrupt, match="step 4 is saved: the same command goes on"):
            run(tiny(tmp_path, steps=6, save_every=1e6, validate_every=100))
    assert load_weights(tmp_path).params.keys() == first_state(tiny(tmp_path)).params.keys()
    assert "its 2 steps are done: it goes on to 6" in caplog.text
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert caplog.text.count("ends with this step and saves it") == 1
    with pytest.raises(ValueError, match="steps was 6, now 8"):  # not done: of another schedule
        run(tiny(tmp_path, steps=8))
    run(tiny(tmp_path, steps=6, save_every=1e6))
    assert "going on after step 4" in caplog.text
    assert steps_of(tmp_path) == [1, 2, 3, 4, 5, 6]


def test_files_of_others_are_not_replaced(tmp_path):
    (tmp_path / "run").mkdir()
    for name in ("weights.npz", "last.npz", "log.jsonl"):
        (tmp_path / "run" / name).write_text("mine")
        with pytest.raises(OutputError, match=f"holds {name}, but no settings.json of a run"):
            run(tiny(tmp_path / "run"))
        assert (tmp_path / "run" / name).read_text() == "mine"
        (tmp_path / "run" / name).unlink()


@pytest.mark.parametrize("ending", ["h5", "png"])
def test_a_run_resumes_on_the_files_that_it_began_with(tmp_path, ending):
    (tmp_path / "set/train").mkdir(parents=True)
    (tmp_path / f"set/train/a.{ending}").write_bytes(b"a")
    there = tmp_path / "set"
    source = {"data": (there,)} if ending == "h5" else {"images": there}
    asked = tiny(tmp_path / "run", **source)
    record = train._record(asked)
    (tmp_path / f"set/train/b.{ending}").write_bytes(b"b")
    other = train._record(asked)
    assert record["files"] != other["files"]
    assert {name for name in record if record[name] != other[name]} == {"files"}
    (tmp_path / "run").mkdir()
    (tmp_path / "run/settings.json").write_text(json.dumps(record))
    with pytest.raises(OutputError, match="set has changed since the run in .*run began"):
        train._check_folder(asked.output, asked)
    (tmp_path / "else").mkdir()
    elsewhere = {"data": (tmp_path / "else",)} if ending == "h5" else {"images": tmp_path / "else"}
    (tmp_path / f"else/c.{ending}").write_bytes(b"c")
    without = {name: value for name, value in record.items() if name != "files"}
    for earlier in (without, record | {"files": None}):  # of runs of before they were recorded
        (tmp_path / "run/settings.json").write_text(json.dumps(earlier))
        train._check_folder(asked.output, asked)
        with pytest.raises(OutputError, match="other settings"):
            train._check_folder(asked.output, tiny(tmp_path / "run", **elsewhere))


@pytest.mark.parametrize("ending", ["h5", "png"])
def test_a_run_knows_its_files_in_another_place(tmp_path, monkeypatch, ending):
    """And however that is spelt; another set is another one."""
    for name in ("set", "other"):
        (tmp_path / name / "train").mkdir(parents=True)
        (tmp_path / name / f"train/a.{ending}").write_bytes(name.encode())
    monkeypatch.chdir(tmp_path)
    name = {"h5": "data", "png": "images"}[ending]

    def asked(place):
        return tiny(tmp_path / "run", **{name: (Path(place),) if ending == "h5" else Path(place)})

    begun(tmp_path / "run", asked("set"))
    for place in (tmp_path / "set", "../" + tmp_path.name + "/set"):
        train._check_folder(tmp_path / "run", asked(place))
    (tmp_path / "set").rename(tmp_path / "moved")
    train._check_folder(tmp_path / "run", asked("moved"))
    with pytest.raises(OutputError, match=f"other settings .{name} was"):
        train._check_folder(tmp_path / "run", asked("other"))


def test_a_run_knows_its_recordings_and_weights_in_another_place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_weights(Path("w.npz"), Weights(initial_params(jax.random.key(0)), normalise=True))
    Path("a.aedat4").write_bytes(b"")
    there = {"data": (Path("a.aedat4"),), "weights": Path("w.npz")}
    begun(Path("run"), tiny(Path("run"), **there))
    here = {"data": (tmp_path / "a.aedat4",), "weights": tmp_path / "w.npz"}
    train._check_folder(tmp_path / "run", tiny(tmp_path / "run", **here))
    other = here | {"data": (tmp_path / "b.aedat4",)}
    with pytest.raises(OutputError, match="other settings .data was"):
        train._check_folder(tmp_path / "run", tiny(tmp_path / "run", **other))


@pytest.mark.parametrize(
    "choice, said",
    [
        ({"images": "typo"}, "typo: no such folder"),
        ({"data": ("empty",)}, "empty: holds no .h5"), ({"data": ("one",)}, "two files or more"),
    ],
)  # fmt: skip
def test_what_is_not_there_is_said_before_all_else(tmp_path, monkeypatch, choice, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "one").mkdir()
    (tmp_path / "one/a.h5").write_bytes(b"")
    monkeypatch.setattr(train_settings, "is_set", lambda path: True)
    choice = {key: Path(v) if key == "images" else (Path(v[0]),) for key, v in choice.items()}
    with pytest.raises(FirenetError, match=said):
        run(tiny(tmp_path / "run", **choice))
    assert not (tmp_path / "run").exists()


def test_the_log_of_a_run_killed_as_it_goes_on_is_still_there(tmp_path, monkeypatch):
    Log(tmp_path, 0).write(1, "validation", {"loss": jnp.float32(3)})

    def killed(path, content):
        path.open("w").close()
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Path, "write_bytes", killed)
        Log(tmp_path, 1)
    assert Log(tmp_path, 1).best() == 3


@pytest.mark.parametrize(
    "choice, message",
    [
        ({"batch": 0}, "batch"), ({"learning_rate": -1.0}, "learning_rate"),
        ({"learning_rate": float("inf")}, "learning_rate"),
        ({"loss": Loss(l1=0, nlpd=0, haarpsi=0, l0=1)}, "no distance has a weight"),
        ({"save_every": float("nan")}, "save_every is nan"),
        ({"windows": 22}, r"at most --L \+ 1 \(21\)"), ({"windows": 1}, r"more than --l0 \(1\)"),
        ({"warmup": 6}, "warmup"), ({"warmup": -5}, "warmup"),
        ({"log_every": 0}, "log_every"), ({"validate_every": 0}, "validate_every"),
        ({"crop": 10}, "smaller than 11"), ({"procedural": 3.0}, "procedural"),
        ({"slow": 0.5, "swift": 0.5}, "slow is 0.5 and swift is 0.5"),
        ({"to_and_fro": 1.5}, "to_and_fro is 1.5, but must be a share of the sequences"),
        ({"to_and_fro": 0.5, "windows": 3}, "windows is 3, but as many lead to and fro"),
        ({"motion": (2.0, 5.5)}, "5.5 pixels of motion need 6 renderings, not 5"),
        ({"crop": 16, "loss": Loss(cw_ssim=1, l0=1)}, "--cw-ssim needs 17 or more"),
        ({"chain": 2400}, "2400 steps of 3 windows, .* at most 7158 windows"),
        ({"motion": (0.0, 2.0)}, "motion is 0 2"), ({"motion": (2.0, 1.0)}, "the least first"),
        ({"data": (Path("a"),), "images": Path("b"), "scene": SceneSettings(shake=0.5)},
         "^images, shake: no effect with training on sequences from --data"),
        ({"augment": Augment(hot_pixels=0)}, "^hot-pixels: no effect with training on simulated"),
        ({"images": Path("p"), "procedural": 1.0}, "^images: no effect with training on proced"),
        ({"sensor": SensorSettings(cutoff_dark=0.5)}, "--cutoff-dark has no effect without --cut"),
        ({"seed": -3}, "seed is -3"), ({"seed": 5_000_000_000}, "less than 2"),
    ],
)  # fmt: skip
def test_impossible_settings(tmp_path, choice, message):
    with pytest.raises(ValueError, match=message):
        tiny(tmp_path, **choice)


@pytest.mark.slow
@pytest.mark.parametrize("chain", [1, 2])
def test_trains_on_files_and_resumes(tmp_path, chain):
    """Files instead of simulation, through the same loop, and killed on the way."""
    rng = np.random.default_rng(0)
    for n in range(2):
        t = np.sort(rng.integers(0, 200_000, 5000))
        columns = rng.integers(0, 32, (2, 5000)), rng.random(5000) < 0.5
        pictures = [
            Picture(k * 10_000, rng.integers(0, 256, (32, 32), np.uint8), np.zeros((2, 32, 32)))
            for k in range(20)
        ]
        events = Events.of(t, *columns[0], columns[1])
        (tmp_path / "set").mkdir(exist_ok=True)
        write_sequence(tmp_path / "set" / f"{n}.h5", [events], pictures, height=32, width=32)
    choices = {"data": (tmp_path / "set",), "chain": chain, "steps": 4}
    settings = tiny(tmp_path / "whole", **choices)
    run(settings)
    assert steps_of(tmp_path / "whole") == [1, 2, 3, 4]

    state, sources = first_state(settings), train.sources_of(settings, 0)[0]
    seen = []
    for number in range(4):
        if number == 3:
            sources = train.sources_of(settings, 3)[0]
        data, copy = next(sources), jax.tree.map(jnp.copy, state)
        state, terms = train_step(state, data, settings.step_settings)
        seen.append(float(terms["loss"]))
        if number and chain > 1:  # an odd step goes on with the network's state, others do not
            forgetful = copy._replace(carried=jax.tree.map(jnp.zeros_like, copy.carried))
            other = float(train_step(forgetful, data, settings.step_settings)[1]["loss"])
            assert (abs(other - seen[-1]) > 1e-3) == bool(number % 2)
    assert seen == [loss for _, kind, loss in losses(tmp_path / "whole") if kind == "train"]


@pytest.mark.parametrize("name", ["muon", "centred", "adam"])
def test_large_gradients_are_scaled_down_and_those_that_are_not_finite_left_out(tmp_path, name):
    update = train_steps.optimiser(tiny(tmp_path, optimiser=name, clip=0.5, warmup=0).step_settings)
    params = {"kernel": jnp.ones((3, 3, 2, 4)), "bias": jnp.ones(4)}
    before = update.init(params)
    means = {"means": jnp.ones(2)} if name == "centred" else {}
    _, after = update.update(jax.tree.map(lambda p: 100 * p, params), before, params, **means)
    moments = [
        leaf for path, leaf in jax.tree_util.tree_leaves_with_path(after)
        if ".mu" in jax.tree_util.keystr(path)
    ]  # fmt: skip
    assert 0 < optax.tree.norm(moments) <= 0.5
    broken = params | {"bias": jnp.full(4, jnp.nan)}
    again = after
    for _ in range(12):  # however many follow one another
        change, again = update.update(broken, again, params, **means)
        assert not optax.tree.norm(change)
    jax.tree.map(np.testing.assert_array_equal, again.inner_state, after.inner_state)
    assert again.notfinite_count == 12


def test_textures_to_validate_on_are_cut_anew(tmp_path, monkeypatch):
    cut = []

    def load(images, count, size, seed, procedural):
        cut.append((count, seed))
        return np.zeros((count, 2, 2), np.float32)

    monkeypatch.setattr(train, "load_textures", load)
    train.sources_of(tiny(tmp_path), 0)
    (_, training), (_, validation) = cut
    assert training != validation


def test_validation_on_files_is_on_other_files_as_they_are(tmp_path, monkeypatch):
    asked = []

    def numbered(files, *, augment, **_):
        asked.append((files, augment))
        return (number for number in range(100))  # it can be closed

    monkeypatch.setattr(train, "batches", numbered)
    monkeypatch.setattr(train, "split", lambda _: (["a"], ["b"]))
    _, validation = train.sources_of(tiny(tmp_path, data=(tmp_path,)), 0)
    assert asked == [(["a"], Augment()), (["b"], NO_AUGMENT)]
    assert [make() for make in validation] == list(range(train.VALIDATION))


def test_a_validation_is_the_mean_of_its_batches(tmp_path, monkeypatch):
    monkeypatch.setattr(train, "validate", lambda _, data, __: ({"loss": data}, ()))
    monkeypatch.setattr(Log, "show", lambda *_: None)
    settings = tiny(tmp_path)
    judge = partial(train._judge, 3, first_state(settings), settings=settings)
    made = [lambda: 1.0, lambda: 2.0, lambda: 6.0]
    log = Log(tmp_path, 0)
    assert judge(validation=made, log=log, best=4.0) == 3.0
    log.close()
    assert losses(tmp_path) == [(3, "validation", 3.0)]
    assert (tmp_path / "weights.npz").exists()  # 3 is less than 4


def test_metrics_of_a_validation_are_of_clipped_images_from_l0_on(tmp_path, monkeypatch):
    settings, shape = tiny(tmp_path).step_settings, (3, 2, 32, 32)
    truths = jnp.round(jax.random.uniform(jax.random.key(0), shape))
    images = jnp.where(truths > 0, 1.5, -0.5).at[: SHORT.l0].set(0.3)
    data = Simulation(jnp.zeros((*shape, 5)), truths, jnp.zeros((*shape, 2)), truths > 0)
    monkeypatch.setattr(train_steps, "loss_of", lambda *_: (jnp.zeros(()), ({}, None, images)))
    train_steps.validate.clear_cache()  # it is traced with the loss above, and with no other
    scores, pictures = train_steps.validate({}, data, settings)
    train_steps.validate.clear_cache()
    assert scores["mse"] == 0 and scores["ssim"] == pytest.approx(1)
    np.testing.assert_array_equal(pictures[0], images[:, 0])


def test_the_learning_rate_warms_up_and_decays_to_a_hundredth(tmp_path):
    asked = tiny(tmp_path, optimiser="adam", steps=50, warmup=5, learning_rate=1e-2)
    optimiser = train_steps.optimiser(asked.step_settings)
    params, sizes, update = {"bias": jnp.ones(4)}, [], jax.jit(optimiser.update)
    state = optimiser.init(params)
    for _ in range(51):  # Adam's update by a constant gradient is as large as the rate
        change, state = update(params, state, params)
        sizes.append(float(-change["bias"][0]))
    np.testing.assert_allclose(sizes[:6], np.linspace(0, 1e-2, 6), rtol=1e-3)
    assert (np.diff(sizes[5:]) < 0).all() and sizes[50] == pytest.approx(1e-4, rel=1e-3)


def test_ten_steps_in_a_row_without_a_finite_gradient_end_a_run(tmp_path, monkeypatch, scores):
    original = train.train_step

    def without(state, *args):
        state, terms = original(state, *args)
        optimiser = state.optimiser._replace(notfinite_count=jnp.int32(state.step))
        return state._replace(optimiser=optimiser), terms

    monkeypatch.setattr(train, "train_step", without)
    with pytest.raises(FirenetError, match="ten steps in a row had no finite gradient"):
        run(tiny(tmp_path, steps=12, save_every=1e9))
    assert steps_of(tmp_path) == list(range(1, 11))  # nine did not end it


def test_a_run_whose_newest_checkpoint_is_damaged_goes_on_from_the_one_before(tmp_path, scores):
    run(tiny(tmp_path), stop=3)
    newest = tmp_path / "checkpoints/3"
    assert {path.name for path in newest.parent.iterdir()} == {"2", "3"}
    for path in newest.rglob("*"):
        if path.is_file():
            path.write_bytes(b"")
    said = f"{newest} is damaged .*: remove it, and the run goes on after step 2"
    with pytest.raises(CheckpointError, match=said):
        run(tiny(tmp_path))
    shutil.rmtree(newest)
    run(tiny(tmp_path), stop=4)
    assert steps_of(tmp_path) == [1, 2, 3, 4]
    assert load_weights(tmp_path / "last.npz").params["head"]["bias"][0] == 4


def test_a_run_without_a_checkpoint_does_not_lose_what_it_made(tmp_path, scores):
    """One is damaged; or all are gone."""
    run(tiny(tmp_path, save_every=1e9, validate_every=1), stop=3)
    only, made = tmp_path / "checkpoints/3", (tmp_path / "weights.npz").read_bytes()
    log = (tmp_path / "log.jsonl").read_bytes()
    for path in only.rglob("*"):
        if path.is_file():
            path.write_bytes(b"")
    with pytest.raises(CheckpointError, match="damaged .*: it is the only one: choose another --o"):
        run(tiny(tmp_path))
    shutil.rmtree(only)
    with pytest.raises(OutputError, match="holds weights.npz, but no checkpoint to go on from"):
        run(tiny(tmp_path, validate_every=1))
    assert (tmp_path / "weights.npz").read_bytes() == made
    assert (tmp_path / "log.jsonl").read_bytes() == log
    # Killed before its first checkpoint was due, it begins again.
    run(tiny(tmp_path, save_every=1e9, validate_every=1), stop=1)
    assert steps_of(tmp_path) == [1]


def test_a_run_that_goes_on_keeps_weights_that_did_better_before(tmp_path, scores):
    kept = []
    for scores["loss"], stop in ((1.0, 3), (2.0, 5), (0.5, 6)):
        run(tiny(tmp_path), stop=stop)
        kept.append(load_weights(tmp_path).params["head"]["bias"][0])
    assert kept == [3, 3, 6]
    assert load_weights(tmp_path / "last.npz").params["head"]["bias"][0] == 6


def test_a_run_whose_best_weights_are_gone_says_so_and_keeps_new_ones(tmp_path, capsys, scores):
    run(tiny(tmp_path, steps=2, validate_every=1))
    (tmp_path / "weights.npz").unlink()
    run(tiny(tmp_path, steps=2, validate_every=1))
    assert "the best, weights.npz, is gone" in capsys.readouterr().out
    run(tiny(tmp_path, steps=3, validate_every=1))
    assert f"{tmp_path / 'weights.npz'}: best" in capsys.readouterr().out
    assert load_weights(tmp_path)


def test_a_run_of_before_the_warm_up_had_no_default_goes_on(tmp_path, scores):
    run(tiny(tmp_path, steps=3, warmup=None), stop=1)
    path = tmp_path / "settings.json"
    record = json.loads(path.read_text())
    assert record["warmup"] is None
    path.write_text(json.dumps(record | {"warmup": 200}))
    run(tiny(tmp_path, steps=3, warmup=None))
    with pytest.raises(ValueError, match="warmup was None, now 1"):
        run(tiny(tmp_path, steps=3, warmup=1))
