"""Which exceptions the command line turns into a sentence, and which it shows as they are."""

import gc
import os
import subprocess
import sys
import time
import traceback

import pytest

import firenet_jax as fj
from firenet_jax import cli, errors, settings
from firenet_jax.commands import info

FAMILY = [
    kind
    for kind in vars(errors).values()
    if isinstance(kind, type) and issubclass(kind, errors.FirenetError)
]


def raising(error):
    def run(settings):
        raise error

    return run


def test_all_are_value_errors_too_and_are_explained():
    assert len(FAMILY) == 6
    for kind in FAMILY:
        assert issubclass(kind, ValueError) and kind.__doc__
    assert fj.FirenetError is errors.FirenetError and fj.RecordingError is errors.RecordingError


@pytest.mark.parametrize("kind", [*FAMILY, OSError])
def test_what_a_person_can_put_right_is_one_sentence(tmp_path, monkeypatch, capsys, kind):
    monkeypatch.setattr(info, "run", raising(kind("a.txt, line 3: no number")))
    assert cli.main(["info", "a.txt"]) == 1
    assert capsys.readouterr().err == "firenet: error: a.txt, line 3: no number\n"


@pytest.mark.parametrize("kind", [ValueError, TypeError, KeyError, RuntimeError, AssertionError])
def test_a_fault_of_ours_shows_where_it_is_and_asks_for_a_report(monkeypatch, kind):
    monkeypatch.setattr(info, "run", raising(kind("a fault")))
    with pytest.raises(kind) as caught:
        cli.main(["info", "a.txt"])
    said = "".join(traceback.format_exception(caught.value))
    assert said.splitlines()[-1].startswith(
        "firenet: this is a bug in firenet, not a mistake of yours"
    )
    assert "test_errors.py" in said and "Traceback" in said


def test_ctrl_c_in_a_callback_of_the_garbage_collector_is_not_lost(monkeypatch, capsys, interrupts):
    """Python drops what such a callback raises; JAX has one."""

    def collected(phase, found):
        if gc.callbacks.count(collected):
            gc.callbacks.remove(collected)
            raise KeyboardInterrupt

    def run(settings):
        gc.callbacks.append(collected)
        gc.collect()
        time.sleep(30)

    monkeypatch.setattr(info, "run", run)
    before = sys.unraisablehook
    assert cli.main(["info", "a.txt"]) == 130
    assert capsys.readouterr().err == "firenet: interrupted\n"
    assert sys.unraisablehook is before


COMPUTING = """
import sys
import jax
import jax.numpy as jnp
from firenet_jax import cli
from firenet_jax.commands import info

def run(settings):  # for minutes, while Python goes on
    jax.jit(lambda x: jax.lax.fori_loop(0, 10**7, lambda _, x: x @ x, x))(jnp.ones((300, 300)))
    raise KeyboardInterrupt

info.run = run
sys.argv[1:] = ["info", "a.txt"]
sys.exit(cli.program())
"""


def test_ctrl_c_ends_at_once_what_is_still_being_computed():
    command = [sys.executable, "-c", COMPUTING]
    environment = os.environ | {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}
    ended = subprocess.run(command, env=environment, stderr=subprocess.PIPE, text=True, timeout=100)
    assert (ended.returncode, ended.stderr) == (130, "firenet: interrupted\n")


def test_settings_errors_name_what_can_be():
    assert settings.parse_size("240x180") == (180, 240) and settings.parse_size(None) is None
    for wrong in ("big", "0x4", "-1x4", "240", "32769x1"):
        with pytest.raises(errors.SettingsError, match="sensor size"):
            settings.parse_size(wrong)
    settings.check_seed(2**32 - 1)
    for wrong in (-1, 2**32):
        with pytest.raises(errors.SettingsError, match="seed is"):
            settings.check_seed(wrong)
    settings.check_range("speed", (1.0, 1.0))
    for wrong in ((0.0, 1.0), (2.0, 1.0), (1.0, float("inf"))):
        with pytest.raises(errors.SettingsError, match="drawn log-uniformly"):
            settings.check_range("speed", wrong)
