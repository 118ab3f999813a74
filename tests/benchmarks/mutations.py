"""Which planted changes no test sees: a sampled mutation run over the mathematics; not part of the tests.

One operator, comparison or number of a module is changed at a time, in a copy of the tree, and the tests that enter the
function it stands in are run until one fails. A mutant that none of them kills is printed with its line. Survivors are
to be read: some change nothing (a tolerance, a bound that is never reached), the others name a test that is missing.

    python tests/benchmarks/mutations.py trace TRACE.json [TESTS ...]     once, and whenever the tests change
    python tests/benchmarks/mutations.py run TRACE.json COUNT [--seed 0] [--modules filters/kalman ...]
"""

import argparse
import ast
import copy
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from types import FrameType
from typing import Any, NamedTuple

PROJECT = Path(__file__).resolve().parents[2]
MODULES = ("filters", "toolkit/models", "toolkit/metrics")
TESTS = ("tests/filters", "tests/models", "tests/metrics")
TRACE_TO = "MUTATIONS_TRACE_TO"
# Of the tests that enter a function, the fastest ones that take this long together are run.
BUDGET_S, TIMEOUT_S = 25.0, 150.0
SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.Lt: ast.Gt, ast.Gt: ast.Lt, ast.LtE: ast.Lt, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.And: ast.Or, ast.Or: ast.And, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
NAMES = {"minimum": "maximum", "maximum": "minimum", "min": "max", "max": "min", "any": "all", "all": "any"}

_entered: dict[str, dict[str, Any]] = {}


class Mutant(NamedTuple):
    """A change: the module and the functions it concerns (none known: all), its line, what was and what is."""

    module: str
    functions: tuple[str, ...]
    line: int
    before: str
    after: str
    source: str


# --- as a plugin of pytest: which test enters which function


def pytest_runtest_protocol(item: Any, nextitem: Any) -> None:
    """Start to note every function of the project that the test enters; the next test starts anew."""
    del nextitem
    if TRACE_TO not in os.environ:
        return
    noted = _entered.setdefault(item.nodeid, {"functions": set(), "began_s": time.perf_counter()})
    root = str(PROJECT) + os.sep

    def note(frame: FrameType, event: str, _argument: object) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(root):
            module = frame.f_code.co_filename[len(root) :]
            noted["functions"].add(f"{module}:{frame.f_code.co_qualname.replace('.<locals>', '')}")

    sys.setprofile(note)


def pytest_runtest_logfinish(nodeid: str) -> None:
    """Stop noting."""
    if nodeid in _entered:
        sys.setprofile(None)
        _entered[nodeid]["seconds"] = time.perf_counter() - _entered[nodeid]["began_s"]


def pytest_sessionfinish() -> None:
    """Write down what was noted."""
    if TRACE_TO in os.environ:
        lines = {test: [sorted(e["functions"]), e.get("seconds", 0.0)] for test, e in _entered.items()}
        Path(os.environ[TRACE_TO]).write_text(json.dumps(lines))


# --- the mutants of a module


def mutants(module: str, source: str) -> Iterator[Mutant]:
    """Yield every change that is made to a module, one at a time."""
    tree = ast.parse(source)
    for path, node in _walk(tree, ()):
        for changed in _changes(node):
            whole = copy.deepcopy(tree)
            _put(whole, path, changed)
            functions = _concerned(tree, path)
            yield Mutant(module, functions, node.lineno, ast.unparse(node), ast.unparse(changed), ast.unparse(whole))


def _walk(node: ast.AST, path: tuple[Any, ...]) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Yield each expression with its path from the root; annotations, texts and messages of errors are left out."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "slice") or isinstance(node, ast.Raise):
            continue
        children = enumerate(value) if isinstance(value, list) else [(None, value)]
        for index, child in children:
            if isinstance(child, ast.AST):
                here = (*path, (name, index))
                if isinstance(child, ast.expr):
                    yield here, child
                yield from _walk(child, here)


def _changes(node: ast.expr) -> Iterator[ast.expr]:
    """Yield what an expression is changed to."""
    new: Any = copy.deepcopy(node)
    match node:
        case ast.BinOp(op=op) | ast.BoolOp(op=op) if type(op) in SWAPS:
            new.op = SWAPS[type(op)]()
        case ast.Compare(ops=[op]) if type(op) in SWAPS:
            new.ops = [SWAPS[type(op)]()]
        case ast.UnaryOp(op=ast.USub() | ast.Invert() | ast.Not()):
            new = new.operand
        case ast.Constant(value=bool(value)):
            new.value = not value
        case ast.Constant(value=int(value)):
            new.value = value + 1
        case ast.Constant(value=float(value)):
            new.value = 1.5 * value if value else 1.0
        case ast.Call(func=ast.Attribute(attr=name)) if name in NAMES:
            new.func.attr = NAMES[name]
        case ast.Call(func=ast.Name(id=name)) if name in NAMES:
            new.func.id = NAMES[name]
        case _:
            return
    yield new


def _put(tree: ast.AST, path: tuple[Any, ...], changed: ast.expr) -> None:
    parent: Any = tree
    for name, index in path[:-1]:
        parent = getattr(parent, name) if index is None else getattr(parent, name)[index]
    name, index = path[-1]
    if index is None:
        setattr(parent, name, changed)
    else:
        getattr(parent, name)[index] = changed


def _concerned(tree: ast.Module, path: tuple[Any, ...]) -> tuple[str, ...]:
    """Return the function that a path leads into, or those of the module that read the constant it leads to."""
    inside = ".".join(_names(tree, path))
    if inside:
        return (inside,)
    statement = tree.body[path[0][1]]
    constants = {name.id for name in ast.walk(statement) if isinstance(name, ast.Name)}
    return tuple(
        f"{outer.name}.{node.name}" if node is not outer else outer.name
        for outer in tree.body
        for node in ([outer] if isinstance(outer, ast.FunctionDef) else ast.walk(outer))
        if isinstance(outer, ast.FunctionDef | ast.ClassDef) and isinstance(node, ast.FunctionDef)
        if any(isinstance(name, ast.Name) and name.id in constants for name in ast.walk(node))
    )


def _names(tree: ast.AST, path: tuple[Any, ...]) -> Iterator[str]:
    """Yield the names of the classes and functions that a path leads through."""
    node: Any = tree
    for name, index in path:
        node = getattr(node, name) if index is None else getattr(node, name)[index]
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name


# --- the run


def tests_for(mutant: Mutant, trace: dict[str, Any]) -> list[str]:
    """Return the fastest tests that enter one of the mutant's functions, or its module where none is known."""
    whole = {f"{mutant.module}:{function}" for function in mutant.functions}

    def enters(functions: list[str]) -> bool:
        if not whole:
            return any(one.startswith(f"{mutant.module}:") and not one.endswith("<module>") for one in functions)
        return any(one in whole or one.rpartition(".")[0] in whole for one in functions)

    chosen, total_s = list[str](), 0.0
    for test, (functions, seconds) in sorted(trace.items(), key=lambda item: item[1][1]):
        if enters(functions) and (not chosen or total_s + seconds < BUDGET_S):
            chosen.append(test)
            total_s += seconds
    return chosen


def fate_of(mutant: Mutant, tests: list[str], tree: Path) -> str:
    """Put a mutant into a tree, run the tests there, and put the module back; say what became of it."""
    if not tests:
        return "entered by no test"
    path = tree / mutant.module
    original = path.read_text()
    path.write_text(mutant.source)
    try:
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
        environment = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, timeout=TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return "timed out"
    finally:
        path.write_text(original)
    return "killed" if done.returncode else "survived"


def copied(folder: Path) -> Path:
    """Copy what tests need into a folder; compiled with checked hashes, so that a changed source is never missed."""
    for name in ("toolkit", "filters", "tests", "data"):
        shutil.copytree(PROJECT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(PROJECT / "pyproject.toml", folder)
    command = [sys.executable, "-m", "compileall", "-q", "--invalidation-mode", "checked-hash", "toolkit", "filters"]
    subprocess.run(command, cwd=folder, check=True)
    return folder


def run(wanted: argparse.Namespace) -> None:
    """Try a sample of all mutants and print the survivors."""
    trace = json.loads(wanted.trace.read_text())
    files = sorted(path for name in wanted.modules for path in _sources(PROJECT / name))
    every = [m for path in files for m in mutants(str(path.relative_to(PROJECT)), path.read_text())]
    sample = random.Random(wanted.seed).sample(every, min(wanted.count, len(every)))
    print(f"{len(sample)} of {len(every)} mutants in {len(files)} modules, seed {wanted.seed}", flush=True)
    trees: Queue[Path] = Queue()
    counts = Counter[str]()

    def tried(mutant: Mutant) -> None:
        tests = tests_for(mutant, trace)
        tree = trees.get()
        try:
            fate = fate_of(mutant, tests, tree)
        finally:
            trees.put(tree)
        counts[fate] += 1
        if fate != "killed":
            where = f"{mutant.module}:{mutant.line} {' '.join(mutant.functions)}"
            print(f"{fate}: {where}: {mutant.before}  ->  {mutant.after}  [{len(tests)} tests]", flush=True)

    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(wanted.processes) as pool:
        for n in range(wanted.processes):
            trees.put(copied(Path(folder, str(n))))
        try:
            list(pool.map(tried, sample))
        except KeyboardInterrupt:  # says what it has so far, once the mutants at work are done
            pool.shutdown(cancel_futures=True)
    print(", ".join(f"{number} {fate}" for fate, number in counts.items()))


def _sources(path: Path) -> list[Path]:
    return [path] if path.is_file() else list(path.rglob("*.py"))


def trace(wanted: argparse.Namespace) -> None:
    """Run the tests once and write down which functions each enters and how long it takes."""
    path = os.pathsep.join([str(PROJECT), str(Path(__file__).parent)])
    environment = {**os.environ, "PYTHONPATH": path, TRACE_TO: str(wanted.trace.resolve())}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "mutations", *(wanted.tests or TESTS)]
    subprocess.run(command, cwd=PROJECT, env=environment, check=True)


def main(words: list[str]) -> None:
    """Trace or run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    tracing = commands.add_parser("trace")
    tracing.add_argument("trace", type=Path)
    tracing.add_argument("tests", nargs="*")
    tracing.set_defaults(work=trace)
    running = commands.add_parser("run")
    running.add_argument("trace", type=Path)
    running.add_argument("count", type=int)
    running.add_argument("--seed", type=int, default=0)
    running.add_argument("--modules", nargs="+", default=list(MODULES))
    running.add_argument("--processes", type=int, default=2)
    running.set_defaults(work=run)
    wanted = parser.parse_args(words)
    wanted.work(wanted)


if __name__ == "__main__":
    main(sys.argv[1:])
