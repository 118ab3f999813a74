"""Whatever happens to a valid file: it is read, or refused in one line; no warning, no traceback, nothing half-written.

Source of the method: MacIver, Hatfield-Dodds & others, "Hypothesis: A new approach to property-based testing" (JOSS
2019). The examples are the same in every run.
"""

import io
import re
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.internal.conjecture import providers

from tests.contracts.conftest import Files
from toolkit import datasets
from toolkit.cli import main
from toolkit.datasets import load_references, load_sequence
from toolkit.datasets.trajectories import read_poses
from toolkit.errors import VislamError

Original = Callable[[str], Files]
Test = Callable[..., None]
VALUES = ("nan", "inf", "-inf", "0", "-1", "1e300", "-1e300", "1e-300", "1e19", "99999999999999999999", "", "x", "null")
VALUES += ("true", "{}", "[[1], 2]", '"\\u001b[2J"', f'"{5000 * "y"}"')
_DTYPES = ("f4", "i8", "u1", "c16", "U8", "?", "i2")
_NUMBER = re.compile(rb"-?\d[\d.eE+-]*")


@pytest.fixture(scope="module", autouse=True)
def _no_numbers_of_modules() -> Iterator[None]:
    """Keep Hypothesis from drawing numbers out of the modules that are loaded, which the tests before decide."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(providers, "_get_local_constants", providers.Constants)
        yield


@dataclass(frozen=True)
class Mutation:
    """One thing that happens to a file: what kind, in which of the files, where in it, and which value comes in."""

    kind: str
    file: int
    where: int
    value: int


def mutations(kinds: tuple[str, ...]) -> st.SearchStrategy[list[Mutation]]:
    """Return one or two mutations of some kinds."""
    whole = st.integers(0, 1_000_000)
    one = st.builds(Mutation, st.sampled_from(kinds), st.integers(0, 9), whole, st.integers(0, 999))
    return st.lists(one, min_size=1, max_size=2)


RAW: dict[str, Callable[[bytes, Mutation], bytes]] = {
    "cut": lambda data, m: data[: m.where % (len(data) + 1)],
    "flip": lambda data, m: _with_byte(data, m.where, m.value),
    "twice": lambda data, m: data + data[m.where % (len(data) + 1) :],
    "number": lambda data, m: _number_replaced(data, m.where, m.value),
    "line": lambda data, m: _without_line(data, m.where),
    "cell": lambda data, m: data.replace(b",", (b" ", b";", b",,")[m.value % 3], 1 + m.where % 5),
}
ARRAYS = ("drop", "rename", "dtype", "value", "all", "shape", "empty", "halve")


def mutated(files: Files, happened: list[Mutation]) -> Files:
    """Return the files after what happened to them."""
    changed = dict(files)
    for mutation in happened:
        name = sorted(changed)[mutation.file % len(changed)]
        data = changed[name]
        if mutation.kind in RAW:
            changed[name] = RAW[mutation.kind](data, mutation)
        elif mutation.kind == "gone" and len(changed) > 1:
            del changed[name]
        elif mutation.kind in ARRAYS:
            changed[name] = _through_arrays(data, mutation)
    return changed


def _with_byte(data: bytes, where: int, value: int) -> bytes:
    if not data:
        return bytes([value % 256])
    at = where % len(data)
    return data[:at] + bytes([data[at] ^ (1 + value % 255)]) + data[at + 1 :]


def _number_replaced(data: bytes, where: int, value: int) -> bytes:
    found = list(_NUMBER.finditer(data))
    if not found:
        return data
    at = found[where % len(found)]
    return data[: at.start()] + VALUES[value % len(VALUES)].encode() + data[at.end() :]


def _without_line(data: bytes, where: int) -> bytes:
    lines = data.splitlines(keepends=True)
    at = where % max(len(lines), 1)
    return b"".join(lines[:at] + lines[at + 1 :])


def _through_arrays(data: bytes, m: Mutation) -> bytes:
    """Change one array of an npz, a pickled npy or a Matlab file; what is none of them stays."""
    is_npz, is_mat, is_npy = (data.startswith(magic) for magic in (b"PK", b"MATLAB", b"\x93NUMPY"))
    if not (is_npz or is_mat or is_npy):
        return data
    try:
        if is_npy:
            read = np.load(io.BytesIO(data), allow_pickle=True).item()
        else:
            read = np.load(io.BytesIO(data)) if is_npz else scipy.io.loadmat(io.BytesIO(data))
        arrays = {key: np.array(read[key]) for key in read if not key.startswith("__")}
    except Exception:  # an earlier mutation has spoilt it
        return data
    key = sorted(arrays)[m.where % len(arrays)]
    array = arrays.pop(key)
    if m.kind != "drop":
        arrays[key + "_" if m.kind == "rename" else key] = _changed(array, m)
    out = io.BytesIO()
    if is_npy:
        np.save(out, arrays, allow_pickle=True)
    elif is_npz:
        np.savez(out, **arrays)
    else:
        scipy.io.savemat(out, arrays)
    return out.getvalue()


def _changed(array: np.ndarray, m: Mutation) -> np.ndarray:
    value = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e300, 1e-300, 1e19, 1e6)[m.value % 9]
    if m.kind in ("value", "all") and array.size and array.dtype.kind in "fiu":
        new = array.astype(float)
        new[... if m.kind == "all" else np.unravel_index(m.where % array.size, array.shape)] = value
        return new
    changed = array
    if m.kind == "dtype":
        with np.errstate(all="ignore"), warnings.catch_warnings(), suppress(ValueError):
            warnings.simplefilter("ignore")
            changed = array.astype(_DTYPES[m.value % len(_DTYPES)])
        # Otherwise an earlier mutation has made texts of it, which are no numbers.
    if m.kind == "shape":
        return (array.T, array.ravel(), array[None], np.array(0.0))[m.value % 4]
    if m.kind == "empty":
        return array[:0] if array.ndim else array
    if m.kind == "halve":
        return array[..., : array.shape[-1] // 2] if array.ndim else array
    return changed


def write(files: Files, place: Path) -> Path:
    """Write a recording to a place, a folder or a file, and return it."""
    if set(files) == {""}:
        place.write_bytes(files[""])
        return place
    place.mkdir()
    for name, data in files.items():
        (place / name).write_bytes(data)
    return place


KINDS = (*RAW, *ARRAYS, "gone")
# A message may quote a path and a value; a page of them is none that anybody reads.
LONGEST_MESSAGE = 1000
RECORDINGS = ("course", "course npy", "own tables", "utias", "openvins", "lean euroc", "vislam drive", "vislam flight")
TRAJECTORIES = ("tum file", "kitti file", "euroc file", "openvins file")


def mutating(names: tuple[str, ...], kinds: tuple[str, ...], count: int) -> Callable[[Test], Test]:
    """Return what gives a test the ``name`` of each original and, for each, so many times what ``happened`` to it."""
    examples = settings(
        max_examples=count,
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.differing_executors],
    )
    return lambda test: pytest.mark.parametrize("name", names)(given(happened=mutations(kinds))(examples(test)))


def read_or_refused(read: Callable[[Path], object], files: Files) -> None:
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("error")
        path = write(files, Path(folder) / "given")
        try:
            read(path)
        except VislamError as refusal:
            assert "\n" not in str(refusal)
            assert len(str(refusal)) < LONGEST_MESSAGE
            assert refusal.exit_status in (2, 3)


def _load(path: Path) -> None:
    load_sequence(str(path))
    load_references(str(path))


@pytest.mark.parametrize("name", RECORDINGS)
def test_what_is_not_mutated_is_read_by_one_format_whatever_it_is_called(
    original: Original, tmp_path: Path, name: str
) -> None:
    path = write(original(name), tmp_path / "given.npz")
    assert sum(reader.recognises(path) for reader in datasets._readers().values()) == 1
    _load(path)


@mutating(RECORDINGS, KINDS, 80)
def test_a_mutated_recording_is_read_or_refused_in_one_line(
    original: Original, name: str, happened: list[Mutation]
) -> None:
    read_or_refused(_load, mutated(original(name), happened))


@mutating(TRAJECTORIES, tuple(RAW), 70)
def test_a_mutated_trajectory_is_read_or_refused_in_one_line(
    original: Original, name: str, happened: list[Mutation]
) -> None:
    read_or_refused(read_poses, mutated(original(name), happened))


@mutating(RECORDINGS, KINDS, 15)
def test_the_command_line_survives_a_mutated_recording(
    original: Original, name: str, happened: list[Mutation], capfd: pytest.CaptureFixture[str]
) -> None:
    """What is told is at most one line, the status one that is documented, the rest whole."""
    files = mutated(original(name), happened)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("error")
        path, out = write(files, Path(folder) / "given"), Path(folder) / "run"
        words = ("compare", str(path), "--estimators", "dead-reckoning", "--max-frames", "4", "--workers", "1")
        words += ("--figures", "none")
        status = main([*words, "--out", str(out)])
        messages = capfd.readouterr()
        assert status in (0, 1, 3), messages.err
        assert messages.err.count("\n") == (status == 3)
        assert messages.out.replace("\n", " ").isprintable()
        entries = {entry.name for entry in Path(folder).iterdir()}
        assert entries == ({"given"} if status == 3 else {"given", "run"})
        assert (out / "manifest.json").is_file() == (status != 3)
        shutil.rmtree(out, ignore_errors=True)
