"""A command line -> settings of a training run: data, optimisation, logging.

`Train.step_settings` is the part that is static in the compiled step: without paths, so that a run
into another folder does not recompile.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from firenet_jax.devices import check_processes
from firenet_jax.errors import SettingsError
from firenet_jax.evaluation import metrics
from firenet_jax.settings import check_none_idle, check_range, check_seed, check_share, check_sizes
from firenet_jax.simulation.curricula import LONGEST_WINDOW, check_motion, check_rare
from firenet_jax.simulation.scenes import SceneSettings
from firenet_jax.simulation.sensor import FAULTY, SensorSettings, check_idle
from firenet_jax.training.batches import Augment, is_set
from firenet_jax.training.losses import DISTANCES, Loss
from firenet_jax.training.step import StepSettings

Part = Literal[
    "head", "gru1", "gru1.gates", "gru1.candidate", "res1",
    "gru2", "gru2.gates", "gru2.candidate", "res2", "prediction",
]  # fmt: skip
SIMULATED = (  # settings of sequences that are simulated
    "images", "textures", "procedural", "renderings", "motion", "slow", "swift", "to_and_fro",
    "scene", "sensor",
)  # fmt: skip


@dataclass(frozen=True)
class Train:
    """Train FireNet on sequences simulated on the fly, on files, or on recordings with frames.

    Examples:
      firenet train -o run
      firenet train -o run --images coco/train2017 --steps 100000
      firenet simulate -o set --sequences 1000  and then  firenet train -o run --data set
      firenet train -o tuned --weights built-in --learning-rate 1e-4
      firenet train -o tuned --weights built-in --learning-rate 1e-4 --data davis.aedat4
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder of the run; an interrupted run in it is resumed."""
    weights: Annotated[Path | None, tyro.conf.arg(aliases=["-c"])] = None
    """Start from these weights instead of random ones; built-in: those of the package."""
    data: tuple[Path, ...] = ()
    """Instead of simulating: a folder of HDF5 sequences (`firenet simulate`, or a data set), or
    recordings with frames, whose ends are held out."""
    images: Path | None = None
    """Folder of pictures for textures, at least 128 pixels on a side (default: scikit-image's
    photographs and procedural textures)."""
    textures: int = 256
    """Number of textures."""
    procedural: float = 0.25
    """Share of the textures that is procedural."""
    steps: int = 20_000
    """Updates of the parameters. With a larger number a finished run is extended."""
    batch: int = 2
    """Sequences per step."""
    crop: int = 96
    """Height and width of the sequences, in pixels."""
    windows: int = 21
    """Windows per step: more than --l0 and at most --L + 1 (11 to 21 with the defaults)."""
    chain: int = 1
    """Truncated back-propagation through time: carry the state through up to this many steps.
    Simulated sequences of a batch differ in length (64, batch 4: 3, 8, 23, 64)."""
    renderings: int = 5
    """Greatest number of renderings per window; on a CPU, slow windows get fewer. A pixel has at
    most one noise event between two renderings, so stronger --noise is cut off there."""
    motion: tuple[float, float] = (1.25, 2.5)
    """Pixels by which the fastest point moves in a window, at most one per rendering; drawn
    log-uniformly for each sequence."""
    slow: float = 0.0
    """Share of the sequences with hardly any motion; they have more threshold mismatch, and most of
    them hardly any noise."""
    swift: float = 0.0
    """Share of the sequences with very fast motion, 16 to 90 pixels per window, over a plain
    background."""
    to_and_fro: float = 0.0
    """Share of the simulated sequences in which every step of a chain shows the same windows
    forward and then backward (time reversed, polarity inverted), to teach the network to retain
    what it has seen. Needs an even number of windows."""
    learning_rate: float = 1e-3
    """Peak learning rate, after the warm-up; it then decays to a hundredth along a cosine."""
    warmup: int | None = None
    """Steps of the linear warm-up. Default: 200, at most a fifth of the run."""
    optimiser: Literal["muon", "centred", "adam"] = "muon"
    """muon learns more per step (experiments/compare_optimisers.py); the paper used adam. With
    centred, muon too, no channel dies at a high rate. The learning rate has the same scale for all:
    the size of an update."""
    clip: float = 1.0
    """Clip gradients to this norm."""
    frozen: tuple[Part, ...] = ()
    """Parts of the network that keep the weights they start from."""
    seed: int = 0
    """Random seed of the initial parameters, the textures and the sequences."""
    bfloat16: bool = False
    """Compute convolutions in bfloat16. For accelerators; slower on a CPU."""
    remat: bool = False
    """Recompute convolutions for the gradient: less memory, slightly slower."""
    log_every: int = 20
    """Steps between two lines of the log."""
    validate_every: int = 500
    """Steps between two validations."""
    save_every: float = 120.0
    """Seconds between two checkpoints, which are saved after a line of the log."""
    coordinator: str | None = None
    """host:port of process 0, the same for all of several processes that train together. Not needed
    under srun and Open MPI 4."""
    processes: int | None = None
    """Number of processes."""
    process: int | None = None
    """Index of this process, from 0."""
    near_events: bool = False
    """For a static camera: where there were no events nearby since a sequence began, the truth is
    the frame's mean brightness."""
    loss: Loss = Loss()
    augment: Augment = Augment()
    """Augmentation of sequences from files."""
    scene: SceneSettings = SceneSettings()
    sensor: SensorSettings = dataclasses.replace(FAULTY, threshold_range=(0.1, 0.6))

    def __post_init__(self):
        check_sizes(self, "textures", "steps", "batch", "crop", "chain", "renderings")
        check_sizes(self, "learning_rate", "clip", "log_every", "validate_every")
        if not self.loss.l0 < self.windows <= self.loss.L + 1:
            raise SettingsError(
                f"windows is {self.windows}, but must be more than --l0 ({self.loss.l0}) and at "
                f"most --L + 1 ({self.loss.L + 1})"
            )
        if not any(getattr(self.loss, name) for name in DISTANCES):
            raise SettingsError(f"no distance has a weight: pass one of {', '.join(DISTANCES)}")
        if self.crop < metrics.WINDOW:
            raise SettingsError(
                f"crop is {self.crop} pixels, but images smaller than {metrics.WINDOW} cannot be "
                "judged"
            )
        _check_idle(self)
        if not self.data:
            check_idle(self.sensor)
        check_range("motion", self.motion)
        _check_step(self)
        check_rare(self.slow, self.swift)
        check_share("to_and_fro", self.to_and_fro, "sequences")
        if self.to_and_fro and self.windows % 2:
            raise SettingsError(
                f"windows is {self.windows}, but as many lead to and fro: choose an even number"
            )
        check_seed(self.seed)
        if self.near_events and self.data and self.augment.voxel_noise:
            raise SettingsError(
                "--near-events has no effect beside --voxel-noise, which looks like events "
                "everywhere: leave one out"
            )
        if not self.save_every >= 0:
            raise SettingsError(f"save_every is {self.save_every} seconds, but must be 0 or more")
        check_share("procedural", self.procedural, "textures")
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
        """The folder of HDF5 sequences, given or made from recordings; `data` is not empty."""
        return self.output / "sequences" if self.on_recordings else self.data[0]

    @property
    def step_settings(self) -> StepSettings:
        """The settings that a training step depends on."""
        names = {field.name for field in dataclasses.fields(StepSettings)}
        chosen: dict[str, Any] = {name: getattr(self, name) for name in names}
        chosen["warmup"] = warming_up(self)
        return StepSettings(**chosen)


def _check_idle(settings: Train) -> None:
    """Raises SettingsError for what would have no effect on this kind of data."""
    if settings.data:
        check_none_idle(settings, SIMULATED, "training on sequences from --data")
    else:
        check_none_idle(settings, ["augment"], "training on simulated sequences")
        if settings.procedural == 1:
            check_none_idle(settings, ["images"], "training on procedural textures alone")


def _check_step(settings: Train) -> None:
    """Raises SettingsError for what the first step would, when a folder already is of this run."""
    crop, chain, windows = settings.crop, settings.chain, settings.windows
    if settings.loss.cw_ssim and crop < metrics.CW_SSIM_SIDE:
        raise SettingsError(
            f"crop is {crop} pixels, but --cw-ssim needs {metrics.CW_SSIM_SIDE} or more"
        )
    if settings.data:
        return
    check_motion(settings.motion, settings.renderings)
    longest = int(2**31 / LONGEST_WINDOW)  # times of a sequence are int32 microseconds
    if chain * windows > longest:
        raise SettingsError(
            f"chain is {chain} steps of {windows} windows, but a simulated sequence has at most "
            f"{longest} windows: choose a shorter --chain"
        )


def warming_up(settings: Train) -> int:
    """Steps of the warm-up."""
    return min(200, settings.steps // 5) if settings.warmup is None else settings.warmup
