"""Files: whole or not there; damaged ones refused by name."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from firenet_jax.storage.files import (
    OutputError,
    files_in,
    identity,
    partial_name,
    read_arrays,
    write_arrays,
    write_text,
    writing,
)


def test_what_was_written_is_read(tmp_path):
    write_arrays(tmp_path / "a.npz", x=np.arange(5), name=np.array("é"))
    write_text(tmp_path / "a.txt", "é\n")
    found = read_arrays(tmp_path / "a.npz")
    assert found["x"].tolist() == [0, 1, 2, 3, 4] and str(found["name"]) == "é"
    assert (tmp_path / "a.txt").read_bytes() == "é\n".encode()
    assert len(list(tmp_path.iterdir())) == 2


def test_killed_while_writing_the_old_text_stays(tmp_path, monkeypatch):
    path, write = tmp_path / "a.txt", Path.write_bytes
    write_text(path, "old")

    def killed(path, content):
        write(path, content[:1])
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_bytes", killed)
    with pytest.raises(KeyboardInterrupt):
        write_text(path, "new")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]  # nor a part of it


@pytest.mark.parametrize("name", ["a.partial.txt", "a.partial", "a.b.partial.txt"])
def test_no_output_has_the_name_of_one_in_the_making(tmp_path, name):
    """`a.txt` would be made in its place."""
    with pytest.raises(OutputError, match=f"{name}: .partial names what is not finished"):
        write_text(tmp_path / name, "all")
    assert partial_name(tmp_path / "partial.txt").name == "partial.partial.txt"


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    for write in (lambda path: write_text(path, "new"), lambda path: write_arrays(path, x=1)):
        with pytest.raises(OutputError, match="gone/a.npz: cannot write"):
            write(tmp_path / "gone" / "a.npz")


def test_what_is_in_the_way_is_named(tmp_path):
    (tmp_path / "a.partial.txt").mkdir()
    with pytest.raises(OutputError, match=r"a.txt: cannot write \(.*, .*a.partial.txt\)"):
        write_text(tmp_path / "a.txt", "new")


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_files_in_a_folder_are_those_behind_links_too_each_once(tmp_path):
    for name in ("set/a", "set/inner/b", "elsewhere/c"):
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).touch()
    (tmp_path / "set/inner/back").symlink_to(tmp_path / "set")
    (tmp_path / "set/link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "set/again").symlink_to(tmp_path / "elsewhere")
    assert sorted(path.name for path in files_in(tmp_path / "set")) == ["a", "b", "c"]
    if hasattr(os, "mkfifo"):  # a reader would wait there
        os.mkfifo(tmp_path / "set" / "pipe")
    (tmp_path / "set" / "gone").symlink_to("nowhere")
    assert sorted(path.name for path in files_in(tmp_path / "set")) == ["a", "b", "c", "gone"]


def test_names_that_are_no_text_do_not_stop_a_file_from_being_written(tmp_path):
    write_text(tmp_path / "table.csv", "caf\udce9.npz,1")
    assert (tmp_path / "table.csv").read_text() == "caf\\udce9.npz,1"


def test_what_libraries_say_of_a_full_disk_is_one_line(tmp_path):
    hdf5 = (
        "Can't close file (file write failed: time = Mon Nov 23 22:37:05 2026\n, filename = "
        "'a.h5', errno = 28, error message = 'No space left on device', buf = 0x56)"
    )
    for error, said in (
        (OSError(hdf5), "No space left on device"), (OSError("one\ntwo"), "one two"),
        (OSError(28, hdf5), "No space left on device"),
        (OSError(28, "No space left on device"), "No space left on device"),
    ):  # fmt: skip
        with pytest.raises(OutputError) as told, writing(tmp_path / "a.h5"):
            raise error
        assert f"cannot write ({said}): nothing" in str(told.value)


def test_damaged_arrays_are_named_whatever_is_wrong_with_them(tmp_path):
    path, rng = tmp_path / "a.npz", np.random.default_rng(0)
    np.savez(path, x=np.arange(100))
    whole, kinds = path.read_bytes(), set()
    for trial in range(300):
        damaged = bytearray(whole)
        if trial % 2:
            damaged = damaged[: rng.integers(len(whole))]
        else:  # in the archive's and the array's headers
            damaged[rng.choice([rng.integers(130), -1 - rng.integers(100)])] ^= 0xFF
        path.write_bytes(damaged)
        try:
            read_arrays(path)
        except OutputError as error:
            assert "a.npz is damaged" in str(error) and "\n" not in str(error)
            kinds.add(type(error.__cause__).__name__)
    assert {"BadZipFile", "EOFError", "ValueError"} <= kinds


def test_arrays_that_would_run_code_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.array([print], object))
    with pytest.raises(OutputError, match="damaged"):
        read_arrays(tmp_path / "a.npz")


def test_other_content_is_another_identity(tmp_path):
    folder = tmp_path / "recording"
    (folder / "images").mkdir(parents=True)
    for name in ("events.txt", "images/frame.png"):
        (folder / name).write_text("some")
    seen = [identity(folder)]
    for name in ("events.txt", "images/frame.png"):
        (folder / name).write_text("other")
        assert identity(folder / name)[:2] == [Path(name).name, 5]
        seen.append(identity(folder))
    (folder / "out.partial").mkdir()
    (folder / "out.partial" / "frame.png").write_text("output")
    assert seen[0] != seen[1] != seen[2] == identity(folder)


def test_killed_while_writing_the_old_arrays_stay(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    write_arrays(path, x=np.arange(5))

    def killed(file, **arrays):
        Path(file).write_bytes(b"PK half")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez_compressed", killed)
    with pytest.raises(KeyboardInterrupt):
        write_arrays(path, x=np.arange(9))
    assert read_arrays(path)["x"].tolist() == [0, 1, 2, 3, 4]


def test_content_of_the_same_size_is_another_identity(tmp_path):
    """In a folder too; a copy that keeps the time of the change is the same."""
    (tmp_path / "folder").mkdir()
    file = tmp_path / "folder" / "events.txt"
    file.write_text("some")
    for path in (file, tmp_path / "folder"):
        os.utime(file, ns=(0, 1_000_000_000))
        seen = identity(path)
        os.utime(file, ns=(0, 1_000_000_001))
        assert identity(path) != seen
        os.utime(file, ns=(0, 1_000_000_000))
        assert identity(path) == seen
