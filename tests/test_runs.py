"""The one protocol of runs, against hand-written records."""

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from firenet_jax.storage import runs
from firenet_jax.storage.files import OutputError


@dataclass(frozen=True)
class Inner:
    rate: float = 0.5
    span: tuple[int, int] = (1, 2)


@dataclass(frozen=True)
class Settings:
    output: Path
    data: Path | None = None
    seed: int = 0
    inner: Inner = Inner()


def test_a_record_is_what_json_gives_back_without_what_does_not_count():
    found = runs.recorded(Settings(Path("out"), Path("in")), but=("output",), version="1", seed=7)
    assert found == {
        "data": "in", "seed": 7, "inner": {"rate": 0.5, "span": [1, 2]}, "version": "1",
    }  # fmt: skip
    assert json.loads(runs.as_text(found)) == found


def test_the_same_settings_go_on_and_others_are_named():
    was = runs.recorded(Settings(Path("a")), but=("output",))
    runs.check_same(was, runs.recorded(Settings(Path("b")), but=("output",)), "it", "go")
    now = runs.recorded(Settings(Path("a"), seed=2, inner=Inner(rate=1.0)), but=("output",))
    with pytest.raises(OutputError) as caught:
        runs.check_same(was, now, "out was made otherwise", "choose another")
    assert str(caught.value) == (
        "out was made otherwise (inner.rate was 0.5, now 1.0, seed was 0, now 2): choose another"
    )
    runs.check_same(was, now, "it", "go", but=("seed", "inner"))


def test_an_older_record_has_the_defaults_of_what_it_does_not_know():
    defaults = {"a": 1, "b": {"c": 2, "d": 3}, "e": 4}
    assert runs.completed({"a": 5, "b": {"c": 6}}, defaults) == {
        "a": 5, "b": {"c": 6, "d": 3}, "e": 4,
    }  # fmt: skip
    assert runs.completed({"e": {"x": 1}}, defaults)["e"] == {"x": 1}  # of another kind


@pytest.mark.parametrize("text", ["{", "[]", "7", "[" * 10**5, "\xff"])
def test_a_damaged_record_is_named(tmp_path, text):
    path = tmp_path / "settings.json"
    assert runs.read_record(path, "remove it") is None
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(OutputError, match=r"settings.json is damaged .*: remove it"):
        runs.read_record(path, "remove it")


def test_one_process_at_a_time(tmp_path):
    pytest.importorskip("fcntl")
    folder = tmp_path / "a" / "b"
    with runs.alone_in(folder):
        assert folder.is_dir()
        with pytest.raises(OutputError, match="another run is writing it"):
            with runs.alone_in(folder):
                pass
    with runs.alone_in(folder):
        pass
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="cannot make this folder"):
        with runs.alone_in(tmp_path / "file" / "in"):
            pass
