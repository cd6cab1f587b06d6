"""FireNet in PyTorch, events to picture and training: the other side of `xla_vs_pytorch.py`.

The same functions as in the package, in the order of memory that PyTorch prefers: event tensors
are (B, 5, H, W), images (B, H, W), those of a sequence (T, B, ...). As quick as we could write it
without a compiler; `separate_gates` and `voxelise_original` are how the field's programs do it.
"""

from functools import lru_cache, partial

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from firenet_jax.evaluation.metrics import NLPD_BANDS, NLPD_FARTHER, PYRAMID
from firenet_jax.events import Events
from firenet_jax.training.losses import Loss

BINS = 5


# ---- Events -> tensor


def voxelise_original(events: Events, height: int, width: int) -> torch.Tensor:
    """rpg_e2vid's steps in our words: (N, 4) float64 rows, time scaled, two masked index_add_."""
    with torch.no_grad():
        columns = [events.t.astype(np.float64), events.x, events.y, events.p]
        rows = torch.from_numpy(np.stack(columns, axis=1))
        grid = torch.zeros(BINS * height * width)
        times = (BINS - 1) * (rows[:, 0] - rows[0, 0]) / (rows[-1, 0] - rows[0, 0])
        x, y = rows[:, 1].long(), rows[:, 2].long()
        polarity = rows[:, 3].float()
        polarity[polarity == 0] = -1
        lower = torch.floor(times)
        share = (times - lower).float()
        lower = lower.long()
        for bins, votes in ((lower, polarity * (1 - share)), (lower + 1, polarity * share)):
            valid = (bins >= 0) & (bins < BINS)
            place = x[valid] + y[valid] * width + bins[valid] * width * height
            grid.index_add_(0, place, votes[valid])
        return grid.view(BINS, height, width)


def voxelise_lean(events: Events, height: int, width: int, device="cpu") -> torch.Tensor:
    """As few passes and bytes as PyTorch needs: one spare plane takes the votes past the end."""
    with torch.no_grad():
        t = torch.from_numpy(events.t).to(device)
        times = (t - t[0]).to(torch.float32) * ((BINS - 1) / float(events.t[-1] - events.t[0]))
        lower = times.floor()
        share = times - lower
        p, x, y = (torch.from_numpy(column).to(device) for column in (events.p, events.x, events.y))
        polarity = p.to(torch.float32).mul_(2).sub_(1)
        place = y.int() * width + x
        place += lower.int() * (width * height)
        grid = torch.zeros((BINS + 1) * height * width, device=device)
        grid.index_add_(0, place, polarity * (1 - share))
        grid.index_add_(0, place + width * height, polarity * share)
        return grid.view(BINS + 1, height, width)[:BINS]


def normalise(tensors: torch.Tensor) -> torch.Tensor:
    """(..., bins, H, W) -> the same, non-zero entries with mean 0 and standard deviation 1."""
    axes = (-3, -2, -1)
    voted = tensors != 0
    count = voted.sum(axes, keepdim=True)
    mean = tensors.sum(axes, keepdim=True) / count
    centred = torch.where(voted, tensors - mean, 0.0)
    return centred / ((centred**2).sum(axes, keepdim=True) / count).sqrt()


# ---- Network


def _conv(layer: dict) -> nn.Conv2d:
    """A layer with our parameters, kernels (rows, columns, inputs, outputs)."""
    kernel, bias = (torch.from_numpy(np.array(layer[name])) for name in ("kernel", "bias"))
    size, _, inputs, outputs = kernel.shape
    made = nn.Conv2d(inputs, outputs, size, padding=size // 2)
    made.load_state_dict({"weight": kernel.permute(3, 2, 0, 1), "bias": bias})
    return made


class ConvGRU(nn.Module):
    """Both gates in one convolution, or in two as in the field's programs."""

    def __init__(self, layers: dict, separate_gates: bool):
        super().__init__()
        gates = layers["gates"]
        outputs = [slice(0, 16), slice(16, 32)] if separate_gates else [slice(0, 32)]
        parts = [{name: np.asarray(gates[name])[..., part] for name in gates} for part in outputs]
        self.gates = nn.ModuleList(_conv(part) for part in parts)
        self.candidate = _conv(layers["candidate"])

    def forward(self, h: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        both = torch.cat([x, h], 1)
        gates = [torch.sigmoid(gate(both)) for gate in self.gates]
        reset, update = gates if len(gates) == 2 else gates[0].chunk(2, 1)
        candidate = torch.tanh(self.candidate(torch.cat([x, reset * h], 1)))
        return h * (1 - update) + candidate * update


class ResidualBlock(nn.Module):
    def __init__(self, layers: dict):
        super().__init__()
        self.conv1, self.conv2 = _conv(layers["conv1"]), _conv(layers["conv2"])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return F.relu(x + self.conv2(F.relu(self.conv1(x))))


class FireNet(nn.Module):
    """(g1, g2, tensor (B, 5, H, W)) -> (g1, g2, image (B, H, W)), with our parameters."""

    def __init__(self, params: dict, separate_gates: bool = False):
        super().__init__()
        self.head, self.prediction = _conv(params["head"]), _conv(params["prediction"])
        self.gru1 = ConvGRU(params["gru1"], separate_gates)
        self.gru2 = ConvGRU(params["gru2"], separate_gates)
        self.res1, self.res2 = ResidualBlock(params["res1"]), ResidualBlock(params["res2"])

    def forward(self, g1: torch.Tensor, g2: torch.Tensor, tensor: torch.Tensor):
        g1 = self.gru1(g1, F.relu(self.head(tensor)))
        g2 = self.gru2(g2, self.res1(g1))
        return g1, g2, self.prediction(self.res2(g2))[:, 0]


# ---- Image -> picture


@lru_cache
def _unsharp_kernel(device: str) -> torch.Tensor:
    """(1, 1, 5, 5), the masses of a normal distribution in five cells between -1.3 and 1.3."""
    edges = torch.linspace(-1.3, 1.3, 6, dtype=torch.float64)
    masses = torch.diff(torch.special.ndtr(edges))
    kernel = torch.outer(masses, masses).sqrt()
    return (kernel / kernel.sum()).float()[None, None].to(device)


def to_picture(image: torch.Tensor) -> torch.Tensor:
    """(B, H, W) -> (B, H, W) uint8: unsharp mask of strength 0.3, range 0 to 1, rounded."""
    blurred = F.conv2d(image[:, None], _unsharp_kernel(str(image.device)), padding=2)[:, 0]
    return (255 * (1.3 * image - 0.3 * blurred)).clamp(0, 255).round().to(torch.uint8)


# ---- Loss; filters are the same matrices as in `evaluation.metrics`, which suits PyTorch too


def _matrix(size: int, weights, border: str = "valid", stride: int = 1) -> np.ndarray:
    """(outputs, size): correlates `size` pixels with the weights; borders as in numpy.pad."""
    taps = len(weights)
    padded = np.eye(size)
    if border != "valid":
        padded = np.pad(padded, ((taps // 2, (taps - 1) // 2), (0, 0)), border)
    outputs = len(padded) - taps + 1
    return sum(w * padded[k : k + outputs] for k, w in enumerate(weights))[::stride]


def _enlarging(size: int) -> np.ndarray:
    """The matrix up a pyramid: one border pixel repeated, zeros between all, the filter times 2."""
    padded = np.pad(np.eye((size + 1) // 2), ((1, 1), (0, 0)), "edge")
    spread = np.zeros((2 * len(padded), padded.shape[1]))
    spread[::2] = 2 * padded
    return (_matrix(len(spread), PYRAMID, "constant") @ spread)[2 : 2 + size]


@lru_cache
def _filters(height: int, width: int, device: str) -> dict:
    """All matrices of the loss for images of this size."""

    def pair(make):
        return tuple(torch.tensor(make(n), dtype=torch.float32, device=device) for n in sizes)

    sizes = height, width
    window = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    made = {"ssim": pair(lambda n: _matrix(n, window / window.sum())), "bands": []}
    for band, (sigma, (above, left, right, below)) in enumerate(NLPD_BANDS):
        farther = NLPD_FARTHER if band == 0 else 0.0
        row = (farther, right, 0, left, 0)
        down = torch.tensor(_matrix(sizes[0], (below, 0, above), "constant"), dtype=torch.float32)
        across = torch.tensor(_matrix(sizes[1], row, "constant"), dtype=torch.float32)
        bands = {"sigma": sigma, "down": down.to(device), "across": across.to(device)}
        if band < len(NLPD_BANDS) - 1:
            bands["smaller"] = pair(lambda n: _matrix(n, PYRAMID, "symmetric", 2))
            bands["larger"] = pair(_enlarging)
        made["bands"].append(bands)
        sizes = (sizes[0] + 1) // 2, (sizes[1] + 1) // 2
    return made


def _apply(images: torch.Tensor, matrices) -> torch.Tensor:
    return matrices[0] @ images @ matrices[1].T


def _ssim(images: torch.Tensor, truths: torch.Tensor, filters: dict) -> torch.Tensor:
    """SSIM from sums and differences, as in the package: four maps to filter, not five."""
    s, d = images + truths - 1, images - truths
    maps = _apply(torch.stack([s, d, s**2, d**2]), filters["ssim"])
    mean_s, mean_d = maps[0], maps[1]
    variance_s, variance_d = maps[2] - mean_s**2, maps[3] - mean_d**2
    c1, c2 = 2 * 0.01**2, 2 * 0.03**2
    square_s, square_d = (mean_s + 1) ** 2, mean_d**2
    luminance = (square_s - square_d + c1) / (square_s + square_d + c1)
    cs = (variance_s - variance_d + c2) / (variance_s + variance_d + c2)
    return (luminance * cs).mean((-2, -1))


def _nlpd(images: torch.Tensor, truths: torch.Tensor, filters: dict) -> torch.Tensor:
    pictures, distance = torch.stack([images, truths]), 0.0
    for band in filters["bands"]:
        details = pictures
        if "smaller" in band:
            pictures = _apply(pictures, band["smaller"])
            details = details - _apply(pictures, band["larger"])
        activity = details.abs()
        near = band["down"] @ activity + activity @ band["across"].T
        image, truth = details / (band["sigma"] + near)
        distance = distance + ((image - truth) ** 2).mean((-2, -1)).sqrt()
    return distance / len(filters["bands"])


def _warp(images: torch.Tensor, displacement: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(N, K, H, W), (N, H, W, 2) -> looked up at x - d(x), and where that is inside."""
    height, width = images.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    place = torch.stack([x, y], -1).to(images.device) - displacement
    last = torch.tensor([width - 1, height - 1], device=images.device)
    grid = 2 * place / last - 1
    warped = F.grid_sample(images, grid, padding_mode="border", align_corners=True)
    return warped, ((place >= 0) & (place <= last)).all(-1)


def _temporal_error(images, truths, displacements, visible) -> torch.Tensor:
    """The same as `metrics.temporal_error` for images 1 to T - 1: (T - 1, B)."""
    displacements = torch.where(visible[..., None], displacements, 0.0)[1:]
    before = torch.stack([images[:-1], truths[:-1]], 2)  # (T - 1, B, 2, H, W)
    warped, inside = _warp(before.flatten(0, 1), displacements.flatten(0, 1))
    image, truth = warped.view(before.shape).unbind(2)
    mask = torch.exp(-50 * (truths[1:] - truth) ** 2)
    mask = torch.where(visible[1:] & inside.view(image.shape), mask, 0.0)
    return (mask * (images[1:] - image).abs()).mean((-2, -1))


def sequence_loss(images, truths, displacements, visible, settings: Loss) -> torch.Tensor:
    """Eq. 2 with our distances, for the terms that weigh something by default."""
    filters = _filters(*images.shape[-2:], str(images.device))
    loss = (
        settings.l1 * (images - truths).abs().mean((-2, -1))
        + settings.nlpd * _nlpd(images, truths, filters)
        + settings.ssim * (1 - _ssim(images, truths, filters))
    )
    first = slice(settings.l0 - 1, None)
    errors = _temporal_error(images[first], truths[first], displacements[first], visible[first])
    return loss.sum(0).mean() + settings.lambda_tc * errors.sum(0).mean()


# ---- Training


class Trainer:
    """A training step on data that are there: forward, loss, gradient, clipping, Adam."""

    def __init__(self, model: nn.Module, run, memory_format, settings, dtype=None):
        """run: the model, or what a compiler made of it; dtype: of convolutions, by autocast."""
        self.run, self.memory_format, self.settings = run, memory_format, settings
        self.parameters = list(model.parameters())
        self.device = self.parameters[0].device.type
        self.adam = torch.optim.Adam(self.parameters, settings.learning_rate)
        cast = partial(torch.autocast, self.device)
        self.cast = cast(enabled=False) if dtype is None else cast(dtype=dtype)

    def images(self, tensors: torch.Tensor) -> torch.Tensor:
        """(T, B, 5, H, W), not normalised -> (T, B, H, W), from a zero state."""
        _, batch, _, height, width = tensors.shape
        zeros = torch.zeros(batch, 16, height, width, device=tensors.device)
        g1 = g2 = zeros.to(memory_format=self.memory_format)
        images = []
        with self.cast:
            for tensor in normalise(tensors):
                g1, g2, image = self.run(
                    g1, g2, tensor.contiguous(memory_format=self.memory_format)
                )
                images.append(image)
        return torch.stack(images).float()

    def step(self, tensors, truths, displacements, visible) -> dict[str, float]:
        loss = sequence_loss(
            self.images(tensors), truths, displacements, visible, self.settings.loss
        )
        self.adam.zero_grad()
        loss.backward()
        gradient = nn.utils.clip_grad_norm_(self.parameters, self.settings.clip)
        self.adam.step()
        return {"loss": float(loss.detach()), "gradient": float(gradient)}
