"""Explicit vectors for the kernels: a vector fills a register of 512 bits with one number of each of several cells.

Numba's vectoriser stores intermediate values between loops to memory and gathers one number at a time. The kernels
therefore use explicit vectors. On a processor with narrower registers a vector takes several registers. All functions
also work in plain Python on numpy arrays, which is used to count operations. Indices are unsigned (numba.uint64).
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, register_model

BITS = 512
#: Lanes of one batch of gathered cells: of a vector of the narrowest numbers.
BATCH = BITS // 32
# Fused multiply-adds and reassociation are allowed. NaN and infinity are kept, because the monitor detects them.
FAST = {"contract", "nsz", "arcp", "reassoc"}
_FLAGS = tuple(sorted(FAST))


class Lanes(types.Type):
    """Numba's type of a vector of numbers of some floating-point type."""

    def __init__(self, dtype: types.Float) -> None:
        self.dtype = dtype
        self.width = BITS // dtype.bitwidth
        super().__init__(name=f"Lanes({dtype})")


@register_model(Lanes)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, lanes: Lanes) -> None:
        value = manager.lookup(lanes.dtype).get_value_type()
        super().__init__(manager, lanes, ir.VectorType(value, lanes.width))


# ---------------------------------------------------------------- the functions in plain Python


def width(row):  # type: ignore[no-untyped-def]
    """Number of lanes of a vector of the numbers in this array."""
    return np.uint64(8 if row.dtype == object else BITS // 8 // row.dtype.itemsize)


def broadcast(number, row):  # type: ignore[no-untyped-def]
    """The same number in all lanes, with the type of the numbers in `row`."""
    return np.full(width(row), number, row.dtype)


def load(row, first):  # type: ignore[no-untyped-def]
    """The vector row[first], row[first + 1], ... without a check of the bounds."""
    return row[first : first + width(row)].copy()


def store(row, first, lanes):  # type: ignore[no-untyped-def]
    """row[first], row[first + 1], ... <- lanes."""
    row[first : first + width(row)] = lanes


def gather(row, nodes, first):  # type: ignore[no-untyped-def]
    """The vector row[nodes[first]], row[nodes[first + 1]], ...; nodes are uint32 below 2^31."""
    return row[nodes[first : first + width(row)]]


def scatter(row, nodes, first, lanes):  # type: ignore[no-untyped-def]
    """row[nodes[first]] += the first lane, and so on in this order; nodes may repeat."""
    for node, number in zip(nodes[first : first + width(row)], lanes, strict=True):
        row[node] += number


def prefetch(batch):  # type: ignore[no-untyped-def]
    """Prefetch an array of two dimensions into the cache."""


def select_first(n, lanes, others):  # type: ignore[no-untyped-def]
    """`lanes` in the first n lanes, and `others` in the remaining lanes."""
    return np.where(np.arange(len(lanes)) < n, lanes, others)


def shift(before, lanes):  # type: ignore[no-untyped-def]
    """The last lane of `before`, followed by all lanes of `lanes` but its last."""
    return np.concatenate([before[-1:], lanes[:-1]])


def last(lanes):  # type: ignore[no-untyped-def]
    """The number in the last lane."""
    return lanes[-1]


def minimum(a, b):  # type: ignore[no-untyped-def]
    """The minimum of two numbers in each lane; the first number if one of them is NaN."""
    return np.where(b < a, b, a)


def smallest(lanes):  # type: ignore[no-untyped-def]
    """The smallest number of all lanes."""
    return lanes.min()


def load_each(rows, count, first):  # type: ignore[no-untyped-def]
    """`load` of each of the first `count` rows (count, :), as a tuple; `count` is a constant."""
    return tuple(load(rows[i], first) for i in range(count))


def broadcast_each(columns, count, column, n, row):  # type: ignore[no-untyped-def]
    """The first `count` numbers of a column of (count, :), each in the first n lanes with 0 in the others, as a tuple.

    `count` is a constant.
    """
    zeros = broadcast(row.dtype.type(0), row)
    return tuple(select_first(n, broadcast(columns[i, column], row), zeros) for i in range(count))


# ---------------------------------------------------------------- the functions in LLVM

_Lower = Callable[[Any, Any, Any, Any], Any]
_I32, _I64 = ir.IntType(32), ir.IntType(64)


def _typed(function: Any, result: Callable[..., types.Type | None]) -> None:
    """Register the result type of a function by its argument types; None where the function does not apply."""

    class Template(AbstractTemplate):
        def generic(self, arguments: Any, keywords: Any) -> Any:
            made = result(*arguments)
            return None if made is None else signature(made, *arguments)

    infer_global(function)(Template)


def _in_lanes(builder: Any, number: Any, lanes: Any) -> Any:
    """A number in all lanes of an LLVM vector type."""
    single = builder.insert_element(ir.Constant(lanes, ir.Undefined), number, ir.Constant(_I32, 0))
    order = ir.Constant(ir.VectorType(_I32, lanes.count), [0] * lanes.count)
    return builder.shuffle_vector(single, ir.Constant(lanes, ir.Undefined), order)


def _elementwise(function: Any, combine: Callable[[Any, Any, Any], Any]) -> None:
    """A function of two vectors, or of one and a number, which takes the type of the vector's numbers.

    combine: (builder, a, b) -> the LLVM value of two vectors.
    """

    def result(a: types.Type, b: types.Type) -> types.Type | None:
        if isinstance(a, Lanes):
            return a if b == a or isinstance(b, types.Float | types.Integer) else None
        return b if isinstance(b, Lanes) and isinstance(a, types.Float | types.Integer) else None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        lanes, number = context.get_value_type(sig.return_type), sig.return_type.dtype
        a, b = (
            x if isinstance(t, Lanes) else _in_lanes(builder, context.cast(builder, x, t, number), lanes)
            for x, t in zip(args, sig.args, strict=True)
        )
        return combine(builder, a, b)

    _typed(function, result)
    numbers = (types.Float, types.Integer)
    for pair in ((Lanes, Lanes), *((Lanes, n) for n in numbers), *((n, Lanes) for n in numbers)):
        lower_builtin(function, *pair)(lower)


_elementwise(operator.add, lambda builder, a, b: builder.fadd(a, b, flags=_FLAGS))
_elementwise(operator.sub, lambda builder, a, b: builder.fsub(a, b, flags=_FLAGS))
_elementwise(operator.mul, lambda builder, a, b: builder.fmul(a, b, flags=_FLAGS))
_elementwise(operator.truediv, lambda builder, a, b: builder.fdiv(a, b, flags=_FLAGS))
# The first number if one of them is NaN, as in `minimum`.
_elementwise(np.maximum, lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), b, a))


def _of(row: types.Type) -> Lanes | None:
    """The vector type of a contiguous array."""
    if isinstance(row, types.Array) and isinstance(row.dtype, types.Float) and row.layout == "C":
        return Lanes(row.dtype)
    return None


_typed(width, lambda row: types.uint64 if _of(row) else None)
_typed(broadcast, lambda number, row: _of(row))
_typed(load, lambda row, first: _of(row))
_typed(store, lambda row, first, lanes: types.none if lanes == _of(row) else None)
_typed(gather, lambda row, nodes, first: _of(row))
_typed(scatter, lambda row, nodes, first, lanes: types.none if lanes == _of(row) else None)
_typed(prefetch, lambda batch: types.none if isinstance(batch, types.Array) else None)
_typed(select_first, lambda n, lanes, others: lanes if lanes == others and isinstance(lanes, Lanes) else None)
_typed(shift, lambda before, lanes: lanes if before == lanes and isinstance(lanes, Lanes) else None)
_typed(last, lambda lanes: lanes.dtype if isinstance(lanes, Lanes) else None)
_typed(minimum, lambda a, b: a if a == b and isinstance(a, Lanes) else None)
_typed(smallest, lambda lanes: lanes.dtype if isinstance(lanes, Lanes) else None)
for _function in (np.abs, np.sqrt, np.log):
    _typed(_function, lambda lanes: lanes if isinstance(lanes, Lanes) else None)


def _several(lanes: Lanes | None, count: types.Type) -> types.Type | None:
    """A tuple of `count` vectors; None if `count` is not a constant."""
    return types.UniTuple(lanes, count.literal_value) if lanes and isinstance(count, types.IntegerLiteral) else None


_typed(load_each, lambda rows, count, first: _several(_of(rows), count))
_typed(broadcast_each, lambda columns, count, column, n, row: _several(_of(row), count))


def _pointer(context: Any, builder: Any, row_type: Any, row: Any, first: Any) -> Any:
    """Pointer to the element `first` of an array."""
    data = context.make_array(row_type)(context, builder, row).data
    return builder.gep(data, [first])


def _vector_pointer(context: Any, builder: Any, row_type: Any, row: Any, first: Any, width: int) -> tuple[Any, int]:
    """Pointer to a vector of elements from `first` on, and its alignment."""
    element = context.get_data_type(row_type.dtype)
    place = _pointer(context, builder, row_type, row, first)
    return builder.bitcast(place, ir.VectorType(element, width).as_pointer()), row_type.dtype.bitwidth // 8


@lower_builtin(width, types.Array)
def _width(context, builder, sig, args):  # type: ignore[no-untyped-def]
    return ir.Constant(_I64, Lanes(sig.args[0].dtype).width)


@lower_builtin(broadcast, types.Float, types.Array)
def _broadcast(context, builder, sig, args):  # type: ignore[no-untyped-def]
    number = context.cast(builder, args[0], sig.args[0], sig.return_type.dtype)
    return _in_lanes(builder, number, context.get_value_type(sig.return_type))


@lower_builtin(load, types.Array, types.Integer)
def _load(context, builder, sig, args):  # type: ignore[no-untyped-def]
    place, align = _vector_pointer(context, builder, sig.args[0], args[0], args[1], sig.return_type.width)
    return builder.load(place, align=align)


@lower_builtin(store, types.Array, types.Integer, Lanes)
def _store(context, builder, sig, args):  # type: ignore[no-untyped-def]
    place, align = _vector_pointer(context, builder, sig.args[0], args[0], args[1], sig.args[2].width)
    builder.store(args[2], place, align=align)
    return context.get_dummy_value()


@lower_builtin(gather, types.Array, types.Array, types.Integer)
def _gather(context, builder, sig, args):  # type: ignore[no-untyped-def]
    n = sig.return_type.width
    vector = context.get_value_type(sig.return_type)
    many = ir.VectorType(_I64, n)
    place, align = _vector_pointer(context, builder, sig.args[1], args[1], args[2], n)
    nodes = builder.sext(builder.load(place, align=align), many)
    base = builder.ptrtoint(context.make_array(sig.args[0])(context, builder, args[0]).data, _I64)
    size = ir.Constant(_I64, sig.return_type.dtype.bitwidth // 8)
    places = builder.add(_in_lanes(builder, base, many), builder.mul(nodes, _in_lanes(builder, size, many)))
    pointers = builder.inttoptr(places, ir.VectorType(vector.element.as_pointer(), n))
    mask = ir.VectorType(ir.IntType(1), n)
    name = f"llvm.masked.gather.v{n}f{sig.return_type.dtype.bitwidth}.v{n}p0"
    kind = ir.FunctionType(vector, [pointers.type, _I32, mask, vector])
    call = cgutils.get_or_insert_function(builder.module, kind, name)
    every = ir.Constant(mask, [ir.Constant(ir.IntType(1), 1)] * n)
    align = ir.Constant(_I32, sig.return_type.dtype.bitwidth // 8)
    return builder.call(call, [pointers, align, every, ir.Constant(vector, ir.Undefined)])


@lower_builtin(scatter, types.Array, types.Array, types.Integer, Lanes)
def _scatter(context, builder, sig, args):  # type: ignore[no-untyped-def]
    for lane in range(sig.args[3].width):
        which = builder.add(args[2], ir.Constant(args[2].type, lane))
        node = builder.load(_pointer(context, builder, sig.args[1], args[1], which))
        place = _pointer(context, builder, sig.args[0], args[0], builder.zext(node, _I64))
        number = builder.extract_element(args[3], ir.Constant(_I32, lane))
        builder.store(builder.fadd(builder.load(place), number), place)
    return context.get_dummy_value()


@lower_builtin(prefetch, types.Array)
def _prefetch(context, builder, sig, args):  # type: ignore[no-untyped-def]
    array = context.make_array(sig.args[0])(context, builder, args[0])
    n = builder.mul(array.nitems, array.itemsize)
    byte = ir.IntType(8).as_pointer()
    data = builder.bitcast(array.data, byte)
    kind = ir.FunctionType(ir.VoidType(), [byte, _I32, _I32, _I32])
    call = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
    with cgutils.for_range_slice(builder, ir.Constant(n.type, 0), n, ir.Constant(n.type, 64)) as (at, _):
        hints = [ir.Constant(_I32, value) for value in (0, 3, 1)]
        builder.call(call, [builder.gep(data, [at]), *hints])
    return context.get_dummy_value()


def _first_lanes(builder: Any, n: Any, width: int) -> Any:
    """Which of so many lanes are the first n."""
    numbers = ir.VectorType(_I64, width)
    return builder.icmp_unsigned("<", ir.Constant(numbers, list(range(width))), _in_lanes(builder, n, numbers))


@lower_builtin(select_first, types.Integer, Lanes, Lanes)
def _select_first(context, builder, sig, args):  # type: ignore[no-untyped-def]
    return builder.select(_first_lanes(builder, args[0], sig.return_type.width), args[1], args[2])


@lower_builtin(shift, Lanes, Lanes)
def _shift(context, builder, sig, args):  # type: ignore[no-untyped-def]
    n = sig.return_type.width
    order = ir.Constant(ir.VectorType(_I32, n), [n - 1 + lane for lane in range(n)])
    return builder.shuffle_vector(args[0], args[1], order)


@lower_builtin(last, Lanes)
def _last(context, builder, sig, args):  # type: ignore[no-untyped-def]
    return builder.extract_element(args[0], ir.Constant(_I32, sig.args[0].width - 1))


@lower_builtin(minimum, Lanes, Lanes)
def _minimum(context, builder, sig, args):  # type: ignore[no-untyped-def]
    return builder.select(builder.fcmp_ordered("<", args[1], args[0]), args[1], args[0])


@lower_builtin(smallest, Lanes)
def _smallest(context, builder, sig, args):  # type: ignore[no-untyped-def]
    found = builder.extract_element(args[0], ir.Constant(_I32, 0))
    for lane in range(1, sig.args[0].width):
        number = builder.extract_element(args[0], ir.Constant(_I32, lane))
        found = builder.select(builder.fcmp_ordered("<", number, found), number, found)
    return found


def _unary(name: str) -> _Lower:
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector = context.get_value_type(sig.return_type)
        kind = ir.FunctionType(vector, [vector])
        full = f"llvm.{name}.v{sig.return_type.width}f{sig.return_type.dtype.bitwidth}"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, full), args)

    return lower


lower_builtin(np.abs, Lanes)(_unary("fabs"))
lower_builtin(np.sqrt, Lanes)(_unary("sqrt"))
# The processor has no logarithm of a vector: LLVM calls that of the mathematical library for each lane.
lower_builtin(np.log, Lanes)(_unary("log"))


@lower_builtin(load_each, types.Array, types.IntegerLiteral, types.Integer)
def _load_each(context, builder, sig, args):  # type: ignore[no-untyped-def]
    rows_type, count, _ = sig.args
    row_length = context.make_array(rows_type)(context, builder, args[0]).shape
    length = builder.extract_value(row_length, rows_type.ndim - 1)
    loaded = []
    for row in range(count.literal_value):
        start = builder.add(builder.mul(length, ir.Constant(length.type, row)), args[2])
        place, align = _vector_pointer(context, builder, rows_type, args[0], start, sig.return_type.dtype.width)
        loaded.append(builder.load(place, align=align))
    return context.make_tuple(builder, sig.return_type, loaded)


@lower_builtin(broadcast_each, types.Array, types.IntegerLiteral, types.Integer, types.Integer, types.Array)
def _broadcast_each(context, builder, sig, args):  # type: ignore[no-untyped-def]
    columns_type, count = sig.args[:2]
    length = builder.extract_value(context.make_array(columns_type)(context, builder, args[0]).shape, 1)
    vector = context.get_value_type(sig.return_type.dtype)
    chosen = _first_lanes(builder, args[3], vector.count)
    made = []
    for row in range(count.literal_value):
        start = builder.add(builder.mul(length, ir.Constant(length.type, row)), args[2])
        number = builder.load(_pointer(context, builder, columns_type, args[0], start))
        made.append(builder.select(chosen, _in_lanes(builder, number, vector), ir.Constant(vector, None)))
    return context.make_tuple(builder, sig.return_type, made)
