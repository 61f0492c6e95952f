"""Products of small matrices with sums in registers, features first: (features, rows) in float32."""

from collections.abc import Sequence
from typing import Any

from headway_algos.kernels.compiled import ZERO, Floats, compiled  # isort: skip - sets numba up
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np import arrayobj

LANES = 16 if binding.get_host_cpu_features().get("avx512f") else 8
"""Number of float32 in a vector."""
TILE = 3 * LANES
"""Number of rows that are multiplied together."""
# Products are computed in tiles whose sums stay in registers: 4 x 3 vectors of sums and the vectors that are
# multiplied take the 16 registers of AVX2. LLVM does not find such loops by itself, so they are given in its
# own language.
Untyped = Any
"""Object of numba or llvmlite, which have no types for mypy."""
_Vector = ir.VectorType(ir.FloatType(), LANES)


def _number(value: int) -> Untyped:
    return ir.Constant(ir.IntType(64), value)


def _arrays(context: Untyped, builder: Untyped, signature: Untyped, given: Untyped) -> list[Untyped]:
    """Return the first three arguments of a function, which are arrays."""
    pairs = zip(signature.args[:3], given[:3], strict=True)
    return [arrayobj.make_array(kind)(context, builder, array) for kind, array in pairs]


def _place(builder: Untyped, array: Untyped, row: Untyped, column: Untyped) -> Untyped:
    """Return the address of the vector at array[row, column]."""
    _, columns = cgutils.unpack_tuple(builder, array.shape)
    start = builder.gep(array.data, [builder.add(builder.mul(row, columns), column)])
    return builder.bitcast(start, _Vector.as_pointer())


def _sums(builder: Untyped, count: int) -> list[Untyped]:
    """Return `count` variables that hold vectors of 0."""
    sums = [cgutils.alloca_once(builder, _Vector) for _ in range(count)]
    for variable in sums:
        builder.store(ir.Constant(_Vector, [0.0] * LANES), variable)
    return sums


def _add_to(builder: Untyped, variable: Untyped, a: Untyped, b: Untyped) -> None:
    product = builder.fmul(a, b, flags=["contract"])
    builder.store(builder.fadd(builder.load(variable), product, flags=["contract"]), variable)


def _shuffled(builder: Untyped, a: Untyped, b: Untyped, lanes: Sequence[int]) -> Untyped:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), list(lanes)))


def _product_tile(outs: int, vectors: int) -> Untyped:
    """Return f(w, x, y, (start, step_out, step_in, ins, o, t)), which writes `outs` x `vectors` vectors of

    y[o + j, t + s] = sum_i w[start + j step_out + i step_in] x[i, t + s],   i < ins
    """

    def tile(_: Untyped, w: Untyped, x: Untyped, y: Untyped, numbers: Untyped) -> Untyped:
        def lower(context: Untyped, builder: Untyped, signature: Untyped, given: Untyped) -> Untyped:
            w, x, y = _arrays(context, builder, signature, given)
            start, step_out, step_in, ins, o, t = cgutils.unpack_tuple(builder, given[3])
            columns = [builder.add(t, _number(v * LANES)) for v in range(vectors)]
            sums = _sums(builder, outs * vectors)
            with cgutils.for_range(builder, ins) as loop:
                inputs = [builder.load(_place(builder, x, loop.index, column), align=4) for column in columns]
                for j in range(outs):
                    steps = [builder.mul(_number(j), step_out), builder.mul(loop.index, step_in)]
                    weight = builder.load(builder.gep(w.data, [builder.add(start, builder.add(*steps))]))
                    first = builder.insert_element(ir.Constant(_Vector, ir.Undefined), weight, _number(0))
                    weights = _shuffled(builder, first, first, [0] * LANES)
                    for v in range(vectors):
                        _add_to(builder, sums[j * vectors + v], weights, inputs[v])
            for j in range(outs):
                for v in range(vectors):
                    place = _place(builder, y, builder.add(o, _number(j)), columns[v])
                    builder.store(builder.load(sums[j * vectors + v]), place, align=4)
            return context.get_dummy_value()

        return types.void(w, x, y, numbers), lower

    return intrinsic(tile)


def _outer_tile(columns: int) -> Untyped:
    """Return f(x, g, w, (i, o, vectors, start, ins)), which adds, for r < 4 and c < `columns`,

    w[start + (o + c) ins + i + r] += sum_t x[i + r, t] g[o + c, t],   t < vectors LANES
    """

    def tile(_: Untyped, x: Untyped, g: Untyped, w: Untyped, numbers: Untyped) -> Untyped:
        def lower(context: Untyped, builder: Untyped, signature: Untyped, given: Untyped) -> Untyped:
            x, g, w = _arrays(context, builder, signature, given)
            i, o, vectors, start, ins = cgutils.unpack_tuple(builder, given[3])
            sums = _sums(builder, 4 * columns)
            with cgutils.for_range(builder, vectors) as loop:
                t = builder.mul(loop.index, _number(LANES))
                places = [_place(builder, g, builder.add(o, _number(c)), t) for c in range(columns)]
                factors = [builder.load(place, align=4) for place in places]
                for r in range(4):
                    row = builder.load(_place(builder, x, builder.add(i, _number(r)), t), align=4)
                    for c in range(columns):
                        _add_to(builder, sums[4 * c + r], row, factors[c])
            for c in range(columns):
                totals = _four_totals(builder, [builder.load(sums[4 * c + r]) for r in range(4)])
                column = builder.mul(builder.add(o, _number(c)), ins)
                place = builder.gep(w.data, [builder.add(builder.add(start, i), column)])
                place = builder.bitcast(place, totals.type.as_pointer())
                builder.store(builder.fadd(builder.load(place, align=4), totals), place, align=4)
            return context.get_dummy_value()

        return types.void(x, g, w, numbers), lower

    return intrinsic(tile)


def _four_totals(builder: Untyped, vectors: list[Untyped]) -> Untyped:
    """Return a vector of the totals of four vectors."""
    even = [q + lane for q in range(0, LANES, 4) for lane in (0, 2, LANES, LANES + 2)]
    while len(vectors) > 1:  # add neighbours within four lanes, so that two vectors become one
        vectors = [
            builder.fadd(*(_shuffled(builder, u, v, [lane + k for lane in even]) for k in (0, 1)))
            for u, v in zip(vectors[::2], vectors[1::2], strict=True)
        ]
    total, width = vectors[0], LANES
    while width > 4:
        width //= 2
        low, high = (_shuffled(builder, total, total, range(k, k + width)) for k in (0, width))
        total = builder.fadd(low, high)
    return total


_product_4x3, _product_4x2, _product_4x1, _product_1x3, _product_1x2, _product_1x1 = (
    _product_tile(outs, vectors) for outs in (4, 1) for vectors in (3, 2, 1)
)
_outer_4x3, _outer_4x1 = _outer_tile(3), _outer_tile(1)


@compiled
def multiply(
    w: Floats, start: int, step_out: int, step_in: int, outs: int, ins: int, x: Floats, y: Floats, n: int
) -> None:
    """Compute y[o, t] = sum_i w[start + o step_out + i step_in] x[i, t], for t < n."""
    for t in range(0, n, TILE):
        multiply_tile(w, start, step_out, step_in, outs, ins, x, y, t, n)


@compiled
def multiply_tile(
    w: Floats,
    start: int,
    step_out: int,
    step_in: int,
    outs: int,
    ins: int,
    x: Floats,
    y: Floats,
    t: int,
    n: int,
) -> None:
    """Compute the part of `multiply` in the TILE columns from t on, or in those up to n."""
    whole_outs, vectors = outs - outs % 4, (n - t) // LANES
    for o in range(0, whole_outs, 4):
        at = (start + o * step_out, step_out, step_in, ins, o, t)
        if vectors > 2:
            _product_4x3(w, x, y, at)
        elif vectors == 2:
            _product_4x2(w, x, y, at)
        else:
            _product_4x1(w, x, y, at)
    for o in range(whole_outs, outs):
        at = (start + o * step_out, step_out, step_in, ins, o, t)
        if vectors > 2:
            _product_1x3(w, x, y, at)
        elif vectors == 2:
            _product_1x2(w, x, y, at)
        else:
            _product_1x1(w, x, y, at)


@compiled
def add_outer(x: Floats, g: Floats, ins: int, outs: int, w: Floats, start: int, n: int) -> None:
    """Compute w[start + o ins + i] += sum_t g[o, t] x[i, t], for t < n."""
    whole_ins, whole_outs, vectors = ins - ins % 4, outs - outs % 3, n // LANES
    for i in range(0, whole_ins, 4):
        for o in range(0, whole_outs, 3):
            _outer_4x3(x, g, w, (i, o, vectors, start, ins))
        for o in range(whole_outs, outs):
            _outer_4x1(x, g, w, (i, o, vectors, start, ins))
    for i in range(whole_ins, ins):
        x0 = x[i]
        for o in range(outs):
            g0, total = g[o], ZERO
            for t in range(n):
                total += x0[t] * g0[t]
            w[start + o * ins + i] += total
