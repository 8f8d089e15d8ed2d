"""What holds for all tests that render."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def kernels_of_one_module():
    """Dr.Jit keeps every kernel that it has compiled; those of hundreds of scenes in one process end with an abort."""
    yield
    drjit = pytest.importorskip("drjit")
    drjit.flush_kernel_cache()
