"""Weights -> ONNX graph of one step of FireNet, any batch, height and width.

    events (batch, 5, height, width), g1, g2 (batch, 16, height, width)
        -> image (batch, 1, height, width), g1_next, g2_next, perhaps picture

float32, channels first, as PyTorch and ONNX have it. g1 and g2 are zeros before the first window,
and then what the last step gave as g1_next and g2_next: in ONNX an input and an output cannot share
a name. The picture is uint8, as `firenet reconstruct --range fixed` shows it.

Operators: onnx.ai/onnx/operators, opset 17 (2022), all of them also in the browsers' runtime.
"""

import numpy as np

from firenet_jax.events import BINS
from firenet_jax.export import missing
from firenet_jax.network import CHANNELS, Weights
from firenet_jax.pictures import Display, unsharp_kernel

TO_UINT8 = 2  # TensorProto.UINT8
OPSET, IR_VERSION = 17, 8  # of one release: onnx 1.12, onnxruntime 1.12
STATE = "batch", CHANNELS, "height", "width"
PLANE = "batch", 1, "height", "width"


class _Graph:
    """Nodes and constants, as they are added; a value is the name by which nodes know it."""

    def __init__(self, helper, numpy_helper):
        self.helper, self.numpy_helper = helper, numpy_helper
        self.nodes, self.constants = [], {}

    def constant(self, name: str, value) -> str:
        array = np.ascontiguousarray(value)
        self.constants[name] = self.numpy_helper.from_array(array, name)
        return name

    def add(self, operator: str, *inputs: str, out: str, **attributes) -> str:
        """One node; returns the name of what it gives."""
        return self.add_several(operator, *inputs, out=[out], **attributes)[0]

    def add_several(self, operator: str, *inputs: str, out: list[str], **attributes) -> list[str]:
        node = self.helper.make_node(operator, list(inputs), out, name=out[0], **attributes)
        self.nodes.append(node)
        return out

    def convolve(self, image: str, layer: dict, out: str) -> str:
        kernel = np.asarray(layer["kernel"], np.float32).transpose(3, 2, 0, 1)  # HWIO -> OIHW
        weight = self.constant(f"{out}.weight", kernel)
        bias = self.constant(f"{out}.bias", np.asarray(layer["bias"], np.float32))
        size, pads = kernel.shape[2:], [kernel.shape[2] // 2] * 4
        return self.add("Conv", image, weight, bias, out=out, kernel_shape=size, pads=pads)


def onnx_model(weights: Weights, *, normalise: bool = True, picture: bool = False):
    """Weights -> onnx.ModelProto, checked.

    normalise: the graph normalises raw event tensors, where the weights ask for normalised ones;
    else that is left to who calls it (`tensors.normalise`).
    picture: an output more, `picture` (batch, 1, height, width) uint8.
    Raises OutputError where the library onnx is not installed.
    """
    try:
        from onnx import TensorProto, checker, helper, numpy_helper
    except ImportError:
        raise missing("onnx") from None
    params = weights.params
    graph = _Graph(helper, numpy_helper)
    inside = normalise and weights.normalise
    events = _normalise(graph, "events") if inside else "events"
    x = graph.add("Relu", graph.convolve(events, params["head"], "head"), out="head.relu")
    x = _gru(graph, "gru1", params["gru1"], "g1", x, "g1_next")
    x = _residual(graph, "res1", params["res1"], x)
    x = _gru(graph, "gru2", params["gru2"], "g2", x, "g2_next")
    x = _residual(graph, "res2", params["res2"], x)
    graph.convolve(x, params["prediction"], "image")
    outputs = {"image": PLANE, "g1_next": STATE, "g2_next": STATE}
    if picture:
        _picture(graph, "image", "picture")
        outputs["picture"] = PLANE

    def values(shapes):
        return [
            helper.make_tensor_value_info(
                name, TensorProto.UINT8 if name == "picture" else TensorProto.FLOAT, shape
            )
            for name, shape in shapes.items()
        ]

    inputs = {"events": ("batch", BINS, "height", "width"), "g1": STATE, "g2": STATE}
    expects = "normalised" if weights.normalise and not inside else "raw"
    made = helper.make_graph(
        graph.nodes,
        "FireNet",
        values(inputs),
        values(outputs),
        list(graph.constants.values()),
        doc_string=f"One step of FireNet (Scheerlinck et al., WACV 2020). events: {expects} event "
        "tensors (Eq. 1); g1, g2: zeros before the first window, then g1_next, g2_next; image: "
        "nominally 0 to 1, not clipped",
    )
    opset = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(
        made, opset_imports=opset, ir_version=IR_VERSION, producer_name="firenet_jax"
    )
    helper.set_model_props(model, {"events": expects, "bins": str(BINS)})
    checker.check_model(model, full_check=True)
    return model


def _gru(graph: _Graph, name: str, layers: dict, h: str, x: str, out: str) -> str:
    """h' = h + z (q - h), with gates [r, z] = sigmoid(conv([x, h])), q = tanh(conv([x, r h]))."""
    both = graph.add("Concat", x, h, out=f"{name}.both", axis=1)
    gates = graph.add(
        "Sigmoid", graph.convolve(both, layers["gates"], f"{name}.gates"), out=f"{name}.sigmoid"
    )
    sizes = graph.constant("channels", np.array([CHANNELS, CHANNELS], np.int64))
    halves = [f"{name}.reset", f"{name}.update"]
    r, z = graph.add_several("Split", gates, sizes, out=halves, axis=1)
    reset = graph.add("Mul", r, h, out=f"{name}.kept")
    both = graph.add("Concat", x, reset, out=f"{name}.both_reset", axis=1)
    q = graph.add(
        "Tanh", graph.convolve(both, layers["candidate"], f"{name}.candidate"), out=f"{name}.tanh"
    )
    change = graph.add("Mul", z, graph.add("Sub", q, h, out=f"{name}.off"), out=f"{name}.change")
    return graph.add("Add", h, change, out=out)


def _residual(graph: _Graph, name: str, layers: dict, x: str) -> str:
    """relu(x + conv2(relu(conv1(x))))"""
    between = graph.convolve(x, layers["conv1"], f"{name}.conv1")
    between = graph.add("Relu", between, out=f"{name}.between")
    change = graph.convolve(between, layers["conv2"], f"{name}.conv2")
    return graph.add("Relu", graph.add("Add", x, change, out=f"{name}.sum"), out=f"{name}.relu")


def _normalise(graph: _Graph, events: str) -> str:
    """`tensors.normalise`: non-zero entries of each window to mean 0 and deviation 1."""
    zero = graph.constant("zero", np.float32(0))
    one = graph.constant("one", np.float32(1))
    axes = graph.constant("window", np.array([1, 2, 3], np.int64))

    def total(value: str, out: str) -> str:
        return graph.add("ReduceSum", value, axes, out=out, keepdims=1)

    empty = graph.add("Equal", events, zero, out="empty")
    voted = graph.add("Where", empty, zero, one, out="voted")
    count = graph.add("Max", total(voted, "votes"), one, out="count")
    mean = graph.add("Div", total(events, "events.sum"), count, out="mean")
    centred = graph.add("Sub", events, mean, out="events.off")
    centred = graph.add("Where", empty, zero, centred, out="centred")
    squares = total(graph.add("Mul", centred, centred, out="squares"), "squares.sum")
    variance = graph.add("Div", squares, count, out="variance")
    least = graph.constant("least_variance", np.float32(1e-12))
    unusable = graph.add("Less", variance, least, out="unusable")
    deviation = graph.add("Sqrt", variance, out="deviation")
    divisor = graph.add("Where", unusable, one, deviation, out="divisor")
    scaled = graph.add("Div", centred, divisor, out="scaled")
    return graph.add("Where", unusable, zero, scaled, out="normalised")


def _picture(graph: _Graph, image: str, out: str) -> str:
    """`pictures.display` with a fixed range: unsharp mask, clipped to 0..1, rounded to 8 bits."""
    kernel = unsharp_kernel(Display().unsharp)[None, None]
    mask = graph.constant("unsharp", kernel)
    sharp = graph.add("Conv", image, mask, out="sharp", kernel_shape=[5, 5], pads=[2] * 4)
    limits = (graph.constant(f"level{n}", np.float32(n)) for n in (0, 1))
    levels = graph.add("Clip", sharp, *limits, out="clipped")
    white = graph.constant("white", np.float32(255))
    levels = graph.add("Mul", levels, white, out="levels")
    return graph.add("Cast", graph.add("Round", levels, out="rounded"), out=out, to=TO_UINT8)
