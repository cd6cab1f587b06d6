"""Simulated sequences, files of them, or recordings with frames -> weights: `firenet train`.

The settings are `training.settings.Train`.
"""

from firenet_jax.devices import process_of
from firenet_jax.errors import SettingsError
from firenet_jax.training import recordings
from firenet_jax.training import run as training
from firenet_jax.training.settings import Train

__all__ = ["Train", "run"]


def run(settings: Train) -> None:
    """Trains as the settings say; on recordings, says how well it did on their ends.

    Raises a FirenetError with a message of one sentence."""
    if settings.on_recordings:
        if process_of(settings.process, settings.processes)[1] > 1:  # a launcher's, too
            raise SettingsError(
                "recordings are trained on by one process: make sequences of them with one, then "
                f"name {settings.sequences} as --data"
            )
        cuts = [recordings.cut_off(path, settings.windows) for path in settings.data]
        recordings.check_fit(cuts, settings)
        training.run(settings, prepare=lambda: recordings.write_sequences(cuts, settings))
        recordings.print_scores(cuts, settings)
    else:
        training.run(settings)
