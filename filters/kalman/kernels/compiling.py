"""How numba compiles the kernels, and how the compiled code is cached on disk for later processes.

numba decides by a function's own file whether its cached code is current, but kernels call functions in other files of
this package. So the cache is keyed by the text of all files here, and a change in any of them recompiles everything.
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

# No fast mathematics: with sums in any order, freshly compiled and cached code could round differently. A function that
# is not called from Python needs no wrapper, which is half of the compilation.
_OPTIONS = {"error_model": "numpy", "no_cfunc_wrapper": True}


class _UnoptimisedLibrary(JITCodeLibrary):
    """The code of a part before optimisation; optimisation and code generation happen in the kernels that call it.

    By default numba does both for every part by itself, and again within every part that calls it.
    """

    def _optimize_functions(self, ll_module: Any) -> None:
        """Leave the functions unoptimised; only set the layout of their data."""
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        """Skip the optimisation."""

    def _finalize_final_module(self) -> None:
        """Generate no machine code."""
        self._finalize_dynamic_globals()
        self._finalized = True


class _ShortPipeline(CompilerBase):
    """The numba passes these functions need: they have no closures, generators or array expressions.

    numba's default looks for those, and for code to inline, prune and unroll, in a dozen more passes over each
    function.
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


class _CachedTyping(Context):
    """numba's typing rules, with the result for each call and its argument types cached.

    Uncached, they try a dozen rules, for arrays, tuples and strings, at each product of two numbers, and once more in
    code generation.
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
        """Return the type of a value; for a function, one that caches its signatures."""
        found = super().resolve_value_type(val)
        if not isinstance(found, types.BaseFunction):
            return found
        if found not in self._cached_types:
            self._cached_types[found] = _with_cached_types(found)
        return self._cached_types[found]


def _with_cached_types(function: Any) -> Any:
    """Return a type of functions that resolves a call's signature once for each tuple of argument types."""
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
def _cached_typing(rules: Context) -> Context:
    return _CachedTyping(rules)


def _translated(dispatcher: Any, args: Any, return_type: Any, flags: Flags, library: JITCodeLibrary | None) -> Any:
    """Return numba's compilation of a function for some argument types, in its own library if ``library`` is None."""
    dispatcher.targetdescr.options.parse_as_flags(flags, dispatcher.targetoptions)
    rules = _cached_typing(dispatcher.typingctx)
    target = dispatcher.targetctx.subtarget(typing_context=rules)
    return compile_extra(rules, target, dispatcher.py_func, args, return_type, flags, {}, library, _ShortPipeline)


class _PartDispatcher(CPUDispatcher):
    """A function called by kernels, compiled only as far as they need and once for all numeric arguments.

    numba would compile it again for each constant argument.
    """

    _compiler: Any

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        super().__init__(function, targetoptions=options)
        self._compiler._compile_core = self._compile_for_callers

    def _compile_for_callers(self, args: Any, return_type: Any) -> Any:
        """Return numba's compilation of the function for some argument types."""
        flags, target = Flags(), self.targetctx
        flags.no_compile = True
        library = _UnoptimisedLibrary(target.codegen(), self.py_func.__qualname__)
        result = _translated(self, args, return_type, flags, library)
        # The key by which callers find it: numba uses the Python-callable function, which does not exist here.
        name = object()
        target.insert_user_function(name, result.fndesc, [library])
        return result._replace(entry_point=name)

    def add_overload(self, cres: Any) -> None:
        """Keep the compilation for some argument types."""
        self.overloads[tuple(cres.signature.args)] = cres

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Return the resolution of a call with some argument types."""
        return super().get_call_template([types.unliteral(arg) for arg in args], kws)


def compiled(function: Callable[..., Any]) -> Any:
    """Return a function that kernels may call; it is compiled together with the first kernel that calls it."""
    return _PartDispatcher(function, {"nopython": True, "no_cpython_wrapper": True, **_OPTIONS})


class _SourceKeyedCache(FunctionCache):
    """The cache of a function, keyed by the text of source files instead of the function's own file."""

    def __init__(self, function: Callable[..., Any], sources: str) -> None:
        super().__init__(function)
        self._cache_file = IndexDataCacheFile(
            cache_path=self._cache_path, filename_base=self._impl.filename_base, source_stamp=sources
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the cached code for some argument types, or None; a damaged cache file is discarded."""
        try:
            return super().load_overload(sig, target_context)
        except (OSError, RuntimeError):
            raise
        except Exception:  # unpickling a truncated or overwritten file can raise any exception
            self.flush()
            return None


def kept(signature: tuple[Any, ...], folder: Path = Path(__file__).parent) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function and caches the code for every process with the same source files.

    If no cache can be written (beside the file, in NUMBA_CACHE_DIR, in the user's cache), it lasts for this process.
    """

    def compile_or_load(function: Callable[..., Any]) -> Any:
        kernel = _kernel(function)
        try:
            kernel._cache = _SourceKeyedCache(function, sources_of(folder))
            with _without_collections():
                kernel.compile(signature)
        except (OSError, RuntimeError):
            kernel = _kernel(function)
            kernel.compile(signature)
        kernel.disable_compile()
        return kernel

    return compile_or_load


def _kernel(function: Callable[..., Any]) -> Any:
    """Return a function that Python may call, not yet compiled."""
    kernel = njit(**_OPTIONS)(function)
    kernel._compiler._compile_core = lambda args, return_type: _translated(kernel, args, return_type, Flags(), None)
    return kernel


@contextmanager
def _without_collections() -> Iterator[None]:
    """Disable garbage collection while compiling: it takes a quarter of the time and frees next to nothing."""
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
    """Return the log line about the compilation of a kernel, empty if its code was found in the cache."""
    if kernel.stats.cache_hits:
        return ""
    if kernel.stats.cache_path:
        return f"{name} compiled, once for this version"
    return f"{name} compiled and there is no place to keep that: NUMBA_CACHE_DIR names one"
