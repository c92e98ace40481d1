"""How XLA compiles jaxid's programs, and the one flag that `import jaxid` sets in the process."""

import copy
import functools
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.extend.backend
import numpy as np
from jax.core import Tracer

# JAX has no public functions for these questions. If a later version has moved them, the flag is
# set as if no backend ran. If a backend does run, the flag has no effect, and XLA's own level
# stays.
try:
    from jax._src.core import trace_state_clean as _nothing_is_traced
except ImportError:
    _nothing_is_traced = lambda: False  # noqa: E731
try:
    from jax._src.xla_bridge import backends_are_initialized as _backend_runs
except ImportError:
    _backend_runs = lambda: False  # noqa: E731

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

_EXTRA = "xla_backend_extra_options"
# LLVM's later passes, kernels that go through MLIR first, and modules split into many parts
# lengthen the compilation and do not make these programs faster.
_OPTIONS: dict[str, int | bool] = {
    "xla_backend_optimization_level": 1,
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_parallel_codegen_split_count": 1,
}
_THRESHOLD = f"--{_EXTRA}=xla_cpu_small_while_loop_byte_threshold=16777216"


def set_loop_threshold() -> None:
    """Adds to `XLA_FLAGS` the size of state, in bytes, up to which a loop becomes one kernel.

    XLA's CPU runtime calls one kernel for each operation of a loop's body, which takes five times
    as long as the physics of a few joints. Its own limit, 1 kB, is below any robot's state, and
    XLA reads this option only from the environment.

    Nothing is changed if `JAXID_SET_XLA_FLAGS` is 0, if the user has set
    `xla_backend_extra_options`, or if a backend runs, because XLA has then already read its flags.
    """
    if os.environ.get("JAXID_SET_XLA_FLAGS") == "0" or _user_sets(_EXTRA) or _backend_runs():
        return
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_THRESHOLD}".strip()


# Number of programs that a function keeps. A discovery calls most functions with a few structures.
_KEPT = 8


def compiled(
    fun: Callable[_Arguments, _Result], *, kept: int = _KEPT
) -> Callable[_Arguments, _Result]:
    """`jax.jit` for any arguments, with XLA options for the CPU that shorten compilation.

    Programs then compile in less time and run as fast (docs/process.md has numbers). An option
    that the user's `XLA_FLAGS` set is left unchanged; accelerators get none. A call inside another
    program, or under a transformation such as `jax.grad`, is compiled with the options of the
    surrounding program, since JAX refuses options there.

    Only the programs that were used last are kept. `equinox.filter_jit` and `jax.jit` keep all
    programs of a function: 400 MB for each robot of a long session.

    **Arguments:**

    - `fun`: a pure function; arrays are traced, everything else is static. So are the arrays of
      fields that a class names in `constants`: what is known of them shortens the program.
    - `kept`: number of programs that are kept.
    """
    program = functools.lru_cache(kept)(functools.partial(_Program, fun))
    making = threading.Lock()

    @functools.wraps(fun)
    def call(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        outer, outside = jax.tree.flatten((args, kwargs), is_leaf=_has_constants)
        leaves, inside = jax.tree.flatten(list(map(_as_constants, outer)))
        arrays = [x for x in leaves if _is_array(x)]
        static = tuple(None if _is_array(x) else x for x in leaves)
        kinds = tuple((np.shape(x), x.dtype) if _is_array(x) else type(x) for x in leaves)
        # Otherwise two threads could make two programs for the same arguments.
        with making:
            one = program(outside, inside, static, kinds, _nothing_is_traced())
        return one(arrays)

    return call


class _Program:
    """A function as a program for arguments of one structure; one thread compiles it.

    **Arguments:**

    - `fun`: the function.
    - `outside`, `inside`: structures of its arguments around and within modules with constants.
    - `static`: leaves that are not arrays, with None for each array.
    - `kinds`: shape and type of each leaf, to distinguish programs.
    - `outermost`: False inside another program.
    """

    def __init__(
        self,
        fun: Callable[..., Any],
        outside: Any,
        inside: Any,
        static: tuple[Any, ...],
        kinds: tuple[Any, ...],
        outermost: bool,
    ):
        # The part of the result that is not arrays, known when the function has been traced.
        self._rest: Any = None

        def by_arrays(arrays: list[Any]) -> Any:
            left = iter(arrays)
            leaves = [next(left) if x is None else x for x in static]
            modules = map(_as_arrays, jax.tree.unflatten(inside, leaves))
            args, kwargs = jax.tree.unflatten(outside, modules)
            found, self._rest = eqx.partition(fun(*args, **kwargs), eqx.is_array)
            return found

        # By which profiles and caches of compiled programs call it.
        by_arrays.__name__ = by_arrays.__qualname__ = fun.__name__
        options = _options() if outermost else {}
        given: dict[str, Any] = {"compiler_options": options} if options else {}
        self._jitted, self._outermost = jax.jit(by_arrays, **given), outermost
        self._first, self._ready = threading.RLock(), False

    def __call__(self, arrays: list[Any]) -> Any:
        if self._ready:
            found = self._jitted(arrays)
        else:
            with self._first:
                found = self._jitted(arrays)
            self._ready = True
        return eqx.combine(jax.block_until_ready(found) if self._outermost else found, self._rest)


def _is_array(x: Any) -> bool:
    return isinstance(x, jax.Array | np.ndarray | np.generic)


class _Constant:
    """Arrays as a part of the program; equal if they have the same structure and values."""

    def __init__(self, tree: Any):
        leaves, structure = jax.tree.flatten(tree)
        arrays = [np.asarray(leaf) for leaf in leaves]
        self.tree = jax.tree.unflatten(structure, arrays)
        self.key = structure, tuple((x.shape, x.dtype.str, x.tobytes()) for x in arrays)

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, _Constant) and self.key == other.key


def _has_constants(tree: Any) -> bool:
    """Whether a module names fields that are `constants` of compiled programs."""
    return bool(getattr(type(tree), "constants", ()))


def _as_constants(module: Any) -> Any:
    """A module with its constants as a part of the program; anything else is left unchanged."""
    names = getattr(type(module), "constants", ())
    fields = {name: vars(module)[name] for name in names}
    if not names or any(isinstance(x, Tracer) for x in jax.tree.leaves(fields)):
        return module
    return _with_fields(module, {name: _Constant(value) for name, value in fields.items()})


def _as_arrays(module: Any) -> Any:
    """The inverse of `_as_constants`, within the program."""
    names = getattr(type(module), "constants", ())
    fields = {n: x.tree for n in names if isinstance(x := vars(module)[n], _Constant)}
    return _with_fields(module, fields) if fields else module


def _with_fields(module: Any, fields: dict[str, Any]) -> Any:
    """A copy of a module with other values of some fields, past its converters and checks."""
    made = copy.copy(module)
    vars(made).update(fields)
    return made


@functools.cache
def _options() -> dict[str, int | bool]:
    """Compiler options for the programs of this process; starts the backends."""
    if set(jax.extend.backend.backends()) != {"cpu"}:
        return {}
    return {name: value for name, value in _OPTIONS.items() if _is_ours(name, value)}


def _is_ours(option: str, value: int | bool) -> bool:
    """Whether the user has not set an option, and this version of XLA knows it."""
    if _user_sets(option):
        return False
    try:
        jax.jit(lambda: 0, compiler_options={option: value}).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def _user_sets(flag: str) -> bool:
    """Whether `XLA_FLAGS` has the flag, or names a file of flags, which may have it."""
    flags = os.environ.get("XLA_FLAGS", "").strip()
    return flag in flags or (flags != "" and not flags.startswith("-"))


def keep_programs(folder: str | Path | None = None) -> None:
    """Keeps compiled programs between processes, because compilation takes most of the time.

    The command `jaxid` does so by itself. If JAX already has a cache, it is left unchanged.

    **Arguments:**

    - `folder`: for the programs; by default `jaxid` in the user's cache folder.
    """
    if getattr(jax.config, "jax_compilation_cache_dir", None) is not None:
        return
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    jax.config.update("jax_compilation_cache_dir", str(folder or base / "jaxid"))
    # Small programs are kept too: a fit has dozens, and each takes longer to compile than to read.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
