"""Progress: percent and the time left, a line a minute where there is no terminal."""

import re

from firenet_jax.storage import progress
from firenet_jax.storage.progress import Bytes, bar


def test_a_line_a_minute_without_a_terminal(capsys, monkeypatch):
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    monkeypatch.setattr("tqdm.std.time", lambda: now)
    with bar(1000, "ev") as shown:
        for _ in range(10):
            now += 13.0
            shown.update(50)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert re.match("firenet: 25 %, 01:05 passed, 03:1[45] left", lines[0])  # 195 s
    assert re.match("firenet: 50 %, 02:10 passed, 02:(10|09) left", lines[1])


def test_a_short_run_says_nothing(capsys):
    with bar(10, "ev") as shown:
        shown.update(10)
    with bar(10, "ev", quiet=True) as shown:
        shown.update(10)
    assert capsys.readouterr().err == ""


def test_bytes_read_of_bytes(tmp_path):
    (tmp_path / "folder").mkdir()
    for name, size in (("a.bin", 1000), ("folder/large", 5000), ("folder/small", 10)):
        (tmp_path / name).write_bytes(bytes(size))
    read = Bytes([tmp_path / "a.bin", tmp_path / "folder"])
    if read.total is None:
        return  # a system that does not tell
    assert read.total == 6000 and read.read() == 0
    with open(tmp_path / "folder" / "large", "rb", buffering=0) as file:
        file.read(3000)
        assert read.read() == 3000
        file.seek(0)  # a second pass
        assert read.read() == 3000
    with open(tmp_path / "a.bin", "rb") as file:
        file.read()
        assert read.read() == 4000
