"""How many threads the linear algebra library may use."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache
from typing import cast

from threadpoolctl import ThreadpoolController


def use_one_blas_thread() -> AbstractContextManager[object]:
    """Keep the BLAS to one thread.

    Its own threads only get in each other's way on matrices with some 50 columns.
    """
    return cast(AbstractContextManager[object], _load_blas().limit(limits=1, user_api="blas"))


@cache
def _load_blas() -> ThreadpoolController:
    return ThreadpoolController()
