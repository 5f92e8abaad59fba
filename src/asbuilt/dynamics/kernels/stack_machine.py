"""A stack machine that runs the drive program of one sample; see `operations`."""

# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from asbuilt.compilation import part
from asbuilt.dynamics.kernels.operations import (
    ABS,
    ADD,
    ATAN,
    COS,
    DIVIDE,
    EXP,
    LOAD,
    LOG,
    MAXIMUM,
    MINIMUM,
    MULTIPLY,
    NEGATIVE,
    NUMBER,
    POWER,
    QD,
    QDD,
    SIGN,
    SIN,
    SPEND,
    SQRT,
    SUBTRACT,
    TANH,
    Q,
)


@part
def run(program, first, numbers, constants, q, qd, qdd, load, stack, out):
    """Add the torques of a drive program, `program[first:]`."""
    top = -1
    for row in range(first, program.size, 3):
        operation, joint = program[row], program[row + 1]
        if operation <= LOAD:  # these push one value
            top += 1
            if operation == NUMBER:
                stack[top] = numbers[constants + program[row + 2]]
            elif operation == Q:
                stack[top] = q[joint]
            elif operation == QD:
                stack[top] = qd[joint]
            elif operation == QDD:
                stack[top] = qdd[joint]
            else:
                stack[top] = load[joint]
        elif operation <= SPEND:
            out[joint] += stack[top] * numbers[constants + program[row + 2]]
            if operation == SPEND:
                top -= 1
        elif operation < NEGATIVE:
            top -= 1
            stack[top] = _apply_binary(operation, stack[top], stack[top + 1])
        else:
            stack[top] = _apply_unary(operation, stack[top])


@part
def _apply_binary(operation, a, b):
    if operation == ADD:
        return a + b
    if operation == SUBTRACT:
        return a - b
    if operation == MULTIPLY:
        return a * b
    if operation == DIVIDE:
        return a / b
    if operation == POWER:
        # Squares are usual, and `pow` is slow.
        return a * a if b == 2.0 else a**b
    if operation == MINIMUM:
        return min(a, b)
    if operation == MAXIMUM:
        return max(a, b)
    # No operation has this number: the torque shows it.
    return np.nan


@part
def _apply_unary(operation, x):
    if operation == NEGATIVE:
        return -x
    if operation == ABS:
        return abs(x)
    if operation == SIGN:
        return 1.0 if x > 0.0 else -1.0 if x < 0.0 else 0.0
    if operation == EXP:
        return math.exp(x)
    if operation == LOG:
        return math.log(x)
    if operation == SQRT:
        return math.sqrt(x)
    if operation == SIN:
        return math.sin(x)
    if operation == COS:
        return math.cos(x)
    if operation == TANH:
        return math.tanh(x)
    if operation == ATAN:
        return math.atan(x)
    return np.nan
