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
from numba.core.compiler import CompilerBase, Flags, compile_extra
from numba.core.compiler_machinery import PassManager
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import (
    IRLegalization,
    NativeLowering,
    NoPythonBackend,
    NopythonTypeInference,
    PreLowerStripPhis,
)
from numba.core.typing.context import Context
from numba.core.untyped_passes import FixupArgs, GenericRewrites, IRProcessing, ReconstructSSA, TranslateByteCode

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


class _Passes(CompilerBase):
    """What numba has to do with these functions, which have no closures, generators or whole arrays in expressions.

    It would look for those, and for what to inline, prune and unroll, in a dozen more passes over each.
    """

    def define_pipelines(self) -> list[PassManager]:
        """Return the passes, in their order."""
        passes = PassManager("kernels")
        for each in (
            TranslateByteCode,
            FixupArgs,
            IRProcessing,
            GenericRewrites,
            ReconstructSSA,
            NopythonTypeInference,
            PreLowerStripPhis,
            IRLegalization,
            NativeLowering,
            NoPythonBackend,
        ):
            passes.add_pass(each, each.__name__)
        passes.finalize()
        return [passes]


class _Remembering(Context):
    """numba's rules of types, which find once what comes of a call with arguments of some types.

    They would try a dozen of them, for arrays, tuples and texts, at each product of two numbers, and once more where
    it becomes code.
    """

    def __init__(self, rules: Context) -> None:
        self.__dict__ = {**rules.__dict__, "_signatures": {}, "_cached_types": {}}

    def resolve_function_type(self, func: Any, args: Any, kws: Any) -> Any:
        """Return the signature of a call."""
        if kws or not all(isinstance(arg, types.Type) for arg in args):
            return super().resolve_function_type(func, args, kws)
        key = (func, tuple(args))
        if key not in self._signatures:
            self._signatures[key] = super().resolve_function_type(func, args, kws)
        return self._signatures[key]

    def resolve_value_type(self, val: Any) -> Any:
        """Return the type of a value, of a function one that finds each signature once."""
        found = super().resolve_value_type(val)
        if not isinstance(found, types.BaseFunction):
            return found
        if found not in self._cached_types:
            self._cached_types[found] = _with_cached_types(found)
        return self._cached_types[found]


def _with_cached_types(function: Any) -> Any:
    """Return a type of functions that finds a call's signature once for each types of its arguments."""
    copied, signatures = object.__new__(type(function)), {}

    def get_call_type(context: Context, args: Any, kws: Any) -> Any:
        if kws:
            return function.get_call_type(context, args, kws)
        if tuple(args) not in signatures:
            signatures[tuple(args)] = function.get_call_type(context, args, kws)
        return signatures[tuple(args)]

    copied.__dict__.update(function.__dict__, get_call_type=get_call_type)
    return copied


@cache
def _remembering(rules: Context) -> Context:
    return _Remembering(rules)


def _translated(dispatcher: Any, args: Any, return_type: Any, flags: Flags, library: JITCodeLibrary | None) -> Any:
    """Return what numba makes of a function for some types of its arguments, in a library of its own if None."""
    dispatcher.targetdescr.options.parse_as_flags(flags, dispatcher.targetoptions)
    rules = _remembering(dispatcher.typingctx)
    target = dispatcher.targetctx.subtarget(typing_context=rules)
    return compile_extra(rules, target, dispatcher.py_func, args, return_type, flags, {}, library, _Passes)


class _Part(CPUDispatcher):
    """What kernels call: compiled as far as they need it, once for all numbers; numba would again for each constant."""

    _compiler: Any

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        super().__init__(function, targetoptions=options)
        self._compiler._compile_core = self._compile_for_callers

    def _compile_for_callers(self, args: Any, return_type: Any) -> Any:
        """Return what numba makes of the function for some types of its arguments."""
        flags, target = Flags(), self.targetctx
        flags.no_compile = True
        library = _Unfinished(target.codegen(), self.py_func.__qualname__)
        result = _translated(self, args, return_type, flags, library)
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

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return what was kept for some types, None where there is nothing; what is damaged is thrown away."""
        try:
            return super().load_overload(sig, target_context)
        except (OSError, RuntimeError):
            raise
        except Exception:  # what unpickling makes of a file that was cut off or overwritten is of any kind
            self.flush()
            return None


def kept(signature: tuple[Any, ...], folder: Path = Path(__file__).parent) -> Callable[[Callable[..., Any]], Any]:
    """Return what compiles a function and keeps what comes out for every process that finds the folder's files so.

    Where nothing can be written (beside the file, in NUMBA_CACHE_DIR, in the user's cache) it is for this process.
    """

    def compile_or_load(function: Callable[..., Any]) -> Any:
        kernel = _kernel(function)
        try:
            kernel._cache = _KeptFor(function, sources_of(folder))
            with _without_collections():
                kernel.compile(signature)
        except (OSError, RuntimeError):
            kernel = _kernel(function)
            kernel.compile(signature)
        kernel.disable_compile()
        return kernel

    return compile_or_load


def _kernel(function: Callable[..., Any]) -> Any:
    """Return a function that Python may call, not compiled yet."""
    kernel = njit(**_OPTIONS)(function)
    kernel._compiler._compile_core = lambda args, return_type: _translated(kernel, args, return_type, Flags(), None)
    return kernel


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
