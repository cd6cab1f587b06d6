"""Command line -> one command: firenet demo | reconstruct | live | train | evaluate | ...

A command is a module with a frozen dataclass of settings and a function `run(settings)`. It is
imported only when the command is called, so `firenet --help` does not load jax.
"""

import _thread
import contextlib
import ctypes
import difflib
import errno
import importlib
import inspect
import io
import logging
import os
import sys
import threading

from firenet_jax.errors import FirenetError

# name: what it does; `commands.demo.Demo` are the settings of demo
COMMANDS = {
    "demo": "a simulated scene -> events | reconstruction | truth",
    "reconstruct": "recordings -> video or pictures",
    "live": "a camera or a stream -> live pictures",
    "info": "what a recording holds",
    "simulate": "random scenes or a video file -> events",
    "train": "sequences or recordings -> weights",
    "evaluate": "recordings with frames -> a comparison of methods",
    "convert": "PyTorch checkpoint -> weights.npz",
    "export": "weights -> ONNX, StableHLO, PyTorch, safetensors, a web page",
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
    "--auto_hdr": "--range extremes",
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
    commands = "\n".join(f"  firenet {name:13} {said}" for name, said in COMMANDS.items())
    return (
        "firenet_jax: event camera recordings become video (FireNet in JAX)\n\n"
        f"{commands}\n\n"
        "firenet COMMAND --help explains a command and gives examples.\n"
        "firenet --version prints the version. With FIRENET_DEBUG=1 in the environment,\n"
        "errors show a traceback."
    )


# Settings of glibc's malloc (number, value). By default it starts to keep freed blocks of up to
# 32 MB in one heap per thread. These heaps fragment, and a long reconstruction grows by a third.
RETURN_FREED_MEMORY = ((-3, 1 << 22),)  # M_MMAP_THRESHOLD
# A training step allocates the same again: requesting it from the system takes a fifth of its time.
KEEP_FREED_MEMORY = (  # no heaps of threads (M_ARENA_MAX), M_MMAP_MAX, M_TRIM_THRESHOLD
    (-8, 1), (-4, 0), (-1, 2**31 - 1),
)  # fmt: skip
HUGE_PAGES = "glibc.malloc.hugetlb=1"
INTERRUPTED = 130  # the exit code after Ctrl-C, as shells have it
# What Ctrl-C says of commands that go on where they were.
GOES_ON = {
    "reconstruct": "a folder of pictures goes on when run again",
    "simulate": "a folder of sequences goes on when run again",
    "evaluate": "the same command goes on with what is missing",
}
REPORT = (
    "firenet: this is a bug in firenet, not a mistake of yours: please report it, with the command "
    "and all these lines"
)


def _set_malloc(choices: tuple[tuple[int, int], ...]) -> None:
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):  # another C library
            for choice in choices:
                ctypes.CDLL(None).mallopt(*choice)


def program() -> int:
    """The entry point of `firenet`: `main`, with glibc set to use huge pages for large blocks.

    XLA allocates its memory anew at each call. With pages of 4 kB that is some ten thousand page
    faults per window at 640x480: a twelfth of the time of a reconstruction, a seventh of a training
    step. glibc reads this setting from the environment at the start of a program, so this one
    starts itself again, once.
    """
    if sys.platform == "linux" and "GLIBC_TUNABLES" not in os.environ:
        os.environ["GLIBC_TUNABLES"] = HUGE_PAGES
        with contextlib.suppress(OSError):  # it may not be started again: then without
            os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    for name in ("stdin", "stdout", "stderr"):  # one that is closed is None, and breaks libraries
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w"))
        elif isinstance(stream := getattr(sys, name), io.TextIOWrapper) and name != "stdin":
            stream.reconfigure(errors="backslashreplace")  # names may hold bytes that are no text
    try:
        code = main()
    except SystemExit as stop:  # of the help and of what tyro cannot read
        code = int(stop.code or 0)
    except OSError as error:  # where nothing is kept back, `print` itself meets it
        if os.environ.get("FIRENET_DEBUG"):
            raise
        code = 1
        if not isinstance(error, BrokenPipeError):  # who reads no further, as `head`, knows that
            print(f"firenet: error: {sentence(error, '')}", file=sys.stderr)
    code = _said(code)
    if code == INTERRUPTED:  # what XLA is still computing would be awaited, or crash as Python ends
        sys.stderr.flush()
        os._exit(code)
    return code


def _said(code: int) -> int:
    """The exit code, once what was printed has gone where it should."""
    try:
        sys.stdout.flush()
        return code
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # Python will flush again
        if not isinstance(error, BrokenPipeError):  # who reads no further, as `head`, knows that
            print(f"firenet: error: cannot print ({error.strerror})", file=sys.stderr)
        return code or 1


def sentence(error: Exception, command: str) -> str | None:
    """The message for an error that the user can fix; None for a bug in this package."""
    if isinstance(error, ModuleNotFoundError):
        library = (error.name or "").partition(".")[0]
        if library in EXTRAS:  # a library may be in several extras: prefer the command's own
            extra = command if command in EXTRAS.values() else EXTRAS[library]
            return (
                f"firenet {command} needs {library}, which is not installed: "
                f'in the source folder, pip install ".[{extra}]"'
            )
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return "not enough memory: ask for a smaller sensor, chunk, crop, pad or batch"
    if isinstance(error, PermissionError) and error.filename:
        from firenet_jax.storage.files import forbidden

        return forbidden(error.filename)
    if isinstance(error, OSError) and error.errno == errno.ENOSPC and error.filename is None:
        return f"cannot print or write ({error.strerror})"
    return str(error) if isinstance(error, (FirenetError, OSError)) else None


@contextlib.contextmanager
def _no_interrupt_lost():
    """Ctrl-C raises wherever Python is; what is raised in a callback of its garbage collector, as
    JAX has one, or in a finaliser, is dropped. Meanwhile it is raised again, a little later."""
    before = sys.unraisablehook

    def again(what):
        if not issubclass(what.exc_type, KeyboardInterrupt):
            return before(what)
        later = threading.Timer(0.05, _thread.interrupt_main)  # not in this very callback
        later.daemon = True
        later.start()

    sys.unraisablehook = again
    try:
        yield
    finally:
        sys.unraisablehook = before


def main(arguments: list[str] | None = None) -> int:
    """Runs one command; returns the exit code.

    A `FirenetError`, an OSError or a lack of memory prints one sentence. Any other exception is a
    bug in this package and shows its traceback.
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
        near = difflib.get_close_matches(arguments[0], COMMANDS, 1)
        meant = f", did you mean {near[0]}?" if near else ""
        print(f"firenet: no command {arguments[0]!r}{meant}\n\n{usage()}", file=sys.stderr)
        return 2

    logging.basicConfig(format="firenet: %(message)s", level=logging.WARNING)
    name, rest = arguments[0], arguments[1:]
    _set_malloc(KEEP_FREED_MEMORY if name == "train" else RETURN_FREED_MEMORY)
    os.environ["JAX_ENABLE_X64"] = "0"  # for other programs of this user: here all is float32
    for option in (word.partition("=")[0] for word in rest):
        if name == "reconstruct" and option in FORMER:
            print(
                f"firenet: error: {option} is the original program's: {FORMER[option]} here",
                file=sys.stderr,
            )
            return 2
    try:
        from firenet_jax.commands import options

        with _no_interrupt_lost():
            command = importlib.import_module(f"firenet_jax.commands.{name}")
            kind = getattr(command, name.capitalize())
            command.run(options.parse(kind, rest, f"firenet {name}", inspect.getdoc(kind) or ""))
    except KeyboardInterrupt as error:
        goes_on = str(error) or GOES_ON.get(name)
        print("firenet: interrupted" + (f"; {goes_on}" if goes_on else ""), file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        if isinstance(error, BrokenPipeError) and error.filename is None:
            return 1  # who reads no further, as `head`, knows that
        said = sentence(error, name)
        if said is None:
            error.add_note(REPORT)
        if said is None or os.environ.get("FIRENET_DEBUG"):
            raise
        print(f"firenet: error: {said}", file=sys.stderr)
        return 1
    return 0
