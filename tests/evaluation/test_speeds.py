"""``bench.onnx`` and ``bench.speed``: that all rows run, whatever inputs a graph has and whatever moved since."""

from pathlib import Path

import pytest

import ngpt
from bench import speed
from bench.onnx import bench_size, half_precision, stack_of
from ngpt.denoisers import oidn


@pytest.mark.slow
@pytest.mark.skipif(bool(oidn.missing()), reason=oidn.missing())
def test_all_rows_of_the_runtimes_run(tmp_path):
    rows = bench_size(stack_of(32, 24), half_precision(tmp_path), 1)
    assert {"ngpt-fast", "graph alone", "float16", "oidn prefiltered", "ngpt-combine"} < set(rows)
    assert all(row["median"] > 0 for row in rows.values())


def test_the_process_of_another_version_needs_no_benchmarks_of_it(tmp_path):
    """Only what each version has: files and ``ngpt.methods``."""
    (tmp_path / "version").mkdir()
    (tmp_path / "version" / "ngpt").symlink_to(Path(ngpt.__file__).parent)
    ngpt.write(tmp_path / "stack.exr", stack_of(32, 24))
    worker = speed.start(tmp_path / "version")
    try:
        assert all(seconds > 0 for seconds in speed.ask(worker, f"wcv {tmp_path / 'stack.exr'}"))
    finally:
        worker.kill()
        worker.wait()
