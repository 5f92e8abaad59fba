"""How many threads the linear algebra library may use."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from threadpoolctl import ThreadpoolController


@contextmanager
def use_one_blas_thread() -> Iterator[None]:
    """Keep the BLAS to one thread, in a `with` block or a decorated function.

    Its own threads only get in each other's way on matrices with some 50 columns.
    """
    with _load_blas().limit(limits=1, user_api="blas"):
        yield


@cache
def _load_blas() -> ThreadpoolController:
    return ThreadpoolController()
