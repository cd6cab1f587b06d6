"""Command line -> one command: firenet demo | reconstruct | live | train | evaluate | ...

A command is a module with a frozen dataclass of settings and a function `run(settings)`. It is
imported only when the command is called, so `firenet --help` does not load jax.
"""

import contextlib
import ctypes
import importlib
import inspect
import logging
import os
import sys

from firenet_jax.errors import FirenetError

# name: (module, settings, what it does)
COMMANDS = {
    "demo": (
        "firenet_jax.commands.demo",
        "Demo",
        "a simulated scene -> events | reconstruction | truth",
    ),
    "reconstruct": (
        "firenet_jax.commands.reconstruct",
        "Reconstruct",
        "recordings -> video or pictures",
    ),
    "live": ("firenet_jax.commands.live", "Live", "a camera or a stream -> live pictures"),
    "info": ("firenet_jax.commands.info", "Info", "what a recording holds"),
    "simulate": (
        "firenet_jax.commands.simulate",
        "Simulate",
        "random scenes or a video file -> events",
    ),
    "train": ("firenet_jax.commands.train", "Train", "sequences or recordings -> weights"),
    "evaluate": (
        "firenet_jax.commands.evaluate",
        "Evaluate",
        "recordings with frames -> a comparison of methods",
    ),
    "convert": ("firenet_jax.commands.convert", "Convert", "PyTorch checkpoint -> weights.npz"),
    "export": (
        "firenet_jax.commands.export",
        "Export",
        "weights -> ONNX, StableHLO, PyTorch, safetensors",
    ),
}

# Libraries that only some commands need -> the extra of this package that installs them.
EXTRAS = {
    "optax": "train",
    "orbax": "train",
    "grain": "train",
    "tensorboardX": "train",
    "skimage": "evaluate",
}

# Options of the original program (rpg_e2vid) -> the equivalent here.
FORMER = {
    "-i": "name the recording without an option",
    "--input_file": "name the recording without an option",
    "--path_to_model": "-c",
    "--auto_hdr": "--auto-range",
    "--fixed_duration": "-T MILLISECONDS",
    "--window_duration": "-T",
    "--window_size": "-N",
    "--num_events_per_pixel": "--events-per-pixel",
    "--hot_pixels_file": "--hot-pixels",
    "--skipevents": "--start SECONDS",
    "--output_folder": "-o FOLDER",
    "--bilateral_filter_sigma": "--bilateral",
    "--unsharp_mask_amount": "--unsharp",
    "--show_events": "--preview",
}


def usage() -> str:
    lines = [f"  firenet {name:13} {summary}" for name, (_, _, summary) in COMMANDS.items()]
    return "\n".join(
        [
            "firenet_jax: event camera recordings become video (FireNet in JAX)",
            "",
            *lines,
            "",
            "firenet COMMAND --help explains a command and gives examples. With FIRENET_DEBUG=1",
            "in the environment, errors show a traceback.",
        ]
    )


def _return_freed_memory() -> None:
    """Makes glibc return large freed blocks to the system at once.

    By default it starts to keep blocks of up to 32 MB in one heap per thread. These heaps fragment,
    and a long reconstruction grows by a third before its memory settles.
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):  # another C library
            ctypes.CDLL(None).mallopt(-3, 1 << 22)  # M_MMAP_THRESHOLD


REPORT = (
    "firenet: this is a fault of firenet, not of yours: please report it, with the command and all "
    "these lines"
)


def _keep_freed_memory() -> None:
    """Makes glibc keep freed memory, because each training step allocates the same again.

    Otherwise each step requests some hundred MB from the system, which takes a fifth of its time.
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            tell = ctypes.CDLL(None).mallopt
            tell(-8, 1)  # M_ARENA_MAX: those of threads keep no large blocks
            tell(-4, 0)  # M_MMAP_MAX
            tell(-1, 2**31 - 1)  # M_TRIM_THRESHOLD


HUGE_PAGES = "glibc.malloc.hugetlb=1"


def program() -> int:
    """What `firenet` runs: `main`, after glibc was told to take large blocks in huge pages.

    XLA asks for its memory anew at each call. In pages of 4 kB that is some ten thousand page
    faults a window at 640x480: a twelfth of the time of a reconstruction, a seventh of a training
    step's. glibc takes the choice from the environment of a starting program, so this one starts
    again, once.
    """
    if sys.platform == "linux" and "GLIBC_TUNABLES" not in os.environ:
        os.environ["GLIBC_TUNABLES"] = HUGE_PAGES
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    return main()


def sentence(error: Exception, command: str) -> str | None:
    """What a person is told who can put it right; None where the fault is this package's."""
    if isinstance(error, ModuleNotFoundError):
        library = (error.name or "").partition(".")[0]
        if library in EXTRAS:  # several extras bring some: a command's own has its name
            extra = command if command in EXTRAS.values() else EXTRAS[library]
            return (
                f"firenet {command} needs {library}, which is not installed: "
                f'pip install "firenet-jax[{extra}]"'
            )
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return "not enough memory: ask for a smaller sensor, chunk, crop or batch"
    if isinstance(error, PermissionError) and error.filename:
        from firenet_jax.storage.files import forbidden

        return forbidden(error.filename)
    return str(error) if isinstance(error, (FirenetError, OSError)) else None


def main(arguments: list[str] | None = None) -> int:
    """Runs one command; returns the exit code.

    What a user can put right (`FirenetError`), the system's refusals (OSError) and a lack of memory
    are one sentence. Anything else is a fault of this package and shows its traceback.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return 0 if arguments else 2
    if arguments[0] == "--version":
        from importlib.metadata import version

        print(version("firenet-jax"))
        return 0
    if arguments[0] not in COMMANDS:
        print(f"firenet: no command {arguments[0]!r}\n\n{usage()}", file=sys.stderr)
        return 2

    from firenet_jax.commands import options

    logging.basicConfig(format="firenet: %(message)s", level=logging.WARNING)
    name, rest = arguments[0], arguments[1:]
    _keep_freed_memory() if name == "train" else _return_freed_memory()
    module, settings, _ = COMMANDS[name]
    for option in (word.partition("=")[0] for word in rest):
        if name == "reconstruct" and option in FORMER:
            print(
                f"firenet: error: {option} is the original program's: {FORMER[option]} here",
                file=sys.stderr,
            )
            return 2
    try:
        command = importlib.import_module(module)
        kind = getattr(command, settings)
        command.run(options.parse(kind, rest, f"firenet {name}", inspect.getdoc(kind) or ""))
    except KeyboardInterrupt as error:
        goes_on = str(error) or "a folder of pictures or sequences goes on when run again"
        print(f"firenet: interrupted; {goes_on}", file=sys.stderr)
        return 130
    except Exception as error:
        said = sentence(error, name)
        if said is None:
            error.add_note(REPORT)
        if said is None or os.environ.get("FIRENET_DEBUG"):
            raise
        print(f"firenet: error: {said}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(program())
