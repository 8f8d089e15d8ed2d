"""Work on several machines: the executor of a Dask cluster, for shots and training sets."""

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from ngpt.errors import NgptError
from ngpt.system.install import install_command


@contextmanager
def cluster(address: str) -> Iterator[Executor]:
    """The workers of a Dask cluster; ``address`` is the address of its scheduler, such as tcp://host:8786."""
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise NgptError(f"a Dask cluster needs distributed; `{install_command('cluster')}`") from error
    try:
        client = Client(address, timeout="20s")
    except (OSError, ValueError) as error:
        raise NgptError(
            f"--cluster {address}: no Dask scheduler answers there: {error}; start `dask scheduler`, or correct the "
            "address"
        ) from error
    with client:
        yield client.get_executor(retries=3)
