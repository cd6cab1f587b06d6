"""Weights -> files for other programs: the network where there is no JAX, or no firenet_jax.

    onnx_model    Weights -> ONNX graph of a step: onnxruntime, TensorRT, OpenVINO, browsers
    stablehlo     Weights -> a step as JAX exports it: any process with jax, any platform
    weights_file  Weights -> .pth or .safetensors, under the names of the original programs
    web_page      Weights -> a folder that a browser shows: a recording becomes video there

Read `onnx_model` first. The libraries that write come with the extra `export`.
"""

from firenet_jax.errors import OutputError


def missing(library: str) -> OutputError:
    """The error of a library that is not installed."""
    return OutputError(
        f"this kind of file is written by the library {library}, which is not installed: "
        'in the source folder, pip install ".[export]"'
    )
