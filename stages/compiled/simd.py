"""Explicit vectors of unsigned bytes for numba kernels: the layer under the matcher, and its one trick for speed.

numba compiles loops over scalars, and LLVM turns them into vector code. That fails for bytes: numba widens every sum of
two bytes to 64 bits, which wastes most of the machine's lanes. Here a kernel names its vectors itself. A value of type
`Lanes(n, bits)` is n unsigned numbers of `bits` bits, and each function below is one LLVM instruction on all of them.
LLVM divides a vector into 16 (SSE), 32 (AVX2) or 64 bytes (AVX-512).

How to read a kernel that uses it:
    n = lanes_in(width)                    # a constant of the compiled code
    costs = load(row, x * n, width)        # n bytes of a uint8 array (1-D, contiguous), from index x * n on
    best = lesser(costs, broadcast(90, width))  # the same number in all lanes
    store(row, x * n, best)
The number of lanes must be known when a kernel is compiled, so it is an argument's *type*: `Width(128)` is an
object whose numba type differs from that of `Width(192)`, and numba compiles (and caches) a kernel for each width it
is called with. Sums wrap around at 256 (`plus`) or stop at 255 (`plus_capped`). Nothing checks bounds: an index
outside the array reads or overwrites foreign memory.

Lanes are held as chunks of at most 64 bytes, always a power of two: LLVM handles 192 lanes as 3 chunks of 64 well, as
one vector of 192 it takes twenty times as long.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import NativeValue, intrinsic, models, register_model, typeof_impl, unbox
from numba.np.arrayobj import make_array

MAX_CHUNK = 64
_unbox: Any = unbox
_intrinsic: Any = intrinsic(prefer_literal=True)
_tuple_of: Any = types.Tuple
_I32 = ir.IntType(32)
_I64 = ir.IntType(64)


class Lanes(types.Type):
    """The numba type of a vector: `n` unsigned integers of `bits` bits, in `count` chunks of `chunk` lanes."""

    def __init__(self, n: int, bits: int) -> None:
        self.n, self.bits = n, bits
        self.chunk = min(MAX_CHUNK, n & -n)
        self.count = n // self.chunk
        super().__init__(name=f"Lanes({n} x u{bits})")

    @property
    def key(self) -> tuple[int, int]:
        return self.n, self.bits

    @property
    def vector(self) -> ir.VectorType:
        return ir.VectorType(ir.IntType(self.bits), self.chunk)

    @property
    def whole(self) -> ir.LiteralStructType:
        return ir.LiteralStructType([self.vector] * self.count)


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Lanes) -> None:
        super().__init__(dmm, fe_type, fe_type.whole)  # type: ignore[no-untyped-call]


@dataclass(frozen=True)
class Width:
    """The number of lanes of a kernel's vectors: a multiple of 16, best a power of two or a multiple of 64."""

    lanes: int


class _WidthType(types.Type):
    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        super().__init__(name=f"Width({lanes})")


register_model(_WidthType)(models.OpaqueModel)


@typeof_impl.register(Width)
def _typeof_width(value: Width, _context: Any) -> _WidthType:
    return _WidthType(value.lanes)


@_unbox(_WidthType)
def _unbox_width(kind: Any, value: Any, c: Any) -> Any:
    nothing: Any = NativeValue  # the type holds all information
    return nothing(c.context.get_dummy_value())


@_intrinsic
def lanes_in(typing_context: Any, width: Any) -> Any:
    """The number of lanes, a constant of the compiled code."""
    return types.int64(width), lambda context, b, signature, args: _I64(width.lanes)


# Pieces of code generation: `b` is the LLVM builder.


def _chunks(b: Any, value: Any, kind: Lanes) -> list[Any]:
    return [b.extract_value(value, i) for i in range(kind.count)]


def _joined(b: Any, kind: Lanes, chunks: list[Any]) -> Any:
    value = ir.Constant(kind.whole, ir.Undefined)
    for i, chunk in enumerate(chunks):
        value = b.insert_value(value, chunk, i)
    return value


def _call(b: Any, name: str, result: Any, arguments: list[Any]) -> Any:
    """Call the LLVM intrinsic `name`."""
    signature = ir.FunctionType(result, [argument.type for argument in arguments])
    declared: Any = cgutils.get_or_insert_function
    return b.call(declared(b.module, signature, name), arguments)


def _indices(lanes: Any) -> Any:
    lanes = list(lanes)
    return ir.Constant(ir.VectorType(_I32, len(lanes)), lanes)


def _sized(b: Any, value: Any, bits: int) -> Any:
    """An integer scalar, cut or extended with zeros to `bits`."""
    width, kind = value.type.width, ir.IntType(bits)
    return b.trunc(value, kind) if width > bits else b.zext(value, kind) if width < bits else value


def _broadcast(b: Any, kind: Lanes, scalar: Any) -> Any:
    """One chunk with `scalar` in all lanes."""
    nothing = ir.Constant(kind.vector, ir.Undefined)
    first = b.insert_element(nothing, _sized(b, scalar, kind.bits), _I32(0))
    return b.shuffle_vector(first, nothing, _indices([0] * kind.chunk))


def _place(context: Any, b: Any, types_of: Any, args: Any, offset: int, kind: Any) -> Any:
    """Pointer to `kind` at element `args[1] + offset` of the array args[0]."""
    array: Any = make_array
    data = array(types_of[0])(context, b, args[0]).data
    index = context.cast(b, args[1], types_of[1], types.int64)
    return b.bitcast(b.gep(data, [b.add(index, _I64(offset))]), kind.as_pointer())


def _on_chunks(emit: Callable[[Any, Lanes, Any, Any], Any]) -> Any:
    """The intrinsic of two vectors of one type that applies `emit(b, kind, x, y)` chunk by chunk."""

    @_intrinsic
    def operation(typing_context: Any, x: Any, y: Any) -> Any:
        def generate(context: Any, b: Any, signature: Any, args: Any) -> Any:
            pairs = zip(_chunks(b, args[0], x), _chunks(b, args[1], x), strict=True)
            return _joined(b, x, [emit(b, x, p, q) for p, q in pairs])

        return x(x, y), generate

    return operation


def _named(name: str) -> Any:
    return _on_chunks(lambda b, kind, x, y: _call(b, f"llvm.{name}.v{kind.chunk}i{kind.bits}", kind.vector, [x, y]))


def _lesser(b: Any, x: Any, y: Any) -> Any:
    return _call(b, f"llvm.umin.v{x.type.count}i{x.type.element.width}", x.type, [x, y])


def _difference(b: Any, kind: Lanes, x: Any, y: Any) -> Any:
    most = _call(b, f"llvm.umax.v{kind.chunk}i{kind.bits}", kind.vector, [x, y])
    return b.sub(most, _lesser(b, x, y))


def _average(b: Any, kind: Lanes, x: Any, y: Any) -> Any:
    wide = ir.VectorType(ir.IntType(2 * kind.bits), kind.chunk)
    one = ir.Constant(wide, [1] * kind.chunk)
    total = b.add(b.add(b.zext(x, wide), b.zext(y, wide)), one)
    return b.trunc(b.lshr(total, one), kind.vector)  # LLVM knows this pattern: one instruction


lesser = _named("umin")
greater = _named("umax")
plus_capped = _named("uadd.sat")  # stops at 255
minus_capped = _named("usub.sat")  # stops at 0
plus = _on_chunks(lambda b, kind, x, y: b.add(x, y))
difference = _on_chunks(_difference)  # of the larger and the smaller
bit_xor = _on_chunks(lambda b, kind, x, y: b.xor(x, y))
bit_or = _on_chunks(lambda b, kind, x, y: b.or_(x, y))
bit_and = _on_chunks(lambda b, kind, x, y: b.and_(x, y))
average = _on_chunks(_average)  # (x + y + 1) // 2, as if in wider numbers


@_intrinsic
def load(typing_context: Any, array: Any, index: Any, width: Any) -> Any:
    """Elements of `array` from `index` on, `width` of them; lanes have the width of the elements."""
    kind = Lanes(width.lanes, array.dtype.bitwidth)

    def generate(context: Any, b: Any, signature: Any, args: Any) -> Any:
        chunks = []
        for i in range(kind.count):
            place = _place(context, b, signature.args, args, i * kind.chunk, kind.vector)
            chunks.append(b.load(place, align=1))
        return _joined(b, kind, chunks)

    return kind(array, index, width), generate


@_intrinsic
def store(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """Write the lanes to `array` from `index` on; the array's elements are as wide as the lanes."""

    def generate(context: Any, b: Any, signature: Any, args: Any) -> Any:
        for i, chunk in enumerate(_chunks(b, args[2], value)):
            place = _place(context, b, signature.args, args, i * value.chunk, value.vector)
            b.store(chunk, place, align=1)
        return context.get_dummy_value()

    return types.void(array, index, value), generate


@_intrinsic
def byte(typing_context: Any, array: Any, index: Any) -> Any:
    """One byte of `array`; like array[index], without numba's test for negative indices."""

    def generate(context: Any, b: Any, signature: Any, args: Any) -> Any:
        return b.load(_place(context, b, signature.args, args, 0, ir.IntType(8)))

    return types.uint8(array, index), generate


@_intrinsic
def broadcast(typing_context: Any, scalar: Any, width: Any) -> Any:
    """Bytes that all hold `scalar`."""
    kind = Lanes(width.lanes, 8)

    def generate(context: Any, b: Any, signature: Any, args: Any) -> Any:
        return _joined(b, kind, [_broadcast(b, kind, args[0])] * kind.count)

    return kind(scalar, width), generate


@_intrinsic
def count_up(typing_context: Any, width: Any, array: Any) -> Any:
    """The lanes 0, 1, 2, ..., as wide as the elements of `array`, in which they are to be kept."""
    kind = Lanes(width.lanes, array.dtype.bitwidth)

    def generate(context: Any, b: Any, signature: Any, args: Any) -> Any:
        starts = range(0, kind.n, kind.chunk)
        return _joined(b, kind, [ir.Constant(kind.vector, list(range(s, s + kind.chunk))) for s in starts])

    return kind(width, array), generate


@_intrinsic
def count_ones(typing_context: Any, value: Any) -> Any:
    """The number of set bits of each lane."""

    def generate(context: Any, b: Any, signature: Any, args: Any) -> Any:
        name = f"llvm.ctpop.v{value.chunk}i{value.bits}"
        return _joined(b, value, [_call(b, name, value.vector, [chunk]) for chunk in _chunks(b, args[0], value)])

    return value(value), generate


def _smallest(b: Any, kind: Lanes, value: Any) -> Any:
    """The smallest of all bytes, a scalar of 16 bits."""
    rest, size = functools.reduce(lambda x, y: _lesser(b, x, y), _chunks(b, value, kind)), kind.chunk
    while size > 16:
        size //= 2
        low, high = (b.shuffle_vector(rest, rest, _indices(range(s, s + size))) for s in (0, size))
        rest = _lesser(b, low, high)
    # Of neighbouring bytes first, then of 8 numbers of 16 bits: for these LLVM finds the one instruction of x86, as
    # long as nobody asks for less than all 16 bits of the result.
    wide = ir.VectorType(ir.IntType(16), 8)
    high = b.bitcast(b.lshr(b.bitcast(rest, wide), ir.Constant(wide, [8] * 8)), rest.type)
    return _call(b, "llvm.vector.reduce.umin.v8i16", ir.IntType(16), [b.bitcast(_lesser(b, rest, high), wide)])


def _broadcast_smallest(b: Any, kind: Lanes, least: Any) -> Any:
    """One chunk with the result of `_smallest` in all lanes, which never leaves the vector registers."""
    first = b.bitcast(b.zext(least, ir.IntType(128)), ir.VectorType(ir.IntType(8), 16))
    return b.shuffle_vector(first, first, _indices([0] * kind.chunk))


@_intrinsic
def smallest(typing_context: Any, value: Any) -> Any:
    """The smallest of all bytes, a scalar of 16 bits; to be stored as such."""
    return types.uint16(value), lambda context, b, signature, args: _smallest(b, value, args[0])


@_intrinsic
def above_smallest(typing_context: Any, value: Any) -> Any:
    """The bytes less the smallest of them."""

    def generate(context: Any, b: Any, signature: Any, args: Any) -> Any:
        least = _broadcast_smallest(b, value, _smallest(b, value, args[0]))
        return _joined(b, value, [b.sub(chunk, least) for chunk in _chunks(b, args[0], value)])

    return value(value), generate


@_intrinsic
def first_smallest(typing_context: Any, value: Any) -> Any:
    """`smallest`, and the index of the first lane that holds it."""

    def generate(context: Any, b: Any, signature: Any, args: Any) -> Any:
        least, found, mask = _smallest(b, value, args[0]), _I64(0), ir.IntType(value.chunk)
        wanted = _broadcast_smallest(b, value, least)
        for i, chunk in reversed(list(enumerate(_chunks(b, args[0], value)))):
            equal = b.bitcast(b.icmp_unsigned("==", chunk, wanted), mask)
            zeros = _call(b, f"llvm.cttz.i{value.chunk}", mask, [equal, ir.Constant(ir.IntType(1), 0)])
            here = b.add(_sized(b, zeros, 64), _I64(i * value.chunk))
            found = b.select(b.icmp_unsigned("!=", equal, ir.Constant(mask, 0)), here, found)
        return context.make_tuple(b, signature.return_type, [least, found])

    return _tuple_of((types.uint16, types.int64))(value), generate


@_intrinsic
def last_lane(typing_context: Any, value: Any) -> Any:
    """The lane that the next `shifted` up pushes out."""
    result: Any = types.Integer.from_bitwidth(value.bits, False)

    def generate(context: Any, b: Any, signature: Any, args: Any) -> Any:
        return b.extract_element(b.extract_value(args[0], value.count - 1), _I32(value.chunk - 1))

    return result(value), generate


@_intrinsic
def shifted(typing_context: Any, value: Any, fill: Any, step: Any) -> Any:
    """The lanes moved by one: up (step 1: lane i holds what was in i - 1) or down (step -1); `fill` at the free end."""
    up = step.literal_value > 0

    def generate(context: Any, b: Any, signature: Any, args: Any) -> Any:
        size, chunks, edge = value.chunk, _chunks(b, args[0], value), _broadcast(b, value, args[1])
        if up:
            pairs = zip([edge, *chunks[:-1]], chunks, strict=True)
            lanes = _indices(range(size - 1, 2 * size - 1))
        else:
            pairs = zip(chunks, [*chunks[1:], edge], strict=True)
            lanes = _indices(range(1, size + 1))
        return _joined(b, value, [b.shuffle_vector(first, second, lanes) for first, second in pairs])

    return value(value, fill, step), generate


@_intrinsic
def where_less(typing_context: Any, x: Any, y: Any, chosen: Any, otherwise: Any) -> Any:
    """Lane by lane `chosen` where x < y, else `otherwise`; the last two may be wider than the first two."""

    def generate(context: Any, b: Any, signature: Any, args: Any) -> Any:
        kinds = (x, y, chosen, otherwise)
        parts = zip(*(_chunks(b, arg, kind) for arg, kind in zip(args, kinds, strict=True)), strict=True)
        return _joined(b, chosen, [b.select(b.icmp_unsigned("<", p, q), u, v) for p, q, u, v in parts])

    return chosen(x, y, chosen, otherwise), generate


@_intrinsic
def shifted_in_memory(typing_context: Any, value: Any, array: Any, index: Any, fill: Any, step: Any) -> Any:
    """`shifted` of a value that has just been loaded from `array` at `index`: most of it is loaded again, from one byte
    before or behind, for processors load faster than they move bytes across a vector."""
    up = step.literal_value > 0

    def generate(context: Any, b: Any, signature: Any, args: Any) -> Any:
        size, chunks, edge, moved = value.chunk, _chunks(b, args[0], value), _broadcast(b, value, args[3]), []
        for i, chunk in enumerate(chunks):
            if up and i == 0:
                moved.append(b.shuffle_vector(edge, chunk, _indices(range(size - 1, 2 * size - 1))))
            elif not up and i == len(chunks) - 1:
                moved.append(b.shuffle_vector(chunk, edge, _indices(range(1, size + 1))))
            else:
                offset = i * size + (-1 if up else 1)
                moved.append(b.load(_place(context, b, signature.args[1:3], args[1:3], offset, value.vector), align=1))
        return _joined(b, value, moved)

    return value(value, array, index, fill, step), generate
