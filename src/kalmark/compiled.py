"""Compile the inner loops with numba and keep them on disk, in folders named after the sources they come from.

numba checks only the file of the function itself when it looks for a stored version, not the files of what that
function calls.  A folder therefore carries a digest of the sources: an edit or an upgrade starts afresh.

The functions that a compiled function calls are compiled into it once more.  Where that would cost much, or where not
all of it is ever needed, the call goes `by_address` instead: the callee is compiled once, alone, and only when it is
used.  The filter calls the models so, hence its code does not depend on theirs: each has a folder of its own.

Each file of compiled code ends with the SHA-256 of its name and content.  One that is damaged or cut, or
another one under its name, counts as none and is made again: what numba would take out of it might do anything.

An address is valid in the process that made it, as long as the function lives.  So it is always an argument of compiled
code, never a constant in it that the disk would keep; a copy in another process computes its own.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache, wraps
from importlib import import_module
from multiprocessing import parent_process
from pathlib import Path
from typing import Any, BinaryIO, TypeVar, cast

import llvmlite.binding
import numba
import platformdirs
from llvmlite import ir
from numba import types
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, UserProvidedCacheLocator
from numba.core.sigutils import normalize_signature
from numba.core.typing.templates import Signature
from numba.extending import intrinsic, overload
from numba.np import arrayobj

from kalmark.files import hold_lock

F = TypeVar("F", bound=Callable[..., Any])

COMPILING = "kalmark: compiling its inner loops, this once for this kind of run; it can take half a minute\n"

ERROR_WITH_SIZES = vars(arrayobj).get("raise_with_shape_context")  # of numba

LONGEST_WAIT_S = 300.0  # for another process that compiles the same function

_FUNCTIONS: dict[int, Any] = {}  # by their addresses; they are kept alive here

SOURCES = {  # what code is compiled from; of the models the filter depends on `observe` alone
    "models": ("compiled.py", "geometry/*.py", "models/*.py"),
    "filter": ("compiled.py", "geometry/*.py", "models/observe.py", "filter/**/*.py"),
    "results": ("compiled.py", "geometry/*.py", "filter/kernels.py", "results/measures.py"),
    "campaign": (
        *("compiled.py", "geometry/*.py", "models/observe.py", "models/landmark_views.py", "filter/**/*.py"),
        *("results/measures.py", "campaign/engine.py"),
    ),
}


@cache
def cache_folder(part: str) -> str:
    """Return the folder of compiled code, "models" or "filter", below ``KALMARK_CACHE`` or the user's cache."""
    digest, package = hashlib.sha256(), Path(__file__).parent
    for pattern in SOURCES[part]:
        for source in sorted(package.glob(pattern)):
            digest.update(source.read_bytes())
    root = os.environ.get("KALMARK_CACHE") or platformdirs.user_cache_dir("kalmark")
    return str(Path(root).absolute() / "compiled" / digest.hexdigest()[:16])


class _CheckedFiles(IndexDataCacheFile):  # type: ignore[misc, unused-ignore]
    """The files of one function's compiled code, which end with their checksums."""

    def save(self, key: Any, data: Any) -> None:
        """Save the code of an overload in a file that is named by its key.

        numba numbers them: two processes that save two overloads at once would give both the same number, and one of
        them would run the code of the other.
        """
        name = self._data_name(int.from_bytes(hashlib.sha256(repr(key).encode()).digest()[:8], "big"))
        self._save_data(name, data)
        self._save_index({**self._load_index(), key: name})

    def _load_index(self) -> Any:
        return super()._load_index() if _whole(self._index_path) is not None else {}

    def _load_data(self, name: str) -> Any:
        data = _whole(self._data_path(name))
        if data is None:
            raise FileNotFoundError(name)  # which numba takes for a file that was never there
        return pickle.loads(data)

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[BinaryIO]:
        if os.path.isdir(filepath):  # by some damage
            shutil.rmtree(filepath, ignore_errors=True)
        with super()._open_for_write(filepath) as file:
            content = io.BytesIO()
            yield content
            file.write(content.getvalue())
            file.write(_checksum(filepath, content.getvalue()))


def _checksum(path: str, content: bytes) -> bytes:
    return hashlib.sha256(os.path.basename(path).encode() + b"\n" + content).digest()


def _whole(path: str) -> bytes | None:
    """Return what is in a file but for its checksum, None if that is not the checksum of it."""
    try:
        data = Path(path).read_bytes()
    except OSError:
        return None
    content, checksum = data[:-32], data[-32:]
    return content if _checksum(path, content) == checksum else None


def compiled(function: F) -> F:
    """Compile `function` with numba in nopython mode, cached on disk."""
    part = function.__module__.split(".")[1]
    made = numba.njit(error_model="numpy", no_cfunc_wrapper=True)(function)
    made._cache = _OpenedLater(function, cache_folder(part if part in SOURCES else "models"))
    return made


def python_form(function: F) -> F:
    """Return the Python form of a compiled function."""
    python: F = function if numba.config.DISABLE_JIT else function.py_func  # type: ignore[attr-defined]
    return python


def form_for(model: Any, function: F) -> F:
    """Return a compiled function for a compiled model, which is a tuple, and its Python form for a user's."""
    return function if isinstance(model, tuple) else python_form(function)


def compiled_by_model(function: F) -> F:
    """Return a function of a model and more, compiled; with a user's model, which is no tuple, it runs as Python.

    Both forms of a function call it by this name.
    """
    fast = compiled(function)

    @wraps(function)
    def either(model: Any, *more: Any) -> Any:
        return (fast if isinstance(model, tuple) else function)(model, *more)

    def of_types(model: Any, *more: Any) -> Any:
        def call(model, *more):  # type: ignore[no-untyped-def]
            return fast(model, *more)

        return call if isinstance(model, types.BaseTuple) else None

    overload(either, strict=False)(of_types)
    return cast("F", either)


class _Folder(UserProvidedCacheLocator):  # type: ignore[misc, unused-ignore]
    """The folder of the cache, also where nothing can be written into it: then it is only read."""

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> _Folder:
        """Return it without a look at what may be written; numba would go elsewhere, where old code may be."""
        return cls(py_func, py_file)


class _InFolder(CompileResultCacheImpl):  # type: ignore[misc, unused-ignore]
    _locator_classes = (_Folder,)


class _OpenedLater(FunctionCache):  # type: ignore[misc, unused-ignore]
    """The cache of a function in a folder, opened when the function is first used: in one process, most never are.

    Of several processes that need the same code at once one compiles it, and the others wait for it.  A cache that is
    full, or cannot be written, is warned of: the code is there, and is compiled again the next time.
    """

    _impl_class = _InFolder

    def __init__(self, py_func: Callable[..., Any], folder: str) -> None:
        self._py_func, self._folder, self._lock = py_func, folder, ExitStack()

    def __getattr__(self, name: str) -> Any:  # of what is not there until it is opened
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, self._folder
        try:
            super().__init__(self._py_func)
            self._cache_file.__class__ = _CheckedFiles  # numba has no door for it
        finally:
            numba.config.CACHE_DIR = before
        return getattr(self, name)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return compiled code from the disk; None if this process is the one to compile it."""
        found = super().load_overload(sig, target_context)
        if found is None:
            self._lock.close()  # of one that could not be compiled
            lock = Path(self._cache_path) / f"{self._impl.filename_base}.lock"
            with suppress(OSError):
                lock.parent.mkdir(parents=True, exist_ok=True)
            self._lock.enter_context(hold_lock(lock, wait_s=LONGEST_WAIT_S))
            found = super().load_overload(sig, target_context)
            if found is not None:
                self._lock.close()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep compiled code on the disk, if that can be."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _say_not_kept(self._folder, error.strerror or str(error))
        finally:
            self._lock.close()


@cache
def _say_not_kept(folder: str, why: str) -> None:
    """Warn on stderr that code cannot be kept, once in a process."""
    if parent_process() is None:
        sys.stderr.write(
            f"kalmark: warning: compiled code cannot be kept in {folder} ({why}) and is compiled again the next time; "
            "KALMARK_CACHE can name another folder\n"
        )


@cache
def address_of(function: Any, signature: Signature) -> int:
    """Return the address of a compiled function for arguments of a signature: compiled, or loaded from disk, now.

    With ``NUMBA_DISABLE_JIT`` nothing is compiled: a number then stands for the function.
    """
    if numba.config.DISABLE_JIT:
        _FUNCTIONS[id(function)] = function
        return id(function)
    wait_for_compilation(function)
    function.compile(signature.args)
    result = function.overloads[signature.args]
    if result.signature.return_type != signature.return_type:
        raise TypeError(f"{function} returns {result.signature.return_type}, expected {signature.return_type}")
    address = int(result.library.get_pointer_to_function(result.fndesc.llvm_func_name))
    _FUNCTIONS[address] = function
    return address


@cache
def say_compiling() -> None:
    """Note on stderr that this takes longer than it will the next time; once in a process."""
    sys.stderr.write(COMPILING)


_AHEAD: dict[Any, subprocess.Popen[bytes]] = {}  # by the function that is waited for


def compile_on_second_core(function: Any, job: Callable[..., None], *arguments: str | int) -> None:
    """Call job(*arguments), which compiles `function` and more, on a second core, unless that was done before.

    Who needs one of them calls `wait_for_compilation(function)` first, and then finds them on the disk.
    """
    text = json.dumps([job.__module__, job.__name__, *arguments])
    version = f"{numba.__version__} {llvmlite.binding.get_host_cpu_name()} {sys.version} {text}"
    mark = Path(cache_folder("filter")) / f"ahead-{hashlib.sha256(version.encode()).hexdigest()[:16]}"
    if (
        numba.config.DISABLE_JIT
        or parent_process() is not None
        or (os.cpu_count() or 1) < 2
        or mark.exists()
        or function in _AHEAD
    ):
        return
    if not os.access(Path(cache_folder("filter")).parents[1], os.W_OK):
        return  # nor would this process find it
    code = "import sys; from kalmark.compiled import work_ahead; work_ahead(*sys.argv[1:])"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with suppress(OSError):  # without a second process all is compiled in this one
        command = [sys.executable, "-c", code, text, str(mark)]
        _AHEAD[function] = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)


def work_ahead(text: str, mark: str) -> None:
    """Do the job of a call of `compile_on_second_core`; the file `mark` shows that it is done."""
    module, name, *arguments = json.loads(text)
    getattr(import_module(module), name)(*arguments)
    Path(mark).touch()


def wait_for_compilation(function: Any) -> None:
    """Wait until a function is on the disk that is compiled on the second core."""
    if _AHEAD and (process := _AHEAD.pop(function, None)) is not None:
        say_compiling()
        process.wait()


def refuse_sizes(src_shapes: Any, index_shape: Any) -> None:
    """Stand for numba's error of a slice and numbers of other sizes, in compiled code."""
    raise NotImplementedError


@overload(refuse_sizes, strict=False)  # type: ignore[untyped-decorator]
def _message_without_sizes(src_shapes: Any, index_shape: Any) -> Any:
    def size_error(src_shapes: Any, index_shape: Any) -> None:
        raise ValueError("cannot assign numbers to a slice of another size")

    return size_error


class _CompilationListener(event.Listener):  # type: ignore[misc, unused-ignore]
    """Note when an inner loop is being compiled; one loaded from the disk is not, and many workers note nothing.

    Of slices it has no sizes in its errors: numba would compile its handling of text for them, in each process.
    """

    depth = 0

    def on_start(self, event: Any) -> None:
        if self._count(event, 1) and parent_process() is None:
            say_compiling()

    def on_end(self, event: Any) -> None:
        self._count(event, -1)

    def _count(self, event: Any, by: int) -> bool:
        own = str(event.data["dispatcher"].py_func.__module__).startswith("kalmark.")  # None in code of `exec`
        self.depth += by * own
        arrayobj.raise_with_shape_context = refuse_sizes if self.depth else ERROR_WITH_SIZES
        return own


event.register("numba:compile", _CompilationListener())


def by_address(signature: Signature) -> Callable[[Any, tuple[Any, ...]], Any]:
    """Return a function that calls what is at an address with a tuple of arguments, from compiled code or Python.

    In Python a function may stand for its address.
    """
    arguments_type = types.Tuple(signature.args)

    def call(address: Any, arguments: tuple[Any, ...]) -> Any:
        return _FUNCTIONS.get(address, address)(*arguments)

    @intrinsic  # type: ignore[untyped-decorator]
    def compiled_call(context: Any, address: Any, arguments: Any) -> Any:
        def generate(context: Any, builder: Any, _: Any, values: Any) -> Any:
            function = context.call_conv.get_function_type(signature.return_type, signature.args)
            pointer = builder.inttoptr(values[0], ir.PointerType(function))
            given = [builder.extract_value(values[1], i) for i in range(len(signature.args))]
            status, returned = context.call_conv.call_function(
                builder, pointer, signature.return_type, signature.args, given
            )
            with builder.if_then(status.is_error, likely=False):
                context.call_conv.return_status_propagate(builder, status)
            return returned

        return signature.return_type(types.intp, arguments_type), generate

    @overload(call, strict=False)  # type: ignore[untyped-decorator]  # strict: the annotations differ
    def compiled_form(address: Any, arguments: Any) -> Any:
        return lambda address, arguments: compiled_call(address, arguments)  # noqa: PLW0108 - numba compares the arguments

    return call


def signature_of(text: str) -> Signature:
    """Return the signature that a text like ``f8[::1](f8[:, ::1], i8)`` describes."""
    args, returned = normalize_signature(text)
    return returned(*args)
