"""The operations of the stack machine compiled into `single_sample`, by number and name."""

from __future__ import annotations

OPERATIONS = (
    *("number", "q", "qd", "qdd", "load", "act", "spend"),
    *("add", "subtract", "multiply", "divide", "power", "minimum", "maximum"),
    *("negative", "abs", "sign", "exp", "log", "sqrt", "sin", "cos", "tanh", "atan"),
)
"""`number` pushes a constant; `q`, `qd`, `qdd` and `load` push a quantity of a joint; `act` adds a
multiple of the uppermost value to the torque of a joint, `spend` removes it as well. The other
operations replace one or two values by their result.
"""
NUMBER, Q, QD, QDD, LOAD, ACT, SPEND = range(7)
ADD, SUBTRACT, MULTIPLY, DIVIDE, POWER, MINIMUM, MAXIMUM = range(7, 14)
NEGATIVE, ABS, SIGN, EXP, LOG, SQRT, SIN, COS, TANH, ATAN = range(14, 24)
STACK = 16
"""Most values on the stack."""


def count_operands(name: str) -> int:
    """Return the number of values that an operation takes from the stack."""
    code = OPERATIONS.index(name)
    return 0 if code < ADD else 2 if code < NEGATIVE else 1
