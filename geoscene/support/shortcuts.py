"""numba's compiler with shortcuts to the same code.

numba by itself runs passes for features that our functions do not use, infers the types of an operation
anew each time that it occurs, and computes lifetimes of variables that nobody asks for.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from types import CodeType
from typing import Any

import numba
from numba.core import typed_passes, untyped_passes
from numba.core.compiler import Compiler
from numba.core.typing.templates import _OverloadFunctionTemplate

_core: Any = numba.core  # numba has no types
typed: Any = typed_passes
untyped: Any = untyped_passes
_Compiler: Any = Compiler
_Lower: Any = _core.lowering.Lower
_Lowering: Any = typed.NativeLowering
_TypeMetaclass: Any = type(_core.types.Type)
_UNROLLED = {"literal_unroll", "literally"}
_ABSENT = object()


class _PlainLower(_Lower):  # type: ignore[misc]
    """Lowers a function; variables without memory to be counted are left as they are when they die."""

    def _is_counted(self, kind: Any) -> bool:
        return bool(self.context.enable_nrt and self.context.data_model_manager[kind].contains_nrt_meminfo())

    def incref(self, typ: Any, val: Any) -> None:
        if self._is_counted(typ):
            super().incref(typ, val)

    def decref(self, typ: Any, val: Any) -> None:
        if self._is_counted(typ):
            super().decref(typ, val)

    def delvar(self, name: str) -> None:
        if self._is_counted(self.typeof(name)):
            super().delvar(name)


class _PlainLowering(_Lowering):  # type: ignore[misc]
    lowering_class = _PlainLower


def _prune(state: Any) -> None:
    """Remove branches that constants exclude."""
    _core.analysis.dead_branch_prune(state.func_ir, state.args)


def _join(state: Any) -> None:
    """Join expressions of arrays into loops, if there are any."""
    results = (signature.return_type for signature in state.calltypes.values() if signature)
    if any(isinstance(kind, _core.types.Array) for kind in results):
        typed.NopythonRewrites().run_pass(state)


_PASSES = (
    untyped.TranslateByteCode().run_pass,
    untyped.FixupArgs().run_pass,
    untyped.IRProcessing().run_pass,
    untyped.RewriteSemanticConstants().run_pass,
    _prune,
    untyped.GenericRewrites().run_pass,
    untyped.RewriteDynamicRaises().run_pass,
    untyped.ReconstructSSA().run_pass,
    _prune,
    typed.NopythonTypeInference().run_pass,
    typed.PreLowerStripPhis().run_pass,
    _join,
    typed.IRLegalization().run_pass,
    _PlainLowering().run_pass,
    typed.NoPythonBackend().run_pass,
)
"""numba's passes without those for closures, contexts, unrolled loops, inlined calls and annotation."""


class PartCompiler(_Compiler):  # type: ignore[misc]
    """numba's compiler, with fewer passes for functions that do not need the others."""

    def _compile_core(self) -> Any:
        state = self.state
        code = state.func_id.code
        if _UNROLLED & set(code.co_names) or any(isinstance(part, CodeType) for part in code.co_consts):
            return super()._compile_core()
        with _core.targetconfig.ConfigStack().enter(state.flags.copy()):
            for run in _PASSES:
                run(state)
        state.pipeline = None
        return state.cr


@contextmanager
def take_shortcuts() -> Iterator[None]:
    """Have numba take the shortcuts; for the thread that holds its lock."""
    replaced: list[tuple[Any, str, Any]] = [
        (_core.types.BaseFunction, "get_call_type", _remember_operations()),
        (_core.postproc.PostProcessor, "run", _postprocess),
        (_core.targetconfig.TargetConfig, "__eq__", _equal),
        (_TypeMetaclass, "__instancecheck__", type.__instancecheck__),
        (_core.base, "_has_loc", functools.cache(_core.base._has_loc)),
        (_core.cpu.CPUContext, "load_additional_registries", _load_registries),
        (_OverloadFunctionTemplate, "_get_jit_decorator", _decorator),
        (type(_core.errors.termcolor()), "errmsg", lambda _, message: message),
    ]
    before = [(owner, name, vars(owner).get(name, _ABSENT)) for owner, name, _ in replaced]
    try:
        for owner, name, value in replaced:
            setattr(owner, name, value)
        yield
    finally:
        for owner, name, value in before:
            if value is _ABSENT:
                delattr(owner, name)
            else:
                setattr(owner, name, value)


def _remember_operations() -> Any:
    """Infers the types of calls, of operators for each combination of types once."""
    infer = _core.types.BaseFunction.get_call_type
    operators = set(_core.utils.OPERATORS_TO_BUILTINS)
    known: dict[Any, tuple[Any, Any]] = {}

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        if kws or self.typing_key not in operators:
            return infer(self, context, args, kws)
        key = id(self), id(context), args
        if key not in known:
            known[key] = infer(self, context, args, kws), self
        return known[key][0]

    return get_call_type


_run: Any = _core.postproc.PostProcessor.run


def _postprocess(self: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:  # noqa: FBT001, FBT002
    """Postprocess numba's representation of a function, with lifetimes of variables if they are needed."""
    if emit_dels or self.func_ir.is_generator:
        _run(self, emit_dels, extend_lifetimes)
    else:
        self.func_ir.blocks = _core.transforms.canonicalize_cfg(self.func_ir.blocks)


def _equal(self: Any, other: Any) -> Any:
    """Whether two sets of options are equal; those that are set are compared first."""
    if not isinstance(other, _core.targetconfig.TargetConfig):
        return NotImplemented
    return self._values == other._values or self.values() == other.values()


def _load_registries(self: Any) -> None:
    """Install what numba's modules have registered, all of which are imported by now."""
    from numba.cpython import cmathimpl, mathimpl, printimpl, randomimpl  # noqa: PLC0415
    from numba.np import npyimpl  # noqa: PLC0415

    for module in (cmathimpl, mathimpl, npyimpl, printimpl, randomimpl):
        self.install_registry(module.registry)


def _decorator(_: Any) -> Any:
    """`numba.njit` for functions of numba, as other compiled functions call them."""
    wrappers = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    jit: Any = numba.jit
    return functools.partial(jit, pipeline_class=PartCompiler, **wrappers)
