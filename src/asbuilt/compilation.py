"""Machine code kept on disk until any of the sources that it was made from changes."""

# mypy: allow-untyped-calls

from __future__ import annotations

import glob
import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

from numba import njit, types
from numba.core.caching import FunctionCache, IndexDataCacheFile, NullCache
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.runtime.nrt import rtsys

from asbuilt.registry import pause_garbage_collection

try:
    import fcntl
except ImportError:  # Windows, where processes that start at once compile the same code
    fcntl = None  # type: ignore[assignment]

NUMBERS = {"i": types.int64, "f": types.float64, "b": types.boolean, "a": types.float64}
"""Types by their letter in a signature; `a` is `f` in arrays whose items need not be neighbours."""
OPTIONS = {"error_model": "numpy", "no_cfunc_wrapper": True, "no_rewrites": True}
"""What takes time and serves nothing here: entries for callers in C, fused arrays."""

PACKAGE = Path(__file__).parent
SHARED_PARTS = PACKAGE / "dynamics" / "kernels"
"""Folder of the parts that are inlined into kernels of other folders."""


class MachineCodeFiles(IndexDataCacheFile):
    """Keep the machine code of a function for several processes that compile it at once.

    Numba numbers the files of a function by its index, which processes read before others have
    written to it, and writes the index first. So two that compile different signatures at once give
    one number to both, and the index of a stale cache names files of the old sources until new ones
    are written: either runs code of another signature or source. Here a file is named by its
    content and written before the index. A process that is overtaken loses an entry of the index
    and compiles again.
    """

    def __init__(self, of: IndexDataCacheFile, sources: str) -> None:
        base = of._index_name.removesuffix(".nbi")
        super().__init__(of._cache_path, base, (of._source_stamp, sources))
        self._base = base

    def save(self, key: Any, data: Any) -> None:
        """Keep the code of a signature."""
        name = f"{self._base}.{hashlib.sha256(self._dump(data)).hexdigest()[:16]}.nbc"
        if Path(self._index_path).exists() and not self._load_index():
            # Its files are of other sources, which the index names no longer.
            for path in Path(self._cache_path).glob(f"{glob.escape(self._base)}.*.nbc"):
                path.unlink(missing_ok=True)
        self._save_data(name, data)
        self._save_index(self._load_index() | {key: name})


class MachineCode(FunctionCache):
    """Load machine code without the tables of what Numba can compile.

    They take a fifth of a second and 10 MB, and only a compiler reads them. What machine code calls
    is the runtime, for its arrays.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the machine code of a signature, or None."""
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


class Kernel(CPUDispatcher):
    """A function compiled for one signature, when it is first called.

    Arguments of other types are refused, so that no call ever compiles a variant. An array that is
    only read may be read-only or not. Kernels, unlike their parts, are kept on disk.
    """

    _cache: Any
    _can_compile: bool
    targetctx: Any
    overloads: Any

    announce: ClassVar[Callable[[Kernel], None] | None] = None
    """Called with each kernel that is not on disk, before it is compiled."""

    def __init__(
        self, function: Callable[..., Any], signature: str, options: Any, *, usual: bool = False
    ) -> None:
        super().__init__(function, targetoptions=options)
        self.declared = parse_types(signature)
        self.usual = usual
        try:
            self._cache = MachineCode(function)
            folders = (PACKAGE, SHARED_PARTS, Path(function.__code__.co_filename).parent)
            sources = "".join(map(digest_sources, folders))
            self._cache._cache_file = MachineCodeFiles(self._cache._cache_file, sources)
        except (RuntimeError, AttributeError):
            self._cache = NullCache()
        KERNELS.append(self)

    @property
    def is_kept(self) -> bool:
        """Whether machine code can be kept at all."""
        return not isinstance(self._cache, NullCache)

    def is_on_disk(self) -> bool:
        """Return whether the machine code is there."""
        if not self.is_kept:
            return False
        key = self._cache._index_key(self.declared, self.targetctx.codegen())
        return bool(key in self._cache._cache_file._load_index())

    def make_ready(self) -> None:
        """Load or compile."""
        with global_compiler_lock:
            if not self._can_compile:
                return
            if Kernel.announce and not self.is_on_disk():
                announce, Kernel.announce = Kernel.announce, None
                try:
                    announce(self)
                finally:
                    Kernel.announce = announce
            # Whoever waits for the lock finds the code of the process that had it.
            with self._lock(), pause_garbage_collection():
                super().compile(self.declared)
            self.disable_compile()

    @contextmanager
    def _lock(self) -> Iterator[None]:
        """Let one process of this machine compile the kernel, where its code can be kept."""
        if fcntl is None or not self.is_kept or self.is_on_disk():
            yield
            return
        cache = self._cache._cache_file
        self._cache._impl.locator.ensure_cache_path()
        with Path(cache._cache_path, f"{cache._base}.lock").open("wb") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def compile(self, sig: Any) -> Any:
        """Return the machine code, whatever the types of a call: it has one signature."""
        self.make_ready()
        return self.overloads[self.declared].entry_point

    def _compile_for_args(self, *_args: Any, **_kws: Any) -> Any:
        """Return what is called instead of a call that met no machine code: the same, once more."""
        self.make_ready()
        return self


KERNELS: list[Kernel] = []
"""All kernels of the modules imported so far."""


def kernel(
    signature: str, *, nogil: bool = True, fastmath: bool = False, usual: bool = False
) -> Callable[[Callable[..., Any]], Any]:
    """Compile for `signature` on first call, release the interpreter lock, keep the code on disk.

    A word per argument: `i` integer, `f` float, `b` truth, with the number of axes if it is an
    array; uppercase stands for arrays that are written, lowercase for read ones. Items are
    neighbours in memory, but for `a`, floats of any layout. Without `nogil` short calls are faster;
    with `fastmath` sums may be taken in another order, several terms at once. Those that nearly
    every command with a log calls are `usual`: they are compiled together.

    Numba takes kept code for current as long as the file of the function itself is unchanged,
    though functions of other files are inlined into it. Here the sources of all compiled functions
    in its folder and in `SHARED_PARTS` count too; where Numba does not let them, nothing is kept.
    """
    options = OPTIONS | {"nopython": True, "nogil": nogil, "fastmath": fastmath}
    return lambda function: Kernel(function, signature, options, usual=usual)


def part(function: Callable[..., Any]) -> Any:
    """Compile as part of kernels, from which alone it can be called."""
    compiling: Any = njit
    return compiling(function, no_cpython_wrapper=True, **OPTIONS)


def import_kernels() -> list[Kernel]:
    """Return all kernels of the package, in the same order in every process that asks first."""
    for path in sorted(PACKAGE.rglob("*.py")):
        if b"\n@kernel(" in path.read_bytes():
            import_module(".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts))
    return KERNELS


def compile_kernels(wanted: Kernel, report: Callable[[float], None]) -> None:
    """Compile a kernel, and with it the usual ones that are imported, all cores at it.

    What a command does not need is left to the commands that do: closed chains and simulations
    take most of the compiler's time. `report` gets the fraction done. A kernel that a worker could
    not compile is compiled where it is called.
    """
    from asbuilt.executor import count_cores, open_workers  # noqa: PLC0415 - only where something is compiled

    missing = [kernel for kernel in KERNELS if kernel is wanted or kernel.usual]
    missing = [each for each in missing if not each.is_on_disk()]
    report(0.0)
    count = min(len(missing), count_cores())
    if count < 2:
        return
    with open_workers(count) as workers:
        tasks = [(each.py_func.__module__, each.py_func.__name__) for each in missing]
        for done, _ in enumerate(workers.run(_compile_kernel, tasks), start=1):
            report(done / len(missing))


def _compile_kernel(place: tuple[str, str]) -> None:
    module, name = place
    getattr(import_module(module), name).make_ready()


@contextmanager
def announce_kernels(announce: Callable[[Kernel], None]) -> Iterator[None]:
    """Call `announce` before each kernel that is not on disk is compiled."""
    Kernel.announce = announce
    try:
        yield
    finally:
        Kernel.announce = None


def parse_types(signature: str) -> tuple[Any, ...]:
    """Return the types of arguments.

    >>> parse_types("i f2 F1")
    (int64, Array(float64, 2, 'C', True, aligned=True), Array(float64, 1, 'C', False, aligned=True))
    """
    return tuple(map(_parse_type, signature.split()))


def _parse_type(word: str) -> Any:
    letter = word[0]
    n_axes = word[1:]
    number: Any = NUMBERS[letter.lower()]
    if not n_axes:
        return number
    return types.Array(
        number, int(n_axes), "A" if letter == "a" else "C", readonly=letter.islower()
    )


@cache
def digest_sources(folder: Path) -> str:
    """Return a digest of all Python files of a folder that compile anything."""
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.py")):
        source = path.read_bytes()
        if b"asbuilt.compilation" in source or b"numba" in source:
            digest.update(hashlib.sha256(source).digest())
    return digest.hexdigest()
