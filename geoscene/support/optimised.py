"""Compiler of numba that optimises a function together with all that it calls, once.

numba by itself optimises and assembles each function, and optimises it again in all that call it.
"""

from __future__ import annotations

from typing import Any

from llvmlite.binding import Linkage, create_new_module_pass_manager
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.environment import lookup_environment

_Library: Any = JITCodeLibrary
_Compiler: Any = Compiler
_lookup_environment: Any = lookup_environment  # numba has no types


class _Linked(_Library):  # type: ignore[misc]
    """Code of a function and of what it calls, optimised together, once.

    numba optimises and assembles each function, and optimises it again in all that call it.
    """

    def _optimize_functions(self, ll_module: Any) -> None:
        """Set the layout of data; functions are optimised when all are linked."""
        ll_module.data_layout = self._codegen._data_layout

    def add_linking_library(self, library: Any) -> None:
        """Take the code of a function that is called."""
        self._linking_libraries.append(library)

    def finalize(self) -> None:
        """Link, optimise and assemble the code, and set the constants that errors of its functions name."""
        self._link()
        self._simplify()
        self._optimize_final_module()
        self._final_module.verify()
        self._finalize_final_module()
        for variable in self._final_module.global_variables:
            environment = _lookup_environment(variable.name)
            if environment is not None:
                self._codegen.set_env(variable.name, environment)

    def _link(self) -> None:
        for library in _called(self):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(_copy_module(library))

    def _simplify(self) -> None:
        """Put the variables of all functions into registers before functions are inlined into others."""
        passes = create_new_module_pass_manager()
        passes.add_sroa_pass()
        passes.add_instruction_combine_pass()
        passes.add_simplify_cfg_pass()
        passes.run(self._final_module, self._codegen._pass_builder())


class _Unassembled(_Linked):
    """Code of a function that only others call: neither optimised nor assembled by itself."""

    @property
    def codegen(self) -> Any:
        """Where the code has no address."""
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """Do nothing: callers set the constants in their copy of the code."""

    def get_pointer_to_function(self, name: str) -> int:  # noqa: ARG002
        """0, of no address."""
        return 0


def _called(library: Any) -> list[Any]:
    """Libraries that a library calls, directly or not."""
    found: dict[int, Any] = {}
    todo = list(library._linking_libraries)
    while todo:
        one = todo.pop(0)
        if id(one) not in found:
            found[id(one)] = one
            if not one._finalized:
                todo += one._linking_libraries
    return list(found.values())


def _copy_module(library: Any) -> Any:
    """A copy of a library's module for others, which drop the functions that they do not call."""
    if library._finalized:
        return library._get_module_for_linking().clone()
    module = library._final_module.clone()
    for function in module.functions:
        if not function.is_declaration and function.linkage == Linkage.external:
            function.linkage = "linkonce_odr"
    return module


class OwnCompiler(_Compiler):  # type: ignore[misc]
    """numba's compiler, which optimises the compiled function and all that it calls together."""

    def compile_extra(self, func: Any) -> Any:
        """Compile a function for the types that this was made for."""
        codegen = self.state.targetctx.codegen()
        self.state.library = _Linked(codegen, func.__qualname__)
        self.state.library.enable_object_caching()
        before, codegen._library_class = codegen._library_class, _Unassembled
        try:
            return super().compile_extra(func)
        finally:
            codegen._library_class = before
