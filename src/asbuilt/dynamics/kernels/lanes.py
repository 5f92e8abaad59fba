"""Eight samples at a time.

A vector type for Numba functions, so that speed does not hang on what the optimiser recognises.

`load`, `store` and `splat` make lanes; `+ - *` work between lanes and with numbers; a product
feeding a sum may be fused. Every lane sees the same operations, so a result does not depend on
which samples share a vector.
"""

# mypy: allow-untyped-defs, allow-untyped-calls

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.datamodel import models
from numba.extending import intrinsic, lower_builtin, register_model, type_callable

from asbuilt.compilation import part

LANES = 8

_DOUBLE, _INTEGER = ir.DoubleType(), ir.IntType(64)
_VECTOR, _INTEGERS = ir.VectorType(_DOUBLE, LANES), ir.VectorType(_INTEGER, LANES)
_FUSED = ("contract",)


class LanesType(types.Type):
    """The Numba type of eight doubles in one vector register."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


lanes = LanesType()


class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, _VECTOR)


register_model(LanesType)(_LanesModel)


def _broadcast(builder: Any, value: Any) -> Any:
    if value.type == _VECTOR:
        return value
    kind = ir.VectorType(value.type, LANES)
    single = builder.insert_element(
        ir.Constant(kind, ir.Undefined), value, ir.Constant(ir.IntType(32), 0)
    )
    return builder.shuffle_vector(
        single,
        ir.Constant(kind, ir.Undefined),
        ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES),
    )


def _infer_pair_type(_context: Any) -> Any:
    def typed(left: Any, right: Any) -> Any:
        pair = (left, right)
        return (
            lanes
            if lanes in pair and all(side in (lanes, types.float64) for side in pair)
            else None
        )

    return typed


def _infer_negative_type(_context: Any) -> Any:
    def typed(value: Any) -> Any:
        return lanes if value == lanes else None

    return typed


def _lower_pair(instruction: str) -> Any:
    def lower(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        left, right = (_broadcast(builder, side) for side in args)
        return getattr(builder, instruction)(left, right, flags=_FUSED)

    return lower


def _lower_negative(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
    return builder.fneg(args[0], flags=_FUSED)


for _operation, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
):
    type_callable(_operation)(_infer_pair_type)
    for _pair in ((lanes, lanes), (lanes, types.float64), (types.float64, lanes)):
        lower_builtin(_operation, *_pair)(_lower_pair(_instruction))
type_callable(operator.neg)(_infer_negative_type)
lower_builtin(operator.neg, lanes)(_lower_negative)


def _locate_element(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    # Eight doubles wherever they start: no alignment beyond that of a number is promised.
    return builder.bitcast(builder.gep(data, [index]), _VECTOR.as_pointer())


def _load(_typing: Any, array: Any, index: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(_locate_element(context, builder, signature.args[0], *args), align=8)

    return lanes(array, types.intp), generate


def _load_every(_typing: Any, array: Any, index: Any, step: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        vector, place = ir.Constant(_VECTOR, ir.Undefined), args[1]
        for lane in range(LANES):
            value = builder.load(builder.gep(data, [place]), align=8)
            vector = builder.insert_element(vector, value, ir.Constant(ir.IntType(32), lane))
            place = builder.add(place, args[2])
        return vector

    return lanes(array, types.intp, types.intp), generate


def _store(_typing: Any, array: Any, index: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(
            args[2], _locate_element(context, builder, signature.args[0], *args[:2]), align=8
        )
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), generate


def _splat(_typing: Any, value: Any) -> Any:
    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _broadcast(builder, args[0])

    return lanes(types.float64), generate


def _exceeds(_typing: Any, value: Any, limit: Any) -> Any:
    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        bound = _broadcast(builder, args[1])
        outside = builder.or_(
            builder.fcmp_ordered(">", args[0], bound),
            builder.fcmp_ordered("<", args[0], builder.fneg(bound)),
        )
        return builder.icmp_unsigned(
            "!=", builder.bitcast(outside, ir.IntType(LANES)), ir.Constant(ir.IntType(LANES), 0)
        )

    return types.boolean(lanes, types.float64), generate


def _select_by_quadrant(_typing: Any, quadrant: Any, even: Any, odd: Any, ahead: Any) -> Any:
    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        def constant(value: int) -> Any:
            return ir.Constant(_INTEGERS, [value] * LANES)

        bits = builder.bitcast(args[0], _INTEGERS)
        is_odd = builder.icmp_signed("!=", builder.and_(bits, constant(1)), constant(0))
        chosen = builder.bitcast(builder.select(is_odd, args[2], args[1]), _INTEGERS)
        # 2 << 62 is the sign bit: the quadrant negates without a branch.
        half = builder.and_(builder.add(bits, _broadcast(builder, args[3])), constant(2))
        return builder.bitcast(builder.xor(chosen, builder.shl(half, constant(62))), _VECTOR)

    return lanes(lanes, lanes, lanes, types.int64), generate


load: Any = intrinsic(_load)
"""`load(array, index)`: eight consecutive numbers of a contiguous array, index unchecked."""
load_every: Any = intrinsic(_load_every)
"""`load_every(array, index, step)`: eight numbers, `step` apart."""
store: Any = intrinsic(_store)
"""`store(array, index, value)`: the reverse of `load`."""
splat: Any = intrinsic(_splat)
"""`splat(number)`: the number in every lane."""
exceeds: Any = intrinsic(_exceeds)
"""`exceeds(value, limit)`: whether any lane lies outside plus or minus `limit`."""
by_quadrant: Any = intrinsic(_select_by_quadrant)
"""`by_quadrant(n, even, odd, ahead)`.

`even` or `odd` by the last bit of n, negated where n + ahead has its second bit set.
"""

LARGEST_ANGLE = 1.0e5
"""Beyond this [rad] the reduction of `sine_cosine` loses accuracy."""

_SHIFT = 6755399441055744.0  # 1.5 * 2**52: adding it leaves the nearest integer in the last bits
_TWO_OVER_PI = 0.6366197723675814
_HALF_PI_1, _HALF_PI_2, _HALF_PI_3 = (
    1.57079632673412561417,
    6.07710050630396597660e-11,
    2.02226624879595063154e-21,
)


@part
def sine_cosine(x):
    """Return (sin x, cos x) to about 1 ulp of 1 for |x| below `LARGEST_ANGLE`.

    Cody and Waite (1980) reduction by pi/2 in three parts, then Taylor-minimax polynomials on
    [-pi/4, pi/4] (coefficients of fdlibm).
    """
    # The last bits of the sum are the nearest integer, the quadrant.
    shifted = x * _TWO_OVER_PI + _SHIFT
    n = shifted - _SHIFT
    # Three parts of pi/2: the products are exact, so that no digit is lost for large angles.
    r = ((x - n * _HALF_PI_1) - n * _HALF_PI_2) - n * _HALF_PI_3
    u = r * r
    s = u * 1.58969099521155010221e-10 + splat(-2.50507602534068634195e-08)
    s = s * u + 2.75573137070700676789e-06
    s = s * u + -1.98412698298579493134e-04
    s = s * u + 8.33333333332248946124e-03
    s = s * u + -1.66666666666666324348e-01
    s = r + (r * u) * s
    c = u * -1.13596475577881948265e-11 + splat(2.08757232129817482790e-09)
    c = c * u + -2.75573143513906633035e-07
    c = c * u + 2.48015872894767294178e-05
    c = c * u + -1.38888888888741095749e-03
    c = c * u + 4.16666666666666019037e-02
    half = u * 0.5
    # 1 - u/2 drops its last bits, which are added back before the rest of the series.
    top = 1.0 - half
    c = top + (((1.0 - top) - half) + (u * u) * c)
    return by_quadrant(shifted, s, c, 0), by_quadrant(shifted, c, s, 1)
