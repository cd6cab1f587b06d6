"""Images, ground truths, optical flow -> loss: Eq. 2 of the paper over a sequence.

Scheerlinck et al., "Fast Image Reconstruction with an Event Camera", WACV 2020:

    loss = sum_{k=0..L} L_R(k) + lambda_TC sum_{k=L0..L} L_TC(k)

The loss is summed over the images of a sequence and averaged over the batch. L_TC is
`metrics.temporal_error`. In the paper L_R is LPIPS, which needs a pretrained network. Here it is a
weighted sum of distances that need none, by default about as large as LPIPS of a good
reconstruction (0.4 to 0.5), so that lambda_TC has the same meaning.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from firenet_jax.evaluation import metrics
from firenet_jax.settings import check_sizes


@dataclass(frozen=True)
class Loss:
    """The weights of Eq. 2; a term of weight 0 is not computed.

    The default did best in experiments/compare_losses.py.
    gmsd, haarpsi, cw_ssim and contrast cannot tell an image from its negative: never use them
    alone.
    """

    l1: float = 1.0
    """Mean absolute difference."""
    centred: float = 0.0
    """Mean absolute difference after subtracting each image's mean: events carry no absolute
    brightness, so an offset is not penalised."""
    contrast: float = 0.0
    """Difference of the standard deviations; invariant to inverted contrast."""
    nlpd: float = 0.5
    """Normalised Laplacian pyramid distance."""
    ssim: float = 0.0
    """1 - SSIM."""
    ms_ssim: float = 0.0
    """1 - MS-SSIM."""
    gmsd: float = 0.0
    """Gradient magnitude similarity deviation; invariant to inverted contrast."""
    haarpsi: float = 0.5
    """1 - HaarPSI; invariant to inverted contrast."""
    cw_ssim: float = 0.0
    """1 - complex wavelet SSIM; invariant to inverted contrast."""
    equalised: float = 0.0
    """1 - SSIM after a soft histogram equalisation."""
    equalised_mse: float = 0.0
    """Mean squared difference after a soft histogram equalisation."""
    detail: float = 0.0
    """Difference of the local contrast of fine detail, only for images after hardly any motion,
    where the other distances prefer blur to slightly misplaced edges. Invariant to inverted
    contrast."""
    random_features: float = 0.0
    """Distance between the features of a random network."""
    lambda_tc: float = 2.0
    """Weight of the temporal consistency."""
    l0: int = 10
    """First image, counted from 0, whose temporal consistency counts, as the state must warm up
    first; 0 if the state is warm from the start."""
    L: int = 20
    """Last image of a sequence, counted from 0."""

    def __post_init__(self):
        check_sizes(self, *DISTANCES, "detail", "lambda_tc", "l0", "L", zero=True)


MAX_STILL_MOTION = 0.3  # pixels: `detail` counts for images after less motion than this
DISTANCES = {
    "l1": metrics.l1,
    "centred": metrics.centred,
    "contrast": metrics.contrast,
    "nlpd": metrics.nlpd,
    "ssim": lambda image, truth: 1 - metrics.ssim(image, truth),
    "ms_ssim": lambda image, truth: 1 - metrics.ms_ssim(image, truth),
    "gmsd": metrics.gmsd,
    "haarpsi": lambda image, truth: 1 - metrics.haarpsi(image, truth),
    "cw_ssim": lambda image, truth: 1 - metrics.cw_ssim(image, truth),
    "equalised": lambda image, truth: 1 - metrics.equalised_ssim(image, truth),
    "equalised_mse": metrics.equalised_mse,
    "random_features": metrics.random_features,
}


def reconstruction_loss(
    images: jax.Array, truths: jax.Array, settings: Loss = Loss()
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """L_R of every image: (..., H, W), (..., H, W) -> (...,), and its terms (...,) unweighted."""
    weights = {name: getattr(settings, name) for name in DISTANCES}
    terms = {name: DISTANCES[name](images, truths) for name in DISTANCES if weights[name]}
    loss = sum((weights[name] * term for name, term in terms.items()), jnp.zeros(images.shape[:-2]))
    return loss, terms


def sequence_loss(
    images: jax.Array,
    truths: jax.Array,
    displacements: jax.Array,
    visible: jax.Array,
    settings: Loss = Loss(),
    warm: jax.Array | bool = False,
    mean: Callable[[jax.Array], jax.Array] = lambda each: each,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Eq. 2 for T images in time order, T at most L + 1 -> (loss, its terms).

    images, truths: (T, B, H, W), image k is from the time of truth k, that of the last event.
    displacements: (T, B, H, W, 2) pixels, x then y, from image k-1 to k on the grid of k.
    visible: (T, B, H, W) bool, False where image k shows what image k-1 did not.
    Only `detail` uses displacements[0] and visible[0], as image 0 has no predecessor here.
    warm: () or (B,) bool, whether the state was warm before image 0, so that l0 does not apply.
    mean: of a number over the devices that share the sequences. What is returned is of this one.

    loss: scalar. Terms: scalars, unweighted means over batch and images (for "temporal" over those
    that count), so that different lengths are comparable; "reconstruction" is the mean of L_R:

        loss = T reconstruction + lambda_TC (T - max(l0, 1)) temporal
    """
    steps = len(images)
    if steps > settings.L + 1:
        raise ValueError(
            f"a sequence of {steps} images is longer than the L + 1 = {settings.L + 1} of the loss"
        )
    per_image, terms = reconstruction_loss(images, truths, settings)
    if settings.detail:
        moved = jnp.where(visible, jnp.abs(displacements).max(-1), 0.0).max((-2, -1))
        still = (moved < MAX_STILL_MOTION) & visible.any((-2, -1))  # else its motion is not known
        terms["detail"] = jnp.where(still, metrics.detail(images, truths), 0.0)
        per_image += settings.detail * terms["detail"]
    terms = {"reconstruction": per_image, **terms}
    loss = per_image.sum(0).mean()

    # If `warm` is traced, all errors are computed and those that do not count are masked.
    known = isinstance(warm, bool)
    first = max(settings.l0, 1) if known and not warm else 1
    if settings.lambda_tc and first < steps:
        now, before = slice(first, None), slice(first - 1, -1)
        errors = metrics.temporal_error(
            images[now],
            images[before],
            displacements[now],
            truths[now],
            truths[before],
            visible[now],
        )  # (T - first, B)
        counted = jnp.ones(errors.shape)
        if not known:
            warm = jnp.broadcast_to(warm, errors.shape)
            late = (jnp.arange(first, steps) >= settings.l0)[:, None]
            counted = jnp.where(warm, True, jnp.broadcast_to(late, errors.shape)).astype(float)
        total = (counted * errors).sum(0).mean()
        loss += settings.lambda_tc * total
        number = mean(counted.sum(0).mean())  # of a sequence's images, which may be less than one
        terms["temporal"] = total / jnp.where(number > 0, number, 1.0)
    return loss, {name: term.mean() for name, term in terms.items()}
