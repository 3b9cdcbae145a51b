"""The shared threads: BLAS is single-threaded where asked for, and as before afterwards, also after an error."""

from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from arview.core.parallel import single_threaded_blas


def blas_threads() -> set[int]:
    return {int(library["num_threads"]) for library in threadpool_info() if library["user_api"] == "blas"}


def test_blas_is_single_threaded_inside_and_as_before_afterwards() -> None:
    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        assert before == {2}
        values = np.random.default_rng(0).normal(size=(200, 64))
        with single_threaded_blas():
            assert blas_threads() == {1}
            product = values @ values.T
        assert blas_threads() == before
        np.testing.assert_allclose(product, np.einsum("ik,jk->ij", values, values), atol=1e-9)
        with pytest.raises(KeyError), single_threaded_blas():
            raise KeyError
        assert blas_threads() == before
