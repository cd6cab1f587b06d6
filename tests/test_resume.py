"""How far an interrupted run came: what is kept, published, refused and replaced."""

import numpy as np
import pytest

from firenet_jax.storage import resume
from firenet_jax.storage.files import OutputError

RECORD = {"weights": "abc", "windows": {"events": 100}}
OTHER = {"weights": "abc", "windows": {"events": 200}}


@pytest.fixture
def output(tmp_path):
    """Of which two positions were kept, the earlier one published."""
    output = tmp_path / "out"
    for steps in (4, 8):
        resume.keep_position(output, RECORD, steps, steps - 1, state0=np.arange(steps))
    resume.publish_position(output, 4)
    return output


def test_a_position_is_there_once_it_is_published(output):
    found = resume.read_position(output, RECORD, overwrite=False)
    assert (int(found["steps"]), int(found["pictures"]), len(found["state0"])) == (4, 3, 4)
    resume.publish_position(output, 8)
    assert int(resume.read_position(output, RECORD, overwrite=False)["steps"]) == 8
    resume.keep_position(output, RECORD, 12, 11)
    resume.remove_unpublished(output)
    resume.publish_position(output, 12)  # nothing was kept
    assert int(resume.read_position(output, RECORD, overwrite=False)["steps"]) == 8
    assert resume.read_position(output.with_name("b"), RECORD, overwrite=False) is None


def test_that_of_other_settings_is_refused_by_what_differs_or_replaced(output):
    said = (
        r"out.partial holds an unfinished run .*\(windows.events was 100, now 200\): remove it or"
    )
    with pytest.raises(OutputError, match=said):
        resume.read_position(output, OTHER, overwrite=False)
    assert resume.read_position(output, OTHER, overwrite=True) is None
    np.savez(resume.position_file(output), steps=4, record="{")
    with pytest.raises(OutputError, match="resume.npz is damaged .*: remove it"):
        resume.read_position(output, RECORD, overwrite=False)
    assert resume.read_position(output, RECORD, overwrite=True) is None
    resume.position_file(output).write_bytes(b"PK, and no more")
    assert resume.read_position(output, RECORD, overwrite=True) is None


def test_an_output_is_done_while_it_and_its_settings_are_the_same(tmp_path):
    output = tmp_path / "a.mp4"
    output.write_bytes(b"video")
    assert not resume.is_done(output, RECORD)
    resume.mark_done(output, RECORD, output)
    assert resume.is_done(output, RECORD) and not resume.is_done(output, OTHER)
    output.write_bytes(b"other video")
    assert not resume.is_done(output, RECORD)
