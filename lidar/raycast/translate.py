"""Functions that numba compiles, as functions of Warp: one source for the CPU and for devices.

The source of a function is rewritten where Warp reads Python otherwise than numba: numbers are of 64 bits (of
32, if whole), operands of both kinds may meet, and arrays among the globals come with the arguments.
Functions that it calls are translated with it.
"""

from __future__ import annotations

import ast
import functools
import inspect
import linecache
import textwrap
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

_GLOBALS = "globals_"
"""Argument of all translated functions: the arrays among the globals of their modules."""

_MIXED = """
@wp.func
def {name}(a: Any, b: Any):
    return wp.{name}(a, b)
@wp.func
def {name}(a: wp.float64, b: wp.int32):
    return wp.{name}(a, wp.float64(b))
@wp.func
def {name}(a: wp.int32, b: wp.float64):
    return wp.{name}(wp.float64(a), b)
"""
_OTHERS = """
@wp.func
def div(a: wp.int32, b: wp.int32):
    return wp.float64(a) / wp.float64(b)
@wp.func
def mod(a: Any, b: Any):
    x, y = wp.float64(a), wp.float64(b)
    return x - y * wp.floor(x / y)
@wp.func
def mod(a: wp.int32, b: wp.int32):
    return wp.mod(wp.add(wp.mod(a, b), b), b)
@wp.func
def bit_and(a: Any, b: Any):
    return wp.bit_and(wp.int32(a), wp.int32(b))
@wp.func
def uint32(a: Any):
    return wp.uint32(wp.int64(a))
@wp.func
def fill(a: Any, value: Any):
    for k in range(a.shape[0]):
        a[k] = value
"""
_NAMES = ("add", "sub", "mul", "div", "pow", "min", "max")
_ARITHMETIC = "".join(_MIXED.format(name=name) for name in _NAMES) + _OTHERS
"""What Warp calls for operators, by their names beside the function: whole numbers meet reals, quotients are
reals, and remainders have the sign of the divisor."""

_CALLS = {"abs": "wp.abs", "float": "wp.float64", "int": "wp.int32", "bool": "wp.bool"}
_CALLS |= {"float32": "wp.float32", "uint32": "uint32"}
"""Python's and NumPy's functions, by what stands for them; those of `math` have the same name in Warp."""


class Translation:
    """Translated functions, which share a module of Warp.

    functions : of Warp, by the functions of numba that they are made of
    arrays    : the globals that they use, by name
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.functions: dict[Any, Any] = {}
        self.arrays: dict[str, NDArray[Any]] = {}
        wp.set_module_options({"enable_backward": False}, wp.get_module(name))
        self._operators = self._defined(_ARITHMETIC, "arithmetic", names={})

    def of(self, function: Any, given: Mapping[str, Sequence[str]] | None = None) -> Any:
        """The function of Warp for one of numba; it has `arrays` as an additional last argument.

        given : of arguments that are tuples with arrays for numba, what each item is for Warp, which has no
                such tuples: a field of the argument, such as ``view.origin``, or an array to work in.
                Functions that it calls have arguments of these names for these tuples, too
        """
        if function not in self.functions:
            source = function.py_func
            definition = ast.parse(textwrap.dedent(inspect.getsource(source))).body[0]
            names = dict(self._operators)
            rewritten = _Rewriter(self, source, names=names, given=given or {}).visit(definition)
            text = ast.unparse(ast.fix_missing_locations(rewritten))
            self.functions[function] = self._defined(text, _own_name(source), names=names)[_own_name(source)]
        return self.functions[function]

    def struct(self) -> Any:
        """A struct of Warp for `arrays`."""
        kinds = {
            name: wp.array(dtype=wp.dtype_from_numpy(array.dtype), ndim=array.ndim)
            for name, array in self.arrays.items()
        }
        return wp.struct(type("Globals", (), {"__annotations__": kinds, "__module__": self.name}))

    def _defined(self, text: str, label: str, *, names: Mapping[str, Any]) -> dict[str, Any]:
        """The functions of Warp that a text defines, by name; several of a name are overloads."""
        file = f"<{self.name} {label}>"
        linecache.cache[file] = len(text), None, text.splitlines(keepends=True), file
        scope = {**names, "wp": wp, "Any": Any, "__name__": self.name}
        exec(compile(text, file, "exec"), scope)  # noqa: S102 - the source of these packages
        return {name: value for name, value in scope.items() if isinstance(value, wp.Function)}


def _own_name(source: Any) -> str:
    """The name of a translated function, with that of its module."""
    return _identifier(f"{source.__module__}.{source.__name__}")


def _identifier(name: str) -> str:
    return name.replace(".", "_")


class _Rewriter(ast.NodeTransformer):
    """Rewrites the definition of a function.

    names : what its globals are for Warp, filled by the way
    """

    def __init__(
        self,
        translation: Translation,
        source: Any,
        *,
        names: dict[str, Any],
        given: Mapping[str, Sequence[str]],
    ) -> None:
        self.translation, self.names = translation, names
        self.name, self.globals = _own_name(source), source.__globals__
        self.locals = set(source.__code__.co_varnames)
        self.given = given
        self.temporaries = 0

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        """All arguments of any type, without decorators and the docstring."""
        body = node.body[1:] if ast.get_docstring(node) else node.body
        arguments = [a.arg for a in node.args.args] + [_GLOBALS]
        node.args.args = [ast.arg(name, _load("Any")) for name in arguments]
        node.body = self._all(body)
        node.decorator_list, node.returns = [_expression("wp.func")], None
        node.name = self.name
        return node

    def _all(self, statements: list[ast.stmt]) -> list[ast.stmt]:
        """Statements, each of which may become several."""
        found: list[ast.stmt] = []
        for statement in statements:
            new = self.visit(statement)
            found.extend(new if isinstance(new, list) else [new])
        return found

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        """Reals are of 64 bits; whole numbers of 32 by themselves."""
        return _literal(node.value) if isinstance(node.value, float) else node

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Globals are constants, or arrays of the last argument."""
        if node.id in self.locals or node.id not in self.globals:
            return node
        return self._value(self.globals[node.id], f"{self.globals['__name__']}.{node.id}")

    def visit_Attribute(self, node: ast.Attribute) -> ast.expr:
        """Those of modules are constants; others fields."""
        home = self._global(node.value)
        if isinstance(home, ModuleType):
            return self._value(getattr(home, node.attr), f"{home.__name__}.{node.attr}")
        node.value = self.visit(node.value)
        return node

    def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
        """Items of global tuples are constants."""
        whole = self._global(node.value)
        if isinstance(whole, tuple):
            return self._value(whole[ast.literal_eval(node.slice)], "")
        return self.generic_visit(node)  # type: ignore[return-value]

    def visit_Call(self, node: ast.Call) -> ast.expr:
        """Functions of Python, of modules, and of numba, which are translated."""
        function = self._global(node.func)
        name = node.func.attr if isinstance(node.func, ast.Attribute) else ast.unparse(node.func)
        arguments: list[ast.expr] = [self.visit(argument) for argument in node.args]
        if isinstance(function, Dispatcher):
            label = _own_name(function.py_func)
            self.names[label] = self.translation.of(function, self.given)
            return _call(label, [*arguments, _load(_GLOBALS)])
        if name == "len":
            return _expression(f"{ast.unparse(arguments[0])}.shape[0]")
        if name == "range":
            return _call(name, arguments)
        if name == "uint32" and isinstance(node.args[0], ast.Constant):
            return _literal(np.uint32(ast.literal_eval(node.args[0])))
        if name in ("min", "max"):
            return functools.reduce(lambda a, b: _call(name, [a, b]), arguments)
        return _call(_CALLS.get(name, f"wp.{name}"), arguments)

    def visit_Compare(self, node: ast.Compare) -> ast.expr:
        """One comparison after the other: Warp chains those of one type only."""
        terms = [self.visit(term) for term in (node.left, *node.comparators)]
        parts: list[ast.expr] = [
            ast.Compare(a, [op], [b]) for a, op, b in zip(terms, node.ops, terms[1:], strict=False)
        ]
        return parts[0] if len(parts) == 1 else ast.BoolOp(ast.And(), parts)

    def visit_Return(self, node: ast.Return) -> list[ast.stmt]:
        """Tuples are returned as such, not as several results, which would be no arguments."""
        if not isinstance(node.value, ast.Tuple):
            return [ast.Return(self.visit(node.value))] if node.value else [node]
        name = self._temporary()
        return [self._single(_store(name), node.value), ast.Return(_load(name))]

    def visit_AugAssign(self, node: ast.AugAssign) -> list[ast.stmt]:
        """As an assignment."""
        before = _expression(ast.unparse(node.target))
        return self.visit_Assign(ast.Assign([node.target], ast.BinOp(before, node.op, node.value)))

    def visit_Assign(self, node: ast.Assign) -> list[ast.stmt]:
        """One by one, with temporary names where several are set at once."""
        value = node.value
        if len(node.targets) > 1:
            return [new for target in node.targets for new in self.visit_Assign(ast.Assign([target], value))]
        (target,) = node.targets
        if isinstance(value, ast.Name) and value.id in self.given and isinstance(target, ast.Tuple):
            items = [_expression(text) for text in self.given[value.id]]
            given = zip(target.elts, items, strict=True)
            return [ast.Assign([to], item) for to, item in given if ast.unparse(to) != "_"]
        if isinstance(target, ast.Tuple):
            if (
                isinstance(value, ast.IfExp)
                and isinstance(value.body, ast.Tuple)
                and isinstance(value.orelse, ast.Tuple)
            ):
                pairs = zip(value.body.elts, value.orelse.elts, strict=True)
                value = ast.Tuple([ast.IfExp(value.test, a, b) for a, b in pairs], ast.Load())
            if isinstance(value, ast.Subscript):  # the row of an array
                row = ast.unparse(value).removesuffix("]")
                items = [_expression(f"{row}, {k}]") for k in range(len(target.elts))]
                value = ast.Tuple(items, ast.Load())
            if isinstance(value, ast.Tuple):
                names = [self._temporary() for _ in value.elts]
                first = map(self._single, map(_store, names), value.elts)
                then = map(self._single, target.elts, map(_load, names))
                return [*first, *then]
        return [self._single(target, value)]

    def _single(self, target: ast.expr, value: ast.expr) -> ast.stmt:
        """An assignment to one name or item, or of one tuple."""
        new = self.visit(value)
        if isinstance(target, ast.Subscript):
            if isinstance(target.slice, ast.Slice):
                return ast.Expr(_call("fill", [self.visit(target.value), new]))
            array = ast.unparse(target.value)
            return ast.Assign([self.visit(target)], _call(f"{array}.dtype", [new]))
        if isinstance(new, ast.Constant) and isinstance(new.value, int) and not isinstance(new.value, bool):
            new = _call("wp.int32", [new])  # a variable, which loops may change
        return ast.Assign([target], new)

    def _temporary(self) -> str:
        self.temporaries += 1
        return f"new{self.temporaries}_"

    def _global(self, node: ast.expr) -> Any:
        """Value of a global or of a module's attribute; None for other names."""
        if isinstance(node, ast.Name) and node.id not in self.locals:
            return self.globals.get(node.id)
        if isinstance(node, ast.Attribute) and isinstance(home := self._global(node.value), ModuleType):
            return getattr(home, node.attr)
        return None

    def _value(self, value: Any, name: str) -> ast.expr:
        """A global of numba for Warp."""
        if isinstance(value, np.ndarray):
            field = _identifier(name)
            self.translation.arrays[field] = value
            return ast.Attribute(_load(_GLOBALS), field, ast.Load())
        return _literal(value)


def _literal(value: Any) -> ast.expr:
    """A number of numba's type for it; Python integers have 32 bits."""
    if isinstance(value, np.uint32):
        return _call("uint32", [_literal(int(value.astype(np.int32)))])
    if isinstance(value, float):
        text = "wp.INF" if value == np.inf else repr(value)
        return _call("wp.float64", [_expression(text)])
    return ast.Constant(value)


def _call(name: str, arguments: list[ast.expr]) -> ast.Call:
    return ast.Call(_expression(name), arguments, [])


def _expression(text: str) -> ast.expr:
    return ast.parse(text, mode="eval").body


def _load(name: str) -> ast.Name:
    return ast.Name(name, ast.Load())


def _store(name: str) -> ast.Name:
    return ast.Name(name, ast.Store())
