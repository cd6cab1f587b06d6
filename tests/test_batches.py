import itertools
import json
import sys
from dataclasses import replace

import h5py
import jax
import numpy as np
import pytest
import references

from firenet_jax.commands import simulate as dataset
from firenet_jax.commands.simulate import Simulate
from firenet_jax.errors import RecordingError
from firenet_jax.events import Events
from firenet_jax.simulation.textures import load_textures
from firenet_jax.storage.sequence_file import Picture, write_sequence
from firenet_jax.training.batches import (
    NO_AUGMENT,
    Augment,
    _pauses,
    _simulation,
    batches,
    find,
    split,
)
from firenet_jax.warp import warp

HEIGHT, WIDTH, IMAGES, CROP, WINDOWS, BATCH = 20, 24, 13, 16, 4, 3
SIZES = {"batch": BATCH, "windows": WINDOWS, "crop": CROP}
START = 1_700_000_000_000_000  # microseconds; as int32 or float32 these times would be wrong
VELOCITY = np.array([70.0, -45.0])  # pixels per second, to the right and up


def times():
    """Of the images, irregular."""
    gaps = 20_000 + 5_000 * (np.arange(IMAGES) % 3)
    return START + np.cumsum(gaps)


def random_events(seed, count=4000):
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(times()[0] - 9_000, times()[-1] + 9_000, count))
    t[::10] = times()[np.searchsorted(times(), t[::10]).clip(0, IMAGES - 1)]  # at an image's time
    x, y = rng.integers(0, WIDTH, count), rng.integers(0, HEIGHT, count)
    return Events.of(np.sort(t), x, y, rng.random(count) < 0.5)


def noise_pictures(seed):
    """Each crop of each of these is unlike all others; their flow is noise too."""
    rng = np.random.default_rng(seed)
    for time in times():
        image = rng.integers(0, 256, (HEIGHT, WIDTH), np.uint8)
        yield Picture(int(time), image, rng.normal(0, 60, (2, HEIGHT, WIDTH)).astype(np.float32))


def moving_pictures(flow=True):
    """Waves that move by VELOCITY."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    velocity = np.tile(VELOCITY.astype(np.float32)[:, None, None], (1, HEIGHT, WIDTH))
    for time in times():
        x, y = columns - VELOCITY[0] * 1e-6 * (time - START), rows
        y = y - VELOCITY[1] * 1e-6 * (time - START)
        image = 127 + 60 * np.sin(x / 3) + 60 * np.cos(y / 4 + x / 9)
        yield Picture(int(time), np.round(image).astype(np.uint8), velocity if flow else None)


def write(path, events, pictures):
    path.parent.mkdir(parents=True, exist_ok=True)
    write_sequence(path, [events], pictures, height=HEIGHT, width=WIDTH)
    return path


@pytest.fixture(scope="module")
def noise(tmp_path_factory):
    """Three files of noise."""
    folder = tmp_path_factory.mktemp("noise")
    return [
        write(folder / f"{n}.h5", random_events(n), noise_pictures(n)) for n in (0, 1, 2)
    ]  # fmt: skip


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    return [write(tmp_path_factory.mktemp("moving") / "a.h5", random_events(7), moving_pictures())]


def take(files, count, **changes):
    """The first `count` batches, as numpy."""
    iterator = batches(files, **(SIZES | changes))
    taken = [jax.tree.map(np.asarray, next(iterator)) for _ in range(count)]
    iterator.close()
    return taken


def same(batch, other):
    return all(np.array_equal(a, b) for a, b in zip(batch, other, strict=True))


def patches(array):
    """(..., H, W) -> (top, left, down, across), each crop, flipped or not."""
    for top, left in np.ndindex(HEIGHT - CROP + 1, WIDTH - CROP + 1):
        patch = array[..., top : top + CROP, left : left + CROP]
        for down, across in itertools.product([False, True], repeat=2):
            yield (top, left, down, across), patch[..., :: 1 - 2 * down, :: 1 - 2 * across]


def places(images):
    """(T, S, S) images of noise -> (seed of the file, number of each image, place and flips)."""
    sources = {n: np.stack([picture.image for picture in noise_pictures(n)]) for n in (0, 1, 2)}
    images = np.round(255 * images).astype(np.uint8)
    for seed, source in sources.items():
        for place, patch in patches(source):
            ends = [np.flatnonzero((patch == image).all((1, 2))) for image in images]
            if all(len(end) == 1 for end in ends):
                return seed, np.array([int(end[0]) for end in ends]), place
    raise AssertionError("such a crop is in none of the files")


# ---- What a batch holds


@pytest.mark.parametrize(
    "augment", [NO_AUGMENT, replace(NO_AUGMENT, flip=0.5, pauses=0.4, stay=0.5)]
)
def test_batches_hold_what_slow_loops_find_in_the_files(noise, augment):
    seen, still, gaps = set(), 0, np.diff(times())
    for data in take(noise, 4, augment=augment, seed=3):
        assert data.tensors.shape == (WINDOWS, BATCH, CROP, CROP, 5)
        assert data.images.shape == data.visible.shape == (WINDOWS, BATCH, CROP, CROP)
        assert data.displacement.shape == (WINDOWS, BATCH, CROP, CROP, 2)
        assert [leaf.dtype for leaf in data] == [np.float32] * 3 + [bool]
        for b in range(BATCH):
            seed, ends, (top, left, down, across) = places(data.images[:, b])
            seen.add((seed, ends[0], top, left, down, across))
            paused = np.append(False, np.diff(ends) == 0)
            assert (np.diff(ends)[~paused[1:]] == 1).all()
            pictures, events = list(noise_pictures(seed)), random_events(seed)
            for t, end in enumerate(ends):
                tensor, moved = data.tensors[t, b], data.displacement[t, b]
                if paused[t]:
                    still += 1
                    assert not tensor.any() and not moved.any() and data.visible[t, b].all()
                    continue
                bounds = int(times()[end - 1]), int(times()[end])
                chosen = events.select((events.t >= bounds[0]) & (events.t < bounds[1]))
                expected = references.event_tensor(chosen, HEIGHT, WIDTH, bounds)
                expected = expected[top : top + CROP, left : left + CROP]
                expected = expected[:: 1 - 2 * down, :: 1 - 2 * across]
                assert np.count_nonzero(expected) > 100
                np.testing.assert_allclose(tensor, expected, atol=1e-5)

                flow = 1e-6 * gaps[end - 1] * pictures[end].flow
                dx, dy = dict(patches(flow))[top, left, down, across]
                expected = np.stack([-dx if across else dx, -dy if down else dy], -1)
                np.testing.assert_allclose(moved, expected, rtol=1e-5)
                rows, columns = np.mgrid[:CROP, :CROP]
                x, y = columns - expected[..., 0], rows - expected[..., 1]
                inside = (0 <= x) & (x <= CROP - 1) & (0 <= y) & (y <= CROP - 1)
                assert (data.visible[t, b] == inside).mean() > 0.999  # rounding at the border
    assert {seed for seed, *_ in seen} == {0, 1, 2} and len(seen) == 4 * BATCH
    flips = {place[-2:] for place in seen}
    assert len(flips) == (4 if augment.flip else 1) and bool(still) == bool(augment.pauses)


@pytest.mark.parametrize("flip", [0.0, 0.5])
def test_the_displacement_warps_each_image_onto_the_next(moving, flip):
    data = take(moving, 2, augment=replace(NO_AUGMENT, flip=flip), batch=6)[1]
    warped, _ = warp(data.images[:-1], data.displacement[1:])
    visible = data.visible[1:]
    errors = np.abs(np.asarray(warped) - data.images[1:])[visible]
    assert 0.7 < visible.mean() < 1 and errors.max() < 0.02
    unmoved = np.abs(data.images[:-1] - data.images[1:])[visible]
    assert np.mean(unmoved) > 8 * np.mean(errors)
    signs = {tuple(np.sign(d)) for d in data.displacement[0, :, 0, 0]}
    assert signs == ({(1, -1)} if not flip else set(itertools.product((1, -1), repeat=2)))


def test_pauses_are_as_often_and_as_long_as_asked():
    rng = np.random.default_rng(0)
    paused = np.stack([_pauses(rng.random(60), Augment()) for _ in range(3000)])
    assert not paused[:, 0].any()
    before, after = paused[:, :-1], paused[:, 1:]
    assert after[~before].mean() == pytest.approx(0.05, abs=0.003)
    assert after[before].mean() == pytest.approx(0.9, abs=0.005)


def test_hot_pixels_stay_and_noise_does_not(noise):
    bare, hot, noisy = (
        take(noise, 3, chain=2, augment=augment)
        for augment in (
            NO_AUGMENT,
            replace(NO_AUGMENT, hot_pixels=0.5),
            replace(NO_AUGMENT, voxel_noise=0.1),
        )
    )
    added = [b.tensors - a.tensors for a, b in zip(bare, hot, strict=True)]
    values = added[0][0, :, :, :, 0]  # (B, S, S)
    for part in added[:2]:  # all windows and bins of a chain
        np.testing.assert_allclose(part, np.broadcast_to(values[None, ..., None], part.shape),
                                   atol=1e-5)  # fmt: skip
    assert not np.allclose(added[2][0, ..., 0], values, atol=1e-3)  # the next chain
    shares = (np.abs(values) > 1e-5).mean((1, 2))
    assert (shares < 0.55).all() and shares.max() > 0.05 and len(set(shares)) == BATCH
    assert np.ptp(shares) > 0.2  # drawn for each sequence: of one share they differ by about 0.05
    drawn = values[np.abs(values) > 1e-5]
    assert drawn.std() == pytest.approx(1, abs=0.2) and abs(drawn.mean()) < 0.2
    added = np.stack([b.tensors - a.tensors for a, b in zip(bare, noisy, strict=True)])
    assert added.std() == pytest.approx(0.1, rel=0.02) and abs(added.mean()) < 0.002
    flat = added.reshape(-1, CROP * CROP * 5)
    assert np.abs(np.corrcoef(flat) - np.eye(len(flat))).max() < 0.2
    for a, b, c in zip(bare, hot, noisy, strict=True):
        assert same(a[1:], b[1:]) and same(a[1:], c[1:])


def test_a_chain_goes_on_where_its_last_part_ended(noise):
    pausing = replace(NO_AUGMENT, flip=0.5, pauses=0.3, stay=0.5)
    parts = take(noise, 6, chain=3, augment=pausing, seed=1)
    for chain in (parts[:3], parts[3:]):
        for b in range(BATCH):
            images = np.concatenate([part.images[:, b] for part in chain])
            _, ends, _ = places(images)  # in one file, at one place, flipped one way
            assert set(np.diff(ends)) <= {0, 1}
    whole = take(noise, 1, windows=3 * WINDOWS, augment=pausing, seed=1)[0]
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts[:3])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), whole, joined)


def test_each_file_has_its_turn_in_every_pass(noise):
    for data in take(noise, 3, windows=IMAGES - 1, augment=NO_AUGMENT):
        found = sorted(places(data.images[:, b])[0] for b in range(BATCH))
        assert found == [0, 1, 2]


def test_without_flow_nothing_is_visible_but_in_pauses(tmp_path):
    file = write(tmp_path / "a.h5", random_events(0), moving_pictures(flow=False))
    data = take([file], 2, augment=replace(NO_AUGMENT, pauses=0.5))[1]
    assert not data.displacement.any()
    np.testing.assert_array_equal(data.visible.any((2, 3)), ~data.tensors.any((2, 3, 4)))
    assert data.visible.any()


def test_a_window_without_events_and_a_file_without_any(tmp_path):
    file = write(tmp_path / "a.h5", Events.empty(), moving_pictures())
    data = take([file], 1, augment=NO_AUGMENT)[0]
    assert not data.tensors.any() and data.images.any() and data.visible.any()


def test_events_of_another_clock_than_the_images_are_said(tmp_path):
    later = random_events(0)
    later = Events(later.t + 10**9, later.x, later.y, later.p)
    file = write(tmp_path / "a.h5", later, moving_pictures())
    assert "none of its 4,000 events is between its images" in refused(file)


def test_images_are_in_the_order_of_their_numbers(tmp_path, noise):
    """`image10` comes after `image2`, though its name sorts before."""
    path = tmp_path / "a.h5"
    path.write_bytes(noise[0].read_bytes())
    with h5py.File(path, "r+") as file:
        for kind in ("image", "flow"):
            folder = file["images" if kind == "image" else kind]
            for name in list(folder):
                folder.move(name, f"{kind}{int(name.removeprefix(kind))}")
    for found, expected in zip(take([path], 3), take(noise[:1], 3), strict=True):
        assert same(found, expected)


def test_a_further_batch_compiles_nothing(noise):
    _simulation.clear_cache()
    take(noise, 4)
    assert _simulation._cache_size() == 1


@pytest.mark.slow
def test_sets_that_firenet_simulates(tmp_path, monkeypatch):
    textures = load_textures(count=2, size=32, procedural=1.0)
    monkeypatch.setattr(dataset, "_textures", lambda *_: textures)
    dataset.run(Simulate(tmp_path / "set", sequences=2, validation=1, seconds=0.3,
                         sensor_size="24x20"))  # fmt: skip
    training, _ = split(tmp_path / "set")
    for data in take(training, 4, augment=NO_AUGMENT):
        assert data.tensors.any() and 0 <= data.images.min() < data.images.max() <= 1
        warped, _ = warp(data.images[:-1], data.displacement[1:])
        errors = np.abs(np.asarray(warped) - data.images[1:])[data.visible[1:]]
        assert np.median(errors) < 0.02


# ---- The same again


def test_a_batch_depends_on_seed_and_number_alone(noise):
    faulty = Augment(hot_pixels=0.1, voxel_noise=0.1)
    run = take(noise, 5, augment=faulty, seed=5)
    again = take(noise, 2, augment=faulty, seed=5, first=3)
    assert same(run[3], again[0]) and same(run[4], again[1])
    assert not same(run[0], run[1])
    assert not same(run[0], take(noise, 1, augment=faulty, seed=6)[0])


def test_an_iterator_goes_on_from_its_state(noise):
    iterator = batches(noise, **SIZES, chain=2, seed=2)
    for _ in range(3):
        next(iterator)
    state = json.loads(json.dumps(iterator.get_state()))
    expected = [next(iterator) for _ in range(3)]
    other = batches(noise, **SIZES, chain=2, seed=2)
    other.set_state(state)
    assert all(same(next(other), batch) for batch in expected)
    iterator.close()
    other.close()


# ---- Folders


def test_split_keeps_to_the_folders_of_a_simulated_set(tmp_path):
    for name in ("train/0.h5", "train/1.HDF5", "validation/0.h5", "train/2.partial.h5", "a.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    training, validation = split(tmp_path)
    assert training == [tmp_path / "train/0.h5", tmp_path / "train/1.HDF5"]
    assert validation == [tmp_path / "validation/0.h5"]


def test_split_of_other_folders_depends_on_names_alone(tmp_path):
    for folder in ("a", "b"):
        for number in range(60):
            (tmp_path / folder / "deep").mkdir(parents=True, exist_ok=True)
            (tmp_path / folder / f"deep/{number}.h5").touch()
    (training, validation), (_, others) = split(tmp_path / "a"), split(tmp_path / "b")
    assert len(validation) == 3 and sorted(training + validation) == find(tmp_path / "a")
    assert [path.name for path in validation] == [path.name for path in others]


# ---- What is wrong


def refused(path, **changes):
    with pytest.raises(RecordingError) as caught:
        take([path], 1, **changes)
    message = str(caught.value)
    assert str(path) in message and "\n" not in message
    return message


def test_folders_that_cannot_be_used_are_said(tmp_path):
    for folder, expected in ((tmp_path / "missing", "no such folder"), (tmp_path, "holds no .h5")):
        with pytest.raises(RecordingError, match=f"{folder}: .*{expected}"):
            split(folder)
    (tmp_path / "a.h5").touch()
    with pytest.raises(RecordingError, match="no sequence for training"):
        split(tmp_path)


def test_files_that_cannot_be_used_are_said(tmp_path, noise):
    file = write(tmp_path / "none.h5", random_events(0), [])
    assert "holds 0 images" in refused(file)
    assert "fewer than the crop of 21x21: choose a smaller" in refused(noise[0], crop=21)
    assert "has 13 images" in refused(noise[0], windows=IMAGES)
    (tmp_path / "text.h5").write_text("no HDF5 at all")
    assert "cannot be read" in refused(tmp_path / "text.h5")
    assert "there is no such file: copy" in refused(tmp_path / "missing.h5")


def instead(file: h5py.File, name: str):
    """A type where an array or a group is expected."""
    del file[name]
    file[name] = np.dtype("f8")


def elsewhere(file: h5py.File, name: str):
    """Its values in another file, which whoever made this one chooses."""
    shape, kind = file[name].shape, file[name].dtype
    attributes = dict(file[name].attrs)
    del file[name]
    kept = file.create_dataset(name, shape, kind, external=[("other", 0, h5py.h5f.UNLIMITED)])
    kept.attrs.update(attributes)


@pytest.mark.parametrize(
    "damage, expected",
    [
        (lambda f: elsewhere(f, "events/xs"), "events/xs is stored in other files"),
        (lambda f: elsewhere(f, "images/image000000003"), "is stored in other files"),
        (lambda f: elsewhere(f, "flow/flow000000003"), "is stored in other files"),
        (lambda f: f.__delitem__("events/xs"), "cannot be read"),
        (lambda f: instead(f, "images"), "cannot be read"),
        (lambda f: instead(f, "images/image000000000"), "cannot be read"),
        (lambda f: instead(f, "events/ts"), "cannot be read"),
        (lambda f: f["events/xs"].write_direct(np.full(4000, 99, np.int16)), "x is 99, outside"),
        (lambda f: f["events/xs"].__setitem__(1500, 99), "event 1501: x is 99, outside"),
        (lambda f: f["events/ts"].write_direct(f["events/ts"][:][::-1].copy()), "runs backwards"),
        (lambda f: f["events/ts"].__setitem__(7, np.nan), "event 8: the time is nan"),
        (lambda f: f["images/image000000003"].attrs.update(timestamp=0.0), "image 3: its time"),
        (lambda f: f.attrs.update(sensor_resolution=[10, 12]), "24x20 pixels, its events 12x10"),
        (lambda f: f.attrs.update(sensor_resolution=[31]), "sensor_resolution has 1 number, exp"),
        (lambda f: f.attrs.update(sensor_resolution=[]), "sensor_resolution has 0 numbers, exp"),
    ],
)
def test_damage_is_said(tmp_path, damage, expected):
    path = write(tmp_path / "a.h5", random_events(0), noise_pictures(0))
    with h5py.File(path, "r+") as file:
        damage(file)
    assert expected in refused(path, windows=IMAGES - 1)


def test_a_compression_that_h5py_lacks_is_said(noise, monkeypatch):
    """As for recordings: with hdf5plugin it is read, without it is named."""
    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda number: False)
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    assert 'hdf5plugin: in the source folder, pip install ".[formats]"' in refused(noise[0])


def read_small(path, data):
    assert data.size < 1e6
    return data[()]


def test_pictures_that_claim_to_be_huge_are_not_read(tmp_path, monkeypatch):
    """A few bytes of a compressed file can stand for gigabytes."""
    for name, shape in (("images/image", (30_000, 30_000)), ("flow/flow", (2, 30_000, 30_000))):
        path = write(tmp_path / "a.h5", random_events(0), noise_pictures(0))
        with h5py.File(path, "r+") as file:
            attributes = dict(file[f"{name}000000007"].attrs)
            del file[f"{name}000000007"]
            chunks = (1, 1000, 1000)[-len(shape) :]
            made = file.create_dataset(f"{name}000000007", shape, "u1", chunks=chunks)
            made.attrs.update(attributes)
        monkeypatch.setattr("firenet_jax.training.batches._whole", read_small)
        message = refused(path, windows=IMAGES - 1, augment=NO_AUGMENT)
        assert "000000007: has the shape" in message and "30000" in message


def test_pictures_and_flow_of_other_sizes_are_said(tmp_path):
    for name, expected in (("images/image", "(20, 24)"), ("flow/flow", "(2, 20, 24)")):
        path = write(tmp_path / "a.h5", random_events(0), noise_pictures(0))
        with h5py.File(path, "r+") as file:
            whole = file[f"{name}000000007"]
            attributes, values = dict(whole.attrs), whole[..., 1:]
            del file[f"{name}000000007"]
            file.create_dataset(f"{name}000000007", data=values).attrs.update(attributes)
        message = refused(path, windows=IMAGES - 1, augment=NO_AUGMENT)
        assert "000000007: has the shape" in message and expected in message


def test_short_files_are_left_out_with_a_warning(tmp_path, noise, caplog):
    short = write(tmp_path / "a.h5", random_events(0), itertools.islice(noise_pictures(0), 4))
    take([short, *noise], 1)
    assert "1 of 4 files are left out: they have fewer than 5 images" in caplog.text
    refused(short)


@pytest.mark.parametrize(
    "wrong", [{"flip": 1.1}, {"stay": -0.1}, {"voxel_noise": -1}, {"hot_pixels": np.nan}]
)
def test_settings_that_cannot_be_are_said(wrong):
    with pytest.raises(ValueError, match=f"{next(iter(wrong))} is"):
        Augment(**wrong)


def test_crops_and_windows_reach_to_the_end(noise):
    assert take(noise, 1, crop=HEIGHT)[0].images.shape[2:] == (HEIGHT, HEIGHT)
    first = {
        int(places(data.images[:, b])[1][0])
        for data in take(noise, 4, windows=IMAGES - 2, augment=NO_AUGMENT)
        for b in range(BATCH)
    }
    assert first == {1, 2}


def test_long_files_have_as_many_turns_as_they_have_windows_for(tmp_path, noise):
    pictures = itertools.islice(noise_pictures(1), WINDOWS + 1)
    short = write(tmp_path / "short.h5", random_events(1), pictures)
    for data in take([noise[0], short], 2, batch=4, augment=NO_AUGMENT):  # 12 and 4 windows
        assert sorted(places(data.images[:, b])[0] for b in range(4)) == [0, 0, 0, 1]
