"""Weights -> one step of FireNet as JAX exports programs: StableHLO, any platform and size.

    step = jax.jit(jax.export.deserialize(open("model.stablehlo", "rb").read()).call)
    image, g1, g2 = step(events, g1, g2)  # perhaps picture too

events (batch, height, width, 5), g1, g2 (batch, height, width, 16) and image
(batch, height, width), float32, channels last as everywhere in this package; picture uint8. The
process that runs it imports jax and nothing of ours. For a CPU it is XLA's convolutions: machine
code of our own is made for one processor and cannot go along.

JAX promises to read such a file for six months after it was written, with jax as old as three weeks
before it (docs.jax.dev/en/latest/export/export.html#compatibility-guarantees): what must last is
.npz, .onnx or .safetensors.
"""

import jax
import jax.numpy as jnp
from jax import export

from firenet_jax.events import BINS
from firenet_jax.export import missing
from firenet_jax.network import CHANNELS, State, Weights
from firenet_jax.pictures import Display, display
from firenet_jax.reconstruction import reconstruct

FIXED = Display(range="fixed")  # a range that follows the images would be one more state
PLATFORMS = "cpu", "cuda", "rocm", "tpu"


def stablehlo(weights: Weights, *, normalise: bool = True, picture: bool = False) -> bytes:
    """Weights -> the file's bytes.

    normalise: raw event tensors are normalised in it, where the weights ask for normalised ones.
    picture: a result more, (batch, height, width) uint8, as `pictures.display` has it, of a
        fixed range.
    Raises OutputError where the library flatbuffers is not installed.
    """
    try:
        import flatbuffers  # noqa: F401  JAX needs it to write, and does not bring it along
    except ImportError:
        raise missing("flatbuffers") from None
    inside = Weights(weights.params, normalise and weights.normalise)

    def step(events, g1, g2):
        state, images = reconstruct(inside, State(g1, g2), events[None], machine_code=False)
        results = images[0], state.g1, state.g2
        return (*results, display(None, images, settings=FIXED)[1][0]) if picture else results

    sizes = export.symbolic_shape("batch, height, width")
    shapes = [jax.ShapeDtypeStruct((*sizes, n), jnp.float32) for n in (BINS, CHANNELS, CHANNELS)]
    return bytes(export.export(jax.jit(step), platforms=PLATFORMS)(*shapes).serialize())
