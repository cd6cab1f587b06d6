"""A command line -> settings of a training run: what it learns from, how, and how it is looked at.

`Train.step_settings` is the part that a compiled step sees: no paths, so that a run into another
folder compiles nothing anew.
"""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from firenet_jax.devices import check_processes
from firenet_jax.errors import SettingsError
from firenet_jax.settings import check_range, check_seed
from firenet_jax.simulation.scenes import SceneSettings
from firenet_jax.simulation.sensor import FAULTY, SensorSettings, check_rare
from firenet_jax.training.batches import Augment, is_set
from firenet_jax.training.losses import DISTANCES, Loss
from firenet_jax.training.step import StepSettings

MIN_CROP = 11  # pixels on a side of what validation measures: SSIM's window


@dataclass(frozen=True)
class Train:
    """Train FireNet on sequences that are simulated as it goes.

    Examples:
      firenet train -o run
      firenet train -o run --images coco/train2017 --steps 100000
      firenet simulate -o set --sequences 1000  and then  firenet train -o run --data set
      firenet train -o tuned --weights built-in --learning-rate 1e-4
      firenet train -o tuned --weights built-in --learning-rate 1e-4 --data davis.aedat4
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder of the run; an interrupted run in it goes on."""
    weights: Annotated[Path | None, tyro.conf.arg(aliases=["-c"])] = None
    """Start from these weights instead of random ones; built-in: those of the package."""
    data: tuple[Path, ...] = ()
    """A folder of HDF5 sequences (`firenet simulate`, or downloaded), or recordings with frames,
    whose ends are held out: instead of simulating as it goes."""
    images: Path | None = None
    """Folder of pictures for textures (default: scikit-image's photographs, and drawn ones)."""
    textures: int = 256
    """How many textures to cut from them."""
    procedural: float = 0.25
    """Part of the textures that is drawn instead."""
    steps: int = 20_000
    """Updates of the parameters. A run that is done goes on when it is given more."""
    batch: int = 2
    """Sequences in a step."""
    crop: int = 96
    """Height and width of the sequences, in pixels."""
    windows: int = 21
    """Windows in a step, L + 1 in the paper."""
    chain: int = 1
    """Steps through which the longest sequence of a batch goes on, its state carried from one to
    the next; the others are shorter, in equal proportions (64 with 4 sequences: 3, 8, 23, 64)."""
    renderings: int = 5
    """Renderings in a window."""
    motion: tuple[float, float] = (1.25, 2.5)
    """Pixels by which the fastest point moves in a window, at most one for a rendering; drawn
    log-uniformly for a sequence."""
    slow: float = 0.0
    """Part of the sequences in which next to nothing moves: there the thresholds of pixels differ
    more, and most have next to no noise."""
    swift: float = 0.0
    """Part of the sequences in which 16 to 90 pixels pass in a window, before a blank ground."""
    learning_rate: float = 1e-3
    """Greatest rate, after warming up; it then falls to a hundredth along a cosine."""
    warmup: int = 200
    """Steps in which the rate rises from zero; fewer in a run so short that they would be more than
    a fifth of it."""
    optimiser: Literal["muon", "adam"] = "muon"
    """muon learns more from a step (experiments/compare_optimisers.py); adam is the paper's. A
    rate means the same for both: the size of an update."""
    clip: float = 1.0
    """Gradients are scaled down to this norm."""
    seed: int = 0
    """Of the first parameters, the textures and all sequences."""
    bfloat16: bool = False
    """Convolutions in bfloat16: for accelerators; on a CPU it is slower."""
    remat: bool = False
    """Compute convolutions again for the gradient: less memory, a little more time."""
    log_every: int = 20
    """Steps between two lines of the log."""
    validate_every: int = 500
    """Steps between two validations."""
    save_every: float = 120.0
    """Seconds between two checkpoints, which are made after a line of the log."""
    coordinator: str | None = None
    """host:port of process 0, where several processes train together; start each with this. Those
    that srun or Open MPI 4 has started find each other."""
    processes: int | None = None
    """How many processes."""
    process: int | None = None
    """Which one this is, from 0."""
    near_events: bool = False
    """Where no events were nearby since a sequence began, the truth is a frame's mean brightness:
    more cannot be known there. For a camera that stands still."""
    loss: Loss = Loss()
    augment: Augment = Augment()
    """What happens to sequences from files."""
    scene: SceneSettings = SceneSettings()
    sensor: SensorSettings = dataclasses.replace(FAULTY, threshold_range=(0.1, 0.6))

    def __post_init__(self):
        positive = (
            "textures",
            "steps",
            "batch",
            "crop",
            "chain",
            "renderings",
            "learning_rate",
            "clip",
            "log_every",
            "validate_every",
        )
        for name in positive:
            if not 0 < getattr(self, name) < math.inf:
                raise SettingsError(f"{name} is {getattr(self, name)}, but must be more than 0")
        if not self.loss.l0 < self.windows <= self.loss.L + 1:
            raise SettingsError(
                f"windows is {self.windows}, but the loss is over more than {self.loss.l0} and at "
                f"most {self.loss.L + 1} of them"
            )
        if not any(getattr(self.loss, name) for name in DISTANCES):
            raise SettingsError(f"no distance has a weight: pass one of {', '.join(DISTANCES)}")
        if self.crop < MIN_CROP:
            raise SettingsError(
                f"crop is {self.crop} pixels, but images smaller than {MIN_CROP} cannot be judged"
            )
        check_range("motion", self.motion)
        check_rare(self.slow, self.swift)
        check_seed(self.seed)
        if not self.save_every >= 0:
            raise SettingsError(f"save_every is {self.save_every} seconds, but must be 0 or more")
        if not 0 <= self.procedural <= 1:
            raise SettingsError(
                f"procedural is {self.procedural}, but is a part of the textures, 0-1"
            )
        if not 0 <= warming_up(self) < self.steps:
            raise SettingsError(
                f"warmup is {self.warmup} steps of {self.steps}: use 0 or more, fewer"
            )
        check_processes(self.coordinator, self.processes, self.process)

    @property
    def on_recordings(self) -> bool:
        """Whether `data` are recordings with frames."""
        return bool(self.data) and not (len(self.data) == 1 and is_set(self.data[0]))

    @property
    def sequences(self) -> Path:
        """Where the HDF5 sequences are, or those made of recordings: `data` is not empty."""
        return self.output / "sequences" if self.on_recordings else self.data[0]

    @property
    def step_settings(self) -> StepSettings:
        """What a step of the training depends on, apart from its data."""
        names = {field.name for field in dataclasses.fields(StepSettings)}
        chosen: dict[str, Any] = {name: getattr(self, name) for name in names}
        chosen["warmup"] = warming_up(self)
        return StepSettings(**chosen)


def warming_up(settings: Train) -> int:
    """Steps: what was asked for, or at most a fifth of a run where nothing was."""
    asked = settings.warmup != Train.warmup
    return settings.warmup if asked else min(settings.warmup, settings.steps // 5)
