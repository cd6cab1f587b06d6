"""One-line changes to the core -> how many of them the tests of the changed module find.

    python tests/mutations.py --count 50 --seed 0          a quarter of an hour
    python tests/mutations.py --only events windows        these modules' part of the same 50

Change number n is a function of the seed, n and the code: another comparison, sign, number, truth
value or connective. A copy of the package gets it, and the tests of that module run until the
first that fails; a change that makes them take too long counts as found. Those that survive are
printed as a diff: each needs a test, or a line in `EQUIVALENT` that says why it changes nothing.
"""

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
LIMIT = 1200.0  # seconds of one module's tests, at the least
MODULES = {  # what is changed: the tests that must find it
    "events.py": ["events"],
    "windows.py": ["windows"],
    "tensors.py": ["tensors"],
    "network.py": ["network", "arrays"],
    "convolution.py": ["convolution"],
    "reconstruction.py": ["reconstruction", "colour", "instants"],
    "pictures.py": ["pictures"],
    "checkpoint.py": ["checkpoint"],
    "training/losses.py": ["losses"],
    "evaluation/metrics.py": ["metrics"],
    "simulation/sensor.py": ["sensor"],
    "simulation/sequences.py": ["sensor"],
    "simulation/curricula.py": ["curricula"],
}
EQUIVALENT = {  # (module, line after the change): why nothing changes
    (
        "tensors.py",
        "windows: Sequence[Sequence[Events]], devices: int, at_least: int = 1",
    ): "the smallest size is larger",
    (
        "simulation/curricula.py",
        "sensors = _uneven(sensors, numbers[2], is_slow, slow)",
    ): "JAX takes the last row for one beyond it",
    (
        "simulation/sensor.py",
        "spacing = jnp.where(count >= 1, stride, 0.0).astype(jnp.int32) * run.spacing",
    ): "a run of one event has no second one",
    (
        "windows.py",
        "def _window(events: Events, start: int, stop: int, end: int = 1) -> Window:",
    ): "who leaves `end` out has events, whose last time is taken",
    ("reconstruction.py", "chunk: int = 9,"): "how many windows at a time is speed alone",
    (
        "windows.py",
        'f"{density:,.0f}" if density > 100 else f"{density:.3g}", USUAL_DENSITY,',
    ): "100 reads the same in both ways",
    (
        "windows.py",
        'f"{density:,.0f}" if density >= 101 else f"{density:.3g}", USUAL_DENSITY,',
    ): "from 100 to 101 it reads the same in both ways",
}


def _also(module: str, reason: str, *lines: str) -> None:
    EQUIVALENT.update({(module, line): reason for line in lines})


_BLAME = "  # to blame the end of those held gains nothing"
_also("events.py", "the way that looks at more finds the same",
      f"if (~bad & (events.t < last)).sum() < 1:{_BLAME}",
      f"if (~bad & (events.t <= last)).sum() <= 1:{_BLAME}",
      "if not times and bool((np.diff(t[rows]) <= 0).all()):",
      "if not times or bool((np.diff(t[rows]) < 0).all()):")  # fmt: skip
_also("events.py", "each is written before it is read", "before = [-2] * len(times)")
_also("events.py", "any number below 0 ends it",
      "before[place] = places[length - 1] if length else -2")  # fmt: skip
_also("pictures.py", "what is 3 away is farther than 2, which the next line asks",
      "for i in range(-3, 3):", "for i in range(-2, 4):",
      "for j in range(-3, 3):", "for j in range(-2, 4):")  # fmt: skip
_also("events.py", "0 is never outside", "if value <= 0:", "if value < 1:")
_BLOCKS = "  # on a CPU: events per step of the scan, and how far it is unrolled"
_also("tensors.py", "how much at a time is speed alone",
      f"BLOCK, BLOCKS = 2**18, 8{_BLOCKS}", f"BLOCK, BLOCKS = 2**17, 9{_BLOCKS}",
      "times_copied = _helper(os.getpid()).submit(copy_times) if size > BLOCK else copy_times()"
      )  # fmt: skip
_also("tensors.py", "of five bins, three have even numbers",
      "even, odd = (BINS + 2) // 2, BINS // 2  # how many bins have even numbers and odd ones",
      )  # fmt: skip
_also("tensors.py", "the smallest size is larger", "size = 1",
      "def capacity(events: int, at_least: int = 1) -> int:")  # fmt: skip
_also("tensors.py", "where it is not usable, nothing is",
      "return jnp.where(usable, centred / jnp.sqrt(jnp.where(usable, variance, 1.6)), 0.0)",
      )  # fmt: skip
_also("convolution.py", "the lengths are equal",
      "for gradient, name, result in zip(gradients, activations, results, strict=False)",
      "return tuple(ACTIVATIONS[name][0](x) for name, x in zip(activations, parts, strict=False))",
      )  # fmt: skip
_also("reconstruction.py", "no type of numbers lies between",
      "exact = jnp.finfo(kind).bits <= 33",
      "exact = kind == jnp.bool_ or (whole and jnp.iinfo(kind).max < 2**24)",
      "exact = kind == jnp.bool_ or (whole and jnp.iinfo(kind).max <= 2**25)",
      )  # fmt: skip
_also("reconstruction.py", "only shapes are taken from them",
      "shapes = jax.eval_shape(initial_params, jax.random.key(1))")  # fmt: skip
_also("reconstruction.py", "nothing is asked of the state after the last step",
      "looks, valid = looks_of([group], chunk), np.arange(chunk)[:, None] <= len(group)",
      )  # fmt: skip
_also("pictures.py", "what is padded farther is not read", "padding[axis] = (2, 3)",
      'padded = jnp.pad(images, [(0, 0)] * (images.ndim - 2) + [(2, 3)] * 2, mode="reflect")',
      )  # fmt: skip
_also("evaluation/metrics.py", "the lengths are equal",
      "for a, b in zip(_haar(image), _haar(truth), strict=False):  # two orientations",
      "pairs = zip(bands(image), bands(truth), strict=False)",
      "for (a_real, a_imaginary), (b_real, b_imaginary) in zip(a, b, strict=False):",
      "layers = [_mean(((a - b) ** 2).sum(-1)) for a, b in zip(*both, strict=False)]",
      )  # fmt: skip
_also("evaluation/metrics.py", "any number but 0 will do where its quotient or root is not taken",
      "return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.6)), 0.0)",
      "ratio = data_range**2 / jnp.where(differ, error, 1.6)",
      "part = fit.sum((-2, -1)) / jnp.where(total > 0, total, 1.6)",
      "displacement = jnp.where(visible[..., None], displacement, 0.1)",
      )  # fmt: skip
_also("evaluation/metrics.py", "both sides are equal there",
      "return jnp.where(base >= least, jnp.maximum(base, least) ** exponent, line)",
      "some = q >= 1e-6  # otherwise both images are black, and so equal",
      )  # fmt: skip
_also("evaluation/metrics.py", "a flat block has a solution with either sign",
      "least = 1e-6 * summed(down**2 + across**2) - 1e-9"
      "  # the gradient divides by its fourth power")  # fmt: skip
_also("evaluation/metrics.py", "a part is at most 1", "return root(jnp.clip(part, 0.0, 1.6))")
_also("network.py", "JAX takes the last for one beyond it",
      "return State(g1, g2), self.prediction(x)[..., 1]")  # fmt: skip
_also("checkpoint.py", "the lengths are equal",
      "for source, kernel, bias in zip(sources, kernels, biases, strict=False):")  # fmt: skip
_also("training/losses.py", "a tenth of a pixel is as good as none",
      "moved = jnp.where(visible, jnp.abs(displacements).max(-1), 0.1).max((-2, -1))",
      )  # fmt: skip
_also("simulation/curricula.py", "where there are none, their motion is not used",
      "pixels = jnp.where(is_slow, log_uniform(SLOW, kind / (slow or 2)), pixels)",
      "pixels = jnp.where(is_swift, log_uniform(SWIFT, (kind - 1 + swift) / (swift or 2)), pixels)",
      "pixels = log_uniform(motion, jnp.clip((kind - slow) / (1 - slow - swift), 0, 2))",
      )  # fmt: skip
_also("simulation/curricula.py", "one random number is as good as another, one more is not used",
      "numbers = jax.random.uniform(number_key, (3, batch))",
      "grey_key = jax.random.fold_in(number_key, 2)",
      "rest_key = jax.random.fold_in(number_key, 3)",
      "equal = jax.random.uniform(jax.random.fold_in(key, 2), rate.shape) < EQUAL_AT_REST",
      )  # fmt: skip
_also("simulation/curricula.py", "random numbers are hardly ever just that",
      "chosen = stopped & (noisy <= 0.5)", "drawn = noisy <= 0.25",
      "equal = jax.random.uniform(jax.random.fold_in(key, 1), rate.shape) <= EQUAL_AT_REST",
      "share = jnp.where(kind <= NEARLY_NOISELESS * slow, 0.02, 1.0)",
      "stopped = scenes.pauses[:, 0, 1] - scenes.pauses[:, 0, 0] >= windows * seconds",
      )  # fmt: skip
_also("simulation/sequences.py", "how many at a time is speed alone",
      "EVENTS_PER_PASS = 5  # of a pixel, in one pass over the picture: saves memory traffic",
      *(f"span = min({bins}, BINS)  # bins that votes of one rendering reach" for bins in (
          "-(-(BINS - 1) // renderings) + 3", "-(-(BINS + 1) // renderings) + 2",
          "-(-(BINS - 1) - renderings) + 2")),
      )  # fmt: skip
_also("simulation/sensor.py", "one random number is as good as another, one more is not used",
      "numbers = iter(jax.random.uniform(number_key, (7,)))",
      "off = on * (1 + settings.asymmetry * spread[1])",
      "own = settings.mismatch * jax.random.normal(mismatch_key, (3, *shape))",
      "start = jax.random.uniform(jax.random.fold_in(key, 2), shape, minval=-off, maxval=on)",
      "slope = jax.random.uniform(jax.random.fold_in(key, 5), minval=low, maxval=high)",
      "clean_key, plain_key = jax.random.split(jax.random.fold_in(key, 3))",
      "numbers = jax.random.uniform(key, (7,))",
      )  # fmt: skip
_also("simulation/sensor.py", "the other sign is as likely",
      "on, off = mean - deviation * spread",
      "off = on * (1 - settings.asymmetry * spread[0])",
      "on, off = on - own[0], off + own[1]", "on, off = on + own[0], off - own[1]",
      "on, off = THRESHOLD - SPREAD * spread",
      "noise_on = jnp.where(drawn > 0, bits % 2 != 1, noise_on)",
      "noise_on = sensor.phase * 1025 % 2 < 1",
      )  # fmt: skip
_also("simulation/sensor.py", "random numbers are hardly ever just that",
      "rate = 10.0 * 50.0**rate * jnp.where(sign <= 0.5, on, -off)",
      "drift = jnp.where(chance <= share, rate, drift)",
      "clean = jax.random.uniform(clean_key) <= settings.clean",
      "noise_on = sensor.phase * 1024 % 2 <= 1", "fires = number <= chance",
      )  # fmt: skip
_also("simulation/sensor.py", "a second is not too long",
      "longest = max(self.refractory or 1, *(self.refractory_range or (0, 0)))",
      "longest = max(self.refractory or 0, *(self.refractory_range or (1, 0)))",
      "longest = max(self.refractory or 0, *(self.refractory_range or (0, 1)))",
      )  # fmt: skip
_also("simulation/sensor.py", "one is there exactly if the other is",
      "if sensor.refractory is not None or state.silent is not None:",
      "if sensor.noise is not None or noise_on is not None:",
      )  # fmt: skip
_also("simulation/sensor.py", "a thousandth of a microsecond is not seen",
      "spacing = jnp.maximum(run.spacing, 2).astype(jnp.float32)",
      "return Run(first, spacing, count, run.polarity), jnp.maximum(silent - ticks, 1)",
      )  # fmt: skip
_also("simulation/sensor.py", "it is never 0 there",
      "drifted = jnp.where(sensor.drift >= 0, sensor.on, -sensor.off) * sensor.phase",
      "on = run.polarity[y, x][row] >= 0",
      )  # fmt: skip
_also("simulation/sensor.py", "it is written before it is read", "state, previous = None, 1")
_also("simulation/sequences.py", "after the last event nothing votes",
      "_, voted = jax.lax.while_loop(lambda carry: carry[0] <= most, several, start)",
      )  # fmt: skip
_also("simulation/sensor.py", "a bandwidth beyond all that happens",
      "cutoff=unless(jnp.array([1500000000.1, 1.0]), sensor.cutoff),"
      "  # so high that it has no effect")  # fmt: skip
_also("simulation/sensor.py", "a lamp has cycles, and nothing else has",
      "if lamp is None and cycles is None:",
      "if sensor.lamp is not None or cycles is not None:",
      )  # fmt: skip
_NO_RISE = "  # without a rise, nothing crosses: any finite value"
_also("simulation/sensor.py", "what does not fire has no time", "up = rise >= 0",
      f"size = jnp.where(size >= 0, size, 1.0){_NO_RISE}",
      f"size = jnp.where(size > 0, size, 1.6){_NO_RISE}",
      "place = jnp.where(fires, number / jnp.where(fires, chance, 1.6), 0.0)",
      "place = jnp.where(fires, number / jnp.where(fires, chance, 1.0), 0.1)",
      "first = jnp.where(count >= 0, skipped, 0.0).astype(jnp.int32) * run.spacing + run.first",
      "first = jnp.where(count > 0, skipped, 0.1).astype(jnp.int32) * run.spacing + run.first",
      "spacing = jnp.where(count > 1, stride, 0.1).astype(jnp.int32) * run.spacing",
      )  # fmt: skip
_also("simulation/sensor.py", "a tenth of a tick is cut off",
      "first = jnp.clip(jnp.round(first * scale), 0.1, ticks.astype(jnp.float32)).astype(jnp.int32)"
      )  # fmt: skip
COMPARISONS = {
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"), ast.In: ("in", "not in"), ast.NotIn: ("not in", "in"),
}  # fmt: skip
SIGNS = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "+"), ast.Div: ("/", "*"),
    ast.FloorDiv: ("//", "-"), ast.Mod: ("%", "+"), ast.Pow: ("**", "*"),
}  # fmt: skip
CONNECTIVES = {ast.And: ("and", "or"), ast.Or: ("or", "and")}


class Change(NamedTuple):
    """In one line of a module: these columns hold another text."""

    module: str
    line: int  # from 1
    begin: int
    end: int
    text: str

    def of(self, source: str) -> str:
        lines = source.splitlines(keepends=True)
        row = lines[self.line - 1].encode()  # ast counts bytes
        lines[self.line - 1] = (row[: self.begin] + self.text.encode() + row[self.end :]).decode()
        return "".join(lines)


def changes(module: str, source: str) -> list[Change]:
    """All that can be made of a module, in its order; not in types and texts, nor in errors."""
    lines, found = source.splitlines(), []

    def between(left: ast.AST, right: ast.AST, texts: tuple[str, str]) -> None:
        if left.end_lineno != right.lineno:
            return
        place = lines[left.end_lineno - 1].encode().find(texts[0].encode(), left.end_col_offset)
        if 0 <= place < right.col_offset:
            found.append(Change(module, left.end_lineno, place, place + len(texts[0]), texts[1]))

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.Raise | ast.JoinedStr | ast.Assert):
            return
        inner = list(ast.iter_child_nodes(node))
        if isinstance(node, ast.AnnAssign):
            inner = [node.value] if node.value else []
        elif isinstance(node, ast.FunctionDef):
            defaults = [one for one in node.args.kw_defaults if one is not None]
            inner = [*node.args.defaults, *defaults, *node.body]
        if isinstance(node, ast.Compare) and len(node.ops) == 1:
            between(node.left, node.comparators[0], COMPARISONS[type(node.ops[0])])
        elif isinstance(node, ast.BinOp) and type(node.op) in SIGNS:
            between(node.left, node.right, SIGNS[type(node.op)])
        elif isinstance(node, ast.BoolOp):
            between(node.values[0], node.values[1], CONNECTIVES[type(node.op)])
        elif isinstance(node, ast.Constant) and type(node.value) in (bool, int, float):
            said = {bool: not node.value, int: node.value + 1, float: 1.5 * node.value + 0.1}
            text = repr(said[type(node.value)])
            found.append(Change(module, node.lineno, node.col_offset, node.end_col_offset, text))
        for one in inner:
            visit(one)

    visit(ast.parse(source))
    return found


def chosen(seed: int, count: int) -> list[Change]:
    """So many, each module's turn after the other's."""
    rng = random.Random(seed)
    waiting = []
    for module in MODULES:
        every = changes(module, (ROOT / "firenet_jax" / module).read_text(encoding="utf-8"))
        waiting.append(rng.sample(every, min(len(every), count)))
    taken = [change for turn in zip(*waiting, strict=False) for change in turn]
    return taken[:count]


def tested(folder: Path, module: str, limit: float) -> tuple[bool, float, str]:
    """(whether the module's tests pass in this copy, seconds, what they print)"""
    tests = [f"tests/test_{name}.py" for name in MODULES[module]]
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "--slow",
        "-p",
        "no:cacheprovider",
        *tests,
    ]
    begun = time.monotonic()
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=limit
        )
    except subprocess.TimeoutExpired:
        return False, limit, ""
    return done.returncode == 0, time.monotonic() - begun, done.stdout + done.stderr


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", help="modules, such as events or metrics")
    options = parser.parse_args()
    wanted = chosen(options.seed, options.count)
    if options.only:
        wanted = [change for change in wanted if Path(change.module).stem in options.only]
    found, equivalent, survived = 0, 0, []
    limits: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("firenet_jax", "tests", "experiments", "docs"):
            shutil.copytree(ROOT / part, folder / part)
        for part in ("pyproject.toml", "README.md"):
            shutil.copy(ROOT / part, folder)
        for change in wanted:
            path = folder / "firenet_jax" / change.module
            source = path.read_text(encoding="utf-8")
            if change.module not in limits:  # they must pass as they are, or nothing is shown
                passed, seconds, said = tested(folder, change.module, 10 * LIMIT)
                if not passed:
                    print(f"{said}\n{change.module}: its tests fail without a change")
                    return 2
                limits[change.module] = max(LIMIT, 3 * seconds)
            before = source.splitlines()[change.line - 1].strip()
            after = change.of(source).splitlines()[change.line - 1].strip()
            place = f"{change.module}:{change.line}"
            if (change.module, after) in EQUIVALENT:
                equivalent += 1
                continue
            path.write_text(change.of(source), encoding="utf-8")
            passed, seconds, _ = tested(folder, change.module, limits[change.module])
            path.write_text(source, encoding="utf-8")
            found += not passed
            if passed:
                survived.append(f"{place}\n  - {before}\n  + {after}")
            print(f"{'SURVIVED' if passed else 'found':9}{seconds:6.0f} s  {place}  {after}",
                  flush=True)  # fmt: skip
    print("\n".join(survived))
    print(f"{found} of {found + len(survived)} found; {equivalent} change nothing")
    return 0


if __name__ == "__main__":
    sys.exit(main())
