"""How numba compiles the kernels, and how what comes out is kept on disk for later processes.

numba looks at a function's own file alone to tell whether what it kept of it is that of today, and a kernel calls
others of this package: so what is kept belongs to the text of all files here, and a change in any compiles all anew.
"""

import gc
import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from numba import njit, types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Flags, compile_extra
from numba.core.registry import CPUDispatcher
from numba.core.typing.context import Context

Arrays = tuple[Any, ...]
ROW, MATRIX, STACK = types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]
MASK, COUNTS = types.boolean[:, ::1], types.int64[:, ::1]
# Poses (W, 4, 4), poses to linearise at (W, 4, 4), covariance of their errors (6 W, 6 W).
WINDOW = types.Tuple((STACK, STACK, MATRIX))
# fx, fy, cx, cy px and baseline m (5,); T_imu_cam (1, 4, 4); whitener (3, 3); variances (3, 3) px^2 of white noise,
# walk and offset, a channel a column, and the channels (3, 3), both (0, 3) where the noise of tracks is white.
CAMERA = types.Tuple((ROW, STACK, MATRIX, MATRIX, MATRIX))

# No fast mathematics: were sums taken in any order, what a process has compiled and what it has found on disk would
# round another way. What is not called from Python needs no wrapper for it, which is half of the compilation.
_OPTIONS = {"error_model": "numpy", "no_cfunc_wrapper": True}


class _Unfinished(JITCodeLibrary):
    """The code of a part as numba writes it: optimised and made machine code within the kernels that call it alone.

    Otherwise both are done for every part by itself, too, and again within every part that calls it.
    """

    def _optimize_functions(self, ll_module: Any) -> None:
        """Leave the functions as they are, but for the layout of their data."""
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        """Leave the code as it is."""

    def _finalize_final_module(self) -> None:
        """Make no machine code."""
        self._finalize_dynamic_globals()
        self._finalized = True


class _Remembering(Context):
    """numba's rules of types, which are asked once what comes of a call with arguments of some types.

    They would try a dozen of them, for arrays, tuples and texts, at each product of two numbers.
    """

    def __init__(self, rules: Context) -> None:
        self.__dict__ = {**rules.__dict__, "_signatures": {}}

    def resolve_function_type(self, func: Any, args: Any, kws: Any) -> Any:
        """Return the signature of a call."""
        if kws or not all(isinstance(arg, types.Type) for arg in args):
            return super().resolve_function_type(func, args, kws)
        key = (func, tuple(args))
        if key not in self._signatures:
            self._signatures[key] = super().resolve_function_type(func, args, kws)
        return self._signatures[key]


@cache
def _remembering(rules: Context) -> Context:
    return _Remembering(rules)


class _Part(CPUDispatcher):
    """What kernels call: compiled as far as they need it, once for all numbers; numba would again for each constant."""

    _compiler: Any

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        super().__init__(function, targetoptions=options)
        self._compiler._compile_core = self._compile_for_callers

    def _compile_for_callers(self, args: Any, return_type: Any) -> Any:
        """Return what numba makes of the function for some types of its arguments."""
        flags = Flags()
        self.targetdescr.options.parse_as_flags(flags, self.targetoptions)
        flags.no_compile = True
        rules, target = _remembering(self.typingctx), self.targetctx
        library = _Unfinished(target.codegen(), self.py_func.__qualname__)
        result = compile_extra(rules, target, self.py_func, args, return_type, flags, {}, library)
        # By which callers find it: numba takes the function that Python would call, and there is none.
        name = object()
        target.insert_user_function(name, result.fndesc, [library])
        return result._replace(entry_point=name)

    def add_overload(self, cres: Any) -> None:
        """Remember what was compiled for some types."""
        self.overloads[tuple(cres.signature.args)] = cres

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Return what a call with arguments of some types is resolved to."""
        return super().get_call_template([types.unliteral(arg) for arg in args], kws)


def compiled(function: Callable[..., Any]) -> Any:
    """Return a function that kernels may call, compiled together with the first of them that is."""
    return _Part(function, {"nopython": True, "no_cpython_wrapper": True, **_OPTIONS})


class _KeptFor(FunctionCache):
    """What is kept of a function for as long as some sources stay what they are, wherever its own file is."""

    def __init__(self, function: Callable[..., Any], sources: str) -> None:
        super().__init__(function)
        self._cache_file = IndexDataCacheFile(
            cache_path=self._cache_path, filename_base=self._impl.filename_base, source_stamp=sources
        )


def kept(signature: tuple[Any, ...], folder: Path = Path(__file__).parent) -> Callable[[Callable[..., Any]], Any]:
    """Return what compiles a function and keeps what comes out for every process that finds the folder's files so.

    Where nothing can be written (beside the file, in NUMBA_CACHE_DIR, in the user's cache) it is for this process.
    """

    def compile_or_load(function: Callable[..., Any]) -> Any:
        kernel = njit(**_OPTIONS)(function)
        try:
            kernel._cache = _KeptFor(function, sources_of(folder))
            with _without_collections():
                kernel.compile(signature)
        except (OSError, RuntimeError):
            kernel = njit(**_OPTIONS)(function)
            kernel.compile(signature)
        kernel.disable_compile()
        return kernel

    return compile_or_load


@contextmanager
def _without_collections() -> Iterator[None]:
    """Compile without looking for reference cycles, which takes a quarter of the time and frees next to nothing."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def sources_of(folder: Path) -> str:
    """Return a digest of all modules of a folder."""
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.py")):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def what_was_compiled(kernel: Any, name: str) -> str:
    """Return what is told of the compilation of a kernel, empty where its result was found on disk."""
    if kernel.stats.cache_hits:
        return ""
    if kernel.stats.cache_path:
        return f"{name} compiled, once for this version"
    return f"{name} compiled and there is no place to keep that: NUMBA_CACHE_DIR names one"
