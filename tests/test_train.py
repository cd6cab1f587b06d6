import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from firenet_jax import train
from firenet_jax.checkpoint import load_weights, save_weights
from firenet_jax.losses import Loss
from firenet_jax.network import Weights, initial_params
from firenet_jax.scenes import SceneSettings
from firenet_jax.train import Log, Train, images_of, initial_train_state, run, train_step


def tiny(folder, **kwargs):
    choices = {
        "steps": 6, "batch": 2, "crop": 32, "windows": 3, "warmup": 1,
        "textures": 4, "log_every": 1, "validate_every": 3, "save_every": 0.0,
        "loss": Loss(l0=1), "scene": SceneSettings(objects=0),
    }  # fmt: skip
    return Train(folder, **(choices | kwargs))


def losses(folder):
    entries = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    return [(e["step"], e["kind"], e["loss"]) for e in entries]


class Killed(Exception):
    pass


@pytest.mark.slow
def test_a_killed_run_goes_on_as_if_nothing_had_happened(tmp_path, monkeypatch, capsys):
    run(tiny(tmp_path / "whole"))
    expected = losses(tmp_path / "whole")
    assert [step for step, kind, _ in expected if kind == "train"] == [1, 2, 3, 4, 5, 6]

    original = train.train_step

    def dies(state, *args):
        if int(state.step) == 4:
            raise Killed
        return original(state, *args)

    with monkeypatch.context() as patch:
        patch.setattr(train, "train_step", dies)
        with pytest.raises(Killed):
            run(tiny(tmp_path / "killed"))
    run(tiny(tmp_path / "killed"))
    assert losses(tmp_path / "killed") == expected
    assert "best validation loss" in capsys.readouterr().out

    ours, theirs = (load_weights(tmp_path / name) for name in ("whole", "killed"))
    jax.tree.map(np.testing.assert_array_equal, ours.params, theirs.params)


@pytest.mark.slow
def test_learns_one_batch_by_heart(tmp_path):
    """The same sequences again and again: the loss must fall a long way."""
    settings = tiny(tmp_path, steps=60, warmup=5, learning_rate=3e-3)
    textures = jnp.asarray(train.load_textures(None, 4, 64, 0, procedural=1.0))
    state, key, seen = initial_train_state(settings), jax.random.key(0), []
    train_step.clear_cache()
    for _ in range(60):
        step = state.step
        state, terms = train_step(state._replace(step=jnp.int32(0)), key, textures, settings)
        state = state._replace(step=step + 1)
        seen.append(float(terms["loss"]))
    assert np.mean(seen[-5:]) < 0.6 * np.mean(seen[:5])
    assert train_step._cache_size() == 1


def test_remat_and_bfloat16_change_little(tmp_path):
    settings = tiny(tmp_path)
    params = initial_train_state(settings).params
    tensors = jax.random.normal(jax.random.key(1), (3, 1, 16, 16, 5))

    def gradient(settings):
        return jax.grad(lambda params: (images_of(params, tensors, settings)[1] ** 2).sum())(params)

    exact, again = gradient(settings), gradient(replace(settings, remat=True))
    rough = gradient(replace(settings, bfloat16=True))
    for a, b, c in zip(*map(jax.tree.leaves, (exact, again, rough)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5 * np.abs(a).max())
        assert np.abs(a - c).max() < 0.1 * np.abs(a).max()


def test_other_settings_do_not_continue_a_run(tmp_path):
    train._same_settings(tmp_path, tiny(tmp_path))
    train._same_settings(tmp_path, tiny(tmp_path))
    with pytest.raises(ValueError, match="other settings"):
        train._same_settings(tmp_path, tiny(tmp_path, seed=1))


def test_weights_that_expect_other_tensors_are_refused(tmp_path):
    path = tmp_path / "plus.npz"
    save_weights(path, Weights(initial_params(jax.random.key(0)), normalise=False))
    with pytest.raises(ValueError, match="plus.npz expects tensors that are not normalised"):
        initial_train_state(tiny(tmp_path, weights=path))


def test_the_log_forgets_what_comes_after_the_checkpoint(tmp_path):
    log = Log(tmp_path / "log.jsonl", 0)
    for step in range(1, 5):
        log.write(step, "validation", {"loss": jnp.float32(10 - step)})
    assert [entry["step"] for entry in Log(tmp_path / "log.jsonl", 2).entries] == [1, 2]
    assert Log(tmp_path / "log.jsonl", 2).best() == 8


@pytest.mark.parametrize(
    "choice, message",
    [
        ({"batch": 0}, "batch"), ({"learning_rate": -1.0}, "learning_rate"),
        ({"windows": 22}, "at most 21"), ({"windows": 1}, "more than 1"),
        ({"warmup": 6}, "warmup"),
    ],
)  # fmt: skip
def test_impossible_settings(tmp_path, choice, message):
    with pytest.raises(ValueError, match=message):
        tiny(tmp_path, **choice)
